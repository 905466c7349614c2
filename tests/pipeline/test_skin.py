"""Faces and jaws read from files, brought to one clock, and learned from."""

import json
from dataclasses import replace

import ezc3d
import numpy as np
import pytest
from example_people import save
from example_tracks import make_tracks
from run_jawusd import run
from skin_takes import Skin

import jawusd
from jawusd.base.errors import FittingError, FormatError
from jawusd.formats.face_table import FaceTable, read_face_table
from jawusd.formats.performance import SolvedJaw, SolveState
from jawusd.formats.poses import write_parameters
from jawusd.formats.tracks import save_tracks
from jawusd.geometry import make_transform, se3_exp, so3_exp, transform_points
from jawusd.pipeline.skin import JawTake, learn_skin, read_face, read_jaw


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    """Return a person, the points, d and seen frames of a calibration, and a folder with the rig and d.csv."""
    person, folder = Skin(1), tmp_path_factory.mktemp("skin")
    X, d, seen = person.calibration()
    save(person.rig, folder / "model.npz")
    open_lips = np.flatnonzero(seen & (np.arange(len(d)) < len(d) - 60))
    write_parameters(folder / "d.csv", open_lips, d[open_lips])
    return person, X, d, seen, folder


def write_points(path, X, times=None):
    """Write a face table of points."""
    names = [f"p{i}_{axis}" for i in range(X.shape[1]) for axis in "xyz"]
    clock = np.arange(len(X)) if times is None else times
    header = ",".join(["frame" if times is None else "time_s", *names])
    np.savetxt(path, np.column_stack([clock, X.reshape(len(X), -1)]), "%.6g", ",", header=header, comments="")
    return path


@pytest.mark.slow
def test_skin_fit_learns_from_a_csv_of_points(take, tmp_path):
    """The face starts 1.5 s after the jaw and runs at 30 frames per second; the bite is given by its frames."""
    person, X, d, seen, folder = take
    times = np.arange(0, (len(X) - 37) / 24, 1 / 30)
    late = np.stack([np.interp(times + 1.5, np.arange(len(X)) / 24, x) for x in X.reshape(len(X), -1).T], axis=1)
    face = write_points(tmp_path / "face.csv", late.reshape(len(times), -1, 3), times)
    out = tmp_path / "skin.npz"
    words = ["skin-fit", folder / "model.npz", folder / "d.csv", face, "-o", out, "--jaw-fps", 24]
    bite = ["--bite", f"{len(d) - 60}-{len(d) - 5}"]
    found = json.loads(run(*words, *bite, "--json"))
    assert found["offset_s"] == pytest.approx(1.5, abs=0.01)
    assert found["errors_mm"]["skin"] < 0.65 * found["errors_mm"]["chin"] and found["names"][:2] == ["p0", "p1"]
    Z, T = person.closed_speech(frames=480)
    skin = jawusd.load_skin(out)
    assert person.errors_mm(person.rig.project(skin(Z).d), T)[:, 0].mean() < 0.8
    assert "exists already" in run(*words, code=10)
    assert "not of the form FIRST-LAST" in run(*words, "--force", "--bite", "90-80", code=2)
    text = run(*words, *bite, "--force", "--offset", 1.5)
    assert "40 points" in text and "a chin rigid with the bone" in text and "flagged as unfamiliar" in text
    assert "--jaw-fps" in run(*words[:-2], "--force", code=2)
    frames = write_points(tmp_path / "frames.csv", X[:100])
    assert "--fps" in run("skin-fit", folder / "model.npz", folder / "d.csv", frames, "--jaw-fps", 24, code=2)


def test_points_of_a_c3d_are_given_relative_to_the_head(take, tmp_path):
    """A head that moves, with three markers on it, in metres."""
    X = take[1][:50]
    rng = np.random.default_rng(0)
    T = make_transform(so3_exp(0.2 * rng.normal(size=(50, 3))), 100 * rng.normal(size=(50, 3)))
    head = np.array([[60.0, 50, 0], [-60, 50, 0], [0, 70, 60]])
    seen = np.concatenate([transform_points(T, X), transform_points(T, head)], axis=1) / 1000
    file = ezc3d.c3d()
    names = [f"p{i}" for i in range(X.shape[1])] + ["HL", "HR", "HF"]
    for key, value in (("LABELS", names), ("RATE", [60.0]), ("UNITS", ["m"])):
        file["parameters"]["POINT"][key]["value"] = value
    file["data"]["points"] = np.concatenate([seen, np.ones((*seen.shape[:2], 1))], axis=2).transpose(2, 1, 0)
    file.write(str(tmp_path / "face.c3d"))
    face = read_face(tmp_path / "face.c3d", rigid={"head": "HL,HR,HF"}, rest_frame=0)
    assert face.fps == 60 and face.names[-1] == "HF"
    np.testing.assert_allclose(face.X[:, :-3], transform_points(T[0], X), atol=0.02)
    np.testing.assert_allclose(read_face(tmp_path / "face.c3d").X[:, :-3], transform_points(T, X), atol=0.02)
    with pytest.raises(FormatError, match='only "head" is allowed'):
        read_face(tmp_path / "face.c3d", rigid={"jaw": "HL,HR,HF"}, rest_frame=0)


def test_weights_of_live_link_face_are_columns(tmp_path):
    rows = [f"10:00:{k // 30:02d}:{k % 30:02d}.000,52,0.{k % 9},0.1,9.5" for k in range(90)]
    path = tmp_path / "face.csv"
    path.write_text("\n".join(["Timecode,BlendShapeCount,JawOpen,MouthPucker,HeadYaw", *rows]))
    face = read_face(path)
    assert face.names == ("JawOpen", "MouthPucker") and face.fps == 30 and face.X.shape == (90, 2)
    np.testing.assert_allclose(face.X[:9, 0], np.arange(9) / 10)
    with pytest.raises(FormatError, match="no points"):
        read_face(path, rigid={"head": "1,2,3"})


