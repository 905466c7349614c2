"""The commands on many actors, retarget and library, run as programs."""

import json
from pathlib import Path

import numpy as np
import pytest
from example_people import person, save
from example_rig import example_meshes, example_motion
from package_copy import ROOT
from pxr import Sdf, Usd
from typer.testing import CliRunner

import jawusd
from jawusd.base.errors import FittingError, FormatError, OutputError, RigError
from jawusd.cli.main import app
from jawusd.formats.model import load_model
from jawusd.formats.poses import write_parameters
from jawusd.geometry import LANDMARKS
from jawusd.pipeline.subject import subject_of_scans
from jawusd.rig import write_animation
from jawusd.rig.bake import bake_rig
from jawusd.rig.layout import PARAMETERS
from jawusd.rig.motion_read import read_parameters_of_stage, read_poses_of_stage

FPS = 30.0


@pytest.fixture(scope="module")
def actors(tmp_path_factory):
    """Two persons; the second has smaller ranges."""
    folder = tmp_path_factory.mktemp("actors")
    for name, rig in (("a", person("A")), ("b", person("B", ranges=0.6, opening=0.8, wider_mm=3.0))):
        bake_rig(folder / name, rig, example_meshes(), name=name, fps=24, table_size=17)
    return folder / "a" / "actor.usda", folder / "b" / "actor.usda"


@pytest.fixture
def animation(actors, tmp_path):
    frames, d = example_motion(65)  # every peak of opening and laterotrusion lies on a frame
    return write_animation(tmp_path / "anim.usdc", actors[0], frames, d, FPS), frames, d