def test_face_tables_are_columns_or_points(tmp_path):
    path = tmp_path / "face.csv"
    path.write_text("time_s;frame;a.x;a.y;a.z\n0,5;0;1;2;3\n0,6;1;;;\n")
    face = read_face_table(path)
    assert face.names == ("a",) and face.X.shape == (2, 1, 3) and face.fps == 1
    np.testing.assert_array_equal(face.frames, [0.5, 0.6])
    assert np.isnan(face.X[1]).all()
    np.testing.assert_array_equal(read_face(path, unit="cm").X[0], [[10, 20, 30]])
    path.write_text("frame,a_x,a_y,a_z,jaw\n3,1,2,3,4\n4,1,2,3,4\n")
    face = read_face(path, fps=50)
    assert face.names == ("a_x", "a_y", "a_z", "jaw") and face.X.shape == (2, 4) and face.fps == 50
    assert read_face_table(path).fps is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame\n1\n", "other columns, and at least one row"),
        ("frame,a\n", "other columns, and at least one row"),
        ("frame,a,frame\n1,2,3\n", "other columns, and at least one row"),
        ("frame,a\n2,1\n2,1\n", 'line 3, column "frame" must be a finite number above that of the row before'),
        ("frame,a\n2,x\n", 'line 2, column "a": "x" is not a number'),
    ],
)
def test_tables_that_are_not_of_faces_are_refused(tmp_path, text, said):
    (tmp_path / "face.csv").write_text(text)
    with pytest.raises(FormatError, match=said):
        read_face(tmp_path / "face.csv")


def test_frames_of_a_performance_that_were_interpolated_are_not_seen(take, tmp_path):
    path = tmp_path / "take.csv"
    rows = ["0,0,5,0,1,.2,.3,.4,1,valid,solved", "1,0.04,6,0,1,1,1,1,1,valid,carried", "2,.08,7,0,1,1,1,1,1,x,lost"]
    path.write_text("frame,time_s,d1,d2,d3,sigma1,sigma2,sigma3,margin_mm,verdict,state\n" + "\n".join(rows))
    jaw = read_jaw(take[0].rig, path)
    np.testing.assert_array_equal(jaw.seen, [True, False, False])
    np.testing.assert_array_equal(jaw.sigma_mm[0], [0.2, 0.3, 0.4])
    bitten = jaw.with_bite(2, 4)
    np.testing.assert_array_equal(bitten.frames, [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(bitten.seen, [True, False, True, True, True])
    assert (bitten.d[2:] == 0).all()


def test_frames_of_tracks_are_seen_with_their_sigmas(take, tmp_path):
    """Poses with known noise; frames with a prior, without a pose or with a large sigma are not seen."""
    rig, rng = take[0].rig, np.random.default_rng(0)
    d = rig.project(rng.uniform([2, -3, 0], [20, 3, 3], (40, 3)))
    tracks = make_tracks(40)
    noise = np.diag([1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1]) ** 2
    tracks.T_upper_lower[3:] = se3_exp(rng.multivariate_normal(np.zeros(6), noise, 37)) @ rig.pose(d[3:])
    tracks.covariance_relative[3:] = noise
    tracks.prior_aided[5], tracks.sigma_mm[6], tracks.T_upper_lower[7], tracks.meta["fps"] = True, 1.5, np.nan, 24.0
    save_tracks(tmp_path / "tracks.npz", tracks)
    jaw = read_jaw(rig, tmp_path / "tracks.npz")
    assert jaw.fps == 24 and jaw.frames[0] == 30
    assert not jaw.seen[[2, 5, 6, 7]].any() and jaw.seen[8:].all()
    assert 0.5 < np.mean(((jaw.d - d)[8:] / jaw.sigma_mm[8:]) ** 2) < 1.6
    state = np.where(np.arange(40) < 20, SolveState.SOLVED, SolveState.CARRIED).astype(np.int8)
    tracks.solved = SolvedJaw(d, np.full(d.shape, 0.2), np.ones(40), state, np.ones(40, bool))
    save_tracks(tmp_path / "tracks.npz", tracks)
    jaw = read_jaw(rig, tmp_path / "tracks.npz")
    np.testing.assert_array_equal(jaw.seen, np.arange(40) < 20)
    np.testing.assert_array_equal(jaw.d, d)
    assert (jaw.sigma_mm == 0.2).all()


def test_a_face_of_another_performance_is_refused(take):
    person, X, d, seen, _ = take
    jaw = JawTake(np.arange(len(d)) * 1.0, d, seen, np.full(d.shape, 0.15), 24.0)
    noise = np.random.default_rng(0).normal(size=X.shape)
    face = read_face_of(X[np.random.default_rng(1).permutation(len(X))] + noise)
    with pytest.raises(FittingError, match="do not follow the jaw at any clock offset"):
        learn_skin(person.rig, jaw, face)
    with pytest.raises(FittingError, match="no frame has values in all columns"):
        learn_skin(person.rig, jaw, read_face_of(np.where(np.arange(40)[:, None] == 3, np.nan, X)))
    with pytest.raises(ValueError, match="frame rate"):
        learn_skin(person.rig, replace(jaw, fps=0.0), face)


def read_face_of(X):
    """Return points as a face at 24 frames per second."""
    return FaceTable(np.arange(len(X)) * 1.0, X, (), 24.0, "mm")