def run(*arguments):
    """Run the program and return its JSON."""
    result = CliRunner().invoke(app, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def peaks(curve):
    """Frames of a curve's local extrema."""
    steps = np.sign(np.diff(curve))
    return np.flatnonzero(steps[:-1] * steps[1:] < 0) + 1


def test_a_motion_is_carried_valid_and_in_time(actors, animation, tmp_path):
    path, frames, d = animation
    out = tmp_path / "out.usdc"
    result = run("retarget", path, "--from", actors[0], "--to", actors[1], "-o", out)
    assert result["fps"] == FPS and result["frames"] == [frames[0], frames[-1]]
    assert result["valid"] == result["samples"] == len(frames) and result["lost"] == 0
    shown, poses = read_poses_of_stage(out)
    np.testing.assert_array_equal(shown, frames)
    b = jawusd.load(actors[1])
    verdicts = b.validate(poses, residual_limit_mm=0.05)
    assert verdicts.valid.all()
    for axis in range(3):
        before, after = peaks(d[:, axis]), peaks(verdicts.d[:, axis])
        assert len(before) == len(after) and np.abs(before - after).max() <= 1
    np.testing.assert_allclose(verdicts.d[:, 0], 0.8 * d[:, 0], atol=0.01)
    assert Usd.Stage.Open(str(out)).GetTimeCodesPerSecond() == FPS


def test_motion_given_by_transforms_alone_is_carried_too(actors, animation, tmp_path):
    path, frames, d = animation
    layer = Sdf.Layer.FindOrOpen(str(path))
    for name in PARAMETERS:
        del layer.GetPrimAtPath("/Actor").properties[name]
    layer.Export(str(tmp_path / "baked.usdc"))
    layer.Clear()
    assert read_parameters_of_stage(tmp_path / "baked.usdc") is None
    out = tmp_path / "out.usdc"
    result = run("retarget", tmp_path / "baked.usdc", "--from", actors[0], "--to", actors[1], "-o", out)
    assert result["fps"] == FPS and result["valid"] == len(frames)
    np.testing.assert_allclose(read_parameters_of_stage(out)[1][:, 0], 0.8 * d[:, 0], atol=0.01)


def test_what_leaves_the_bound_is_reported_and_valid(actors, tmp_path):
    frames = np.arange(10)
    d = np.stack([np.linspace(0, 30, 10), np.full(10, 11.0), np.zeros(10)], axis=1)
    write_parameters(tmp_path / "d.csv", frames, d)
    out = tmp_path / "out.usdc"
    result = run("retarget", tmp_path / "d.csv", "--from", actors[0], "--to", actors[1], "-o", out, "--fps", 25)
    assert result["clamped"] > 0 and result["largest_move_mm"] > 0.5 and result["valid"] == 10
    b = jawusd.load(actors[1])
    assert b.validate(read_poses_of_stage(out)[1]).valid.all()
    said = CliRunner().invoke(
        app,
        list(
            map(str, ["retarget", tmp_path / "d.csv", "--from", *actors[:1], "--to", actors[1], "-o", out, "--force"])
        ),
    )
    assert "lay outside the bound" in said.stdout


def test_between_keys_every_whole_frame_is_carried(actors, tmp_path):
    keys = {"fps": 24, "interpolation": "linear", "keys": [{"frame": 0, "d": [0, 0, 0]}, {"frame": 8, "d": [30, 3, 0]}]}
    (tmp_path / "keys.json").write_text(json.dumps(keys))
    out = tmp_path / "out.usdc"
    run("retarget", tmp_path / "keys.json", "--from", actors[0], "--to", actors[1], "-o", out)
    times, d, fps = read_parameters_of_stage(out)
    a, b = map(jawusd.load, actors)
    np.testing.assert_array_equal(times, np.arange(9))
    source = np.linspace([0, 0, 0], [30, 3, 0], 9)
    np.testing.assert_allclose(b.normalized(d), a.normalized(source), atol=1e-6)
    assert fps == 24


def test_lost_frames_stay_lost(actors, tmp_path):
    frames, d = example_motion(12)
    d[4:6] = np.nan
    path = write_animation(tmp_path / "gap.usdc", actors[0], frames, d, FPS)
    times, read, fps = read_parameters_of_stage(path)
    np.testing.assert_array_equal(times, frames)
    assert np.isnan(read[4:6]).all() and fps == FPS
    out = tmp_path / "out.usdc"
    result = run("retarget", path, "--from", actors[0], "--to", actors[1], "-o", out)
    assert result["lost"] == 2
    assert np.isnan(read_parameters_of_stage(out)[1][4:6]).all()


def test_without_a_name_the_motion_goes_beside(actors, animation, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("retarget", "--from", actors[0], animation[0], "--to", actors[1])["file"] == "retargeted.usdc"
    assert (tmp_path / "retargeted.usdc").exists()


def test_animate_takes_motion_of_another_rig(actors, animation, tmp_path):
    path, frames, _ = animation
    run("retarget", path, "--from", actors[0], "--to", actors[1], "-o", tmp_path / "retargeted.usdc")
    said = run("animate", actors[1], path, "--retarget-from", actors[0], "-o", tmp_path / "animated.usdc")
    assert said["valid"] == said["samples"] == len(frames) and said["fps"] == FPS
    _, expected, _ = read_parameters_of_stage(tmp_path / "retargeted.usdc")
    np.testing.assert_array_equal(read_parameters_of_stage(tmp_path / "animated.usdc")[1], expected)
    arguments = ["animate", actors[1], "--arkit", path, "--retarget-from", actors[0], "-o", tmp_path / "x.usdc"]
    assert CliRunner().invoke(app, [str(word) for word in arguments]).exit_code == 2


def test_the_folder_of_a_build_stands_for_its_rig(actors, animation, tmp_path):
    """Every option for a rig accepts its folder, of a build or published under another name."""
    path, *_ = animation
    a, b = (actor.parent for actor in actors)
    CliRunner().invoke(app, ["publish", str(b), "-o", str(tmp_path / "hero"), "--prefix", "hero"])
    read = {}
    for name, source, target in (("file", *actors), ("folder", a, b), ("published", a, tmp_path / "hero")):
        run("retarget", path, "--from", source, "--to", target, "-o", tmp_path / f"{name}.usdc")
        read[name] = read_poses_of_stage(tmp_path / f"{name}.usdc")[1]
    np.testing.assert_array_equal(read["file"], read["folder"])
    np.testing.assert_array_equal(read["file"], read["published"])
    run("animate", b, path, "--retarget-from", a, "-o", tmp_path / "animated.usdc")
    np.testing.assert_array_equal(read["file"], read_poses_of_stage(tmp_path / "animated.usdc")[1])
    run("library", tmp_path / "lib", "--add", a, "--name", "anna")
    assert jawusd.load(tmp_path / "lib" / "anna" / "model.npz").kind == jawusd.load(a).kind


def test_retarget_asks_for_one_thing_and_overwrites_nothing(actors, animation, tmp_path):
    path, *_ = animation
    a, b = actors
    for arguments in (
        [path, "--from", a, "-o", tmp_path / "x.usdc"],
        [path, "--from", a, "--to", b, "--library", tmp_path, "-o", tmp_path / "x.usdc"],
        ["--landmarks", path, "-o", tmp_path / "x.npz"],
        [path, "--from", a, "--to", b, "-o", tmp_path / "x.npz"],
    ):
        assert CliRunner().invoke(app, ["retarget", *map(str, arguments)]).exit_code == 2
    with pytest.raises(OutputError, match="exists"):
        run("retarget", path, "--from", a, "--to", b, "-o", path)


@pytest.fixture
def people(tmp_path):
    folder = tmp_path / "people"
    save(person("Anna"), folder / "anna" / "model.npz")
    save(person("Bert", ranges=0.8, opening=0.9, wider_mm=3), folder / "bert" / "model.npz")
    return folder


def face(path, wider_mm=0.0):
    landmarks = person("face", wider_mm=wider_mm).arrays["landmarks"]
    named = dict(zip(LANDMARKS, landmarks.tolist(), strict=True))
    path.write_text(json.dumps({"format": "jawusd-landmarks/1", "units": "mm", "landmarks": named}))
    return path


def incisor_travel(rig, opening_mm):
    """Displacement of the incisal point [mm] at an opening on the habitual path."""
    return np.linalg.norm((rig.pose([opening_mm, 0, 0]) - rig.T_rest) @ [*rig.landmarks[0], 1.0])


def test_a_library_is_listed_searched_and_compared(people, tmp_path):
    assert [rig["actor"] for rig in run("library", people)["rigs"]] == ["Anna", "Bert"]
    assert [rig["actor"] for rig in run("library", people, "--search", "ber")["rigs"]] == ["Bert"]
    alike = run("library", people, "--like", face(tmp_path / "face.json", wider_mm=3))["rigs"]
    assert [rig["actor"] for rig in alike] == ["Bert", "Anna"] and alike[0]["landmark_distance_mm"] < 1e-6
    compared = run("library", people, "--compare", "Anna", "Bert")
    opening = compared["measures_mm"]["opening_max"]
    assert opening["first"] == 42 and opening["difference"] == pytest.approx(-4.2)
    assert compared["measures_mm"]["condylar_distance"]["difference"] == pytest.approx(6)
    text = CliRunner().invoke(app, ["library", str(people)]).stdout
    assert "42.0" in text and "37.8" in text and "2 rigs" in text
    assert "-4.20" in CliRunner().invoke(app, ["library", str(people), "--compare", "Anna", "Bert"]).stdout


def test_the_ranges_of_those_listed_are_drawn(people, tmp_path):
    save(person("C$osts_$", ranges=0.5), people / "c" / "model.npz")
    said = run("library", people, "--plot", tmp_path / "figures")
    assert [Path(name).name for name in said["plots"]] == ["ranges.png", "ranges.svg"]
    assert (tmp_path / "figures" / "ranges.png").read_bytes()[:4] == b"\x89PNG"
    drawn = (tmp_path / "figures" / "ranges.svg").read_text()
    assert all(f">{name}<" in drawn for name in ("Anna", "Bert", "C$osts_$"))
    with pytest.raises(OutputError, match="exists"):
        run("library", people, "--plot", tmp_path / "figures")
    run("library", people, "--search", "bert", "--plot", tmp_path / "figures", "--force")
    drawn = (tmp_path / "figures" / "ranges.svg").read_text()
    assert ">Bert<" in drawn and ">Anna<" not in drawn
    assert CliRunner().invoke(app, ["library", str(people), "--compare", "a", "b", "--plot", "x"]).exit_code == 2


def test_rigs_are_added_as_models(people, actors):
    added = run("library", people, "--add", actors[0], "--name", "carl")
    assert [rig["actor"] for rig in added["rigs"]] == ["Anna", "Bert", "carl"]
    d = [12.0, 2, 1]
    copy, original = jawusd.load(people / "carl" / "model.npz"), jawusd.load(actors[0])
    np.testing.assert_allclose(copy.pose(d), original.pose(d), atol=1e-12)
    with pytest.raises(OutputError, match="exists"):
        run("library", people, "--add", actors[0], "--name", "carl")
    run("library", people, "--add", people / "anna" / "model.npz", "--name", "carl", "--force")
    for name in ("../out", "a/b", "..", ".hidden", ""):
        with pytest.raises(FormatError, match="not a valid folder name"):
            run("library", people, "--add", actors[0], "--name", name or " ")
    assert sorted(path.name for path in people.parent.iterdir() if path.is_dir()) == ["people"]


def test_nothing_is_added_through_a_link(people, actors, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (people / "dora").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="link"):
        run("library", people, "--add", actors[0], "--name", "dora", "--force")
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_landmarks_and_a_library_make_a_rig(people, tmp_path):
    out = tmp_path / "mine.npz"
    said = run("retarget", "--landmarks", face(tmp_path / "face.json", 1.5), "--library", people, "-o", out)
    assert said["weights"].keys() == {"anna/model.npz", "bert/model.npz"}
    assert said["expected_error_mm"]["mean"] > 0.5  # the two differ in range
    assert any("expected error" in warning["message"] for warning in said["warnings"])
    rig = jawusd.load(out)
    assert rig.meta["actor"] == "face" and len(load_model(out).frames) == 0
    widest = [
        incisor_travel(who, who.arrays["d_range"][0, 1])
        for who in (*map(jawusd.load, (people / "anna" / "model.npz", people / "bert" / "model.npz")), rig)
    ]
    assert widest[1] - 1 < widest[2] < widest[0] + 1
    assert rig.meta["personal"]["expected_error_mm"] == said["expected_error_mm"]
    assert rig.held_out is None  # the transferred poses are no take of this subject
    T = person("Anna").pose([15.0, 1, 0.5])
    assert rig.encode(T)[1] < 1.5
    closest = tmp_path / "closest.npz"
    said = run(
        "retarget", "--landmarks", tmp_path / "face.json", "--library", people, "--use", "closest", "-o", closest
    )
    assert list(said["weights"].values()) == [1.0]


SCANS = ROOT / "examples" / "capture" / "scans"


@pytest.mark.slow
def test_somebody_without_a_capture_gets_a_rig_on_loose_scans(people, tmp_path):
    files = {name: SCANS / f"{name}.ply" for name in ("upper_teeth", "lower_teeth", "mandible")}
    named = dict(zip(LANDMARKS, subject_of_scans(files, "me").landmarks.tolist(), strict=True))
    (tmp_path / "me.json").write_text(json.dumps({"format": "jawusd-landmarks/1", "units": "mm", "landmarks": named}))
    run("retarget", "--landmarks", tmp_path / "me.json", "--library", people, "-o", tmp_path / "me.npz")
    scans = [word for name, path in files.items() for word in (f"--{name.replace('_', '-')}", path)]
    run("bake", tmp_path / "me.npz", *scans, "-o", tmp_path / "me", "--table", 17)
    d = [20.0, 1, 0]
    np.testing.assert_allclose(
        jawusd.load(tmp_path / "me" / "actor.usda").pose(d), jawusd.load(tmp_path / "me.npz").pose(d), atol=1e-9
    )
    assert not (tmp_path / "me" / "anim_capture.usdc").exists()
    with pytest.raises(RigError, match="one coordinate frame"):
        run("bake", people / "anna" / "model.npz", *scans, "-o", tmp_path / "other", "--table", 17)


def test_an_empty_library_is_said_to_be_empty(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FittingError, match="no subject"):
        run(
            "retarget",
            "--landmarks",
            face(tmp_path / "f.json"),
            "--library",
            tmp_path / "empty",
            "-o",
            tmp_path / "m.npz",
        )
