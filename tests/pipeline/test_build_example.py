"""A rig is built from the example capture; each defect of a capture gives one clear error and loses no data."""

import json
import os
import platform
import shutil
import subprocess
import sys

import numpy as np
import onnxruntime
import pytest
import trimesh
from package_copy import ROOT
from pxr import Usd, UsdGeom

import jawusd
from jawusd.base.errors import CaptureError, JawusdError, OutputError
from jawusd.cameras.calibration import load_calibration
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import transform_points
from jawusd.pipeline.build import BuildOptions, build
from jawusd.pipeline.cameras import load_cameras, rescaled_cameras
from jawusd.pipeline.workspace import open_capture
from jawusd.rig.validate import validate_stage

EXAMPLE = ROOT / "examples" / "capture"


def quiet(stage, done, total):
    """Ignore progress."""


@pytest.fixture(scope="module")
def built(example_build):
    return example_build


def points_of_mandible():
    scans = EXAMPLE / "scans"
    return np.concatenate([trimesh.load(scans / name).vertices for name in ("mandible.ply", "lower_teeth.ply")])


def test_the_example_is_tracked_as_well_as_its_masks_allow(built):
    out, summary = built
    tracks = load_tracks(out / "tracks.npz")
    with np.load(EXAMPLE / "truth" / "truth.npz") as archive:
        truth = {name: archive[name] for name in archive.files}
    assert summary["track"]["lost"] == [] and tracks.tracked().all()
    rows = np.searchsorted(truth["frames"], tracks.frames)
    scans = {"upper": "upper_teeth.ply", "lower": "lower_teeth.ply"}
    for name, file in scans.items():
        vertices = np.asarray(trimesh.load(EXAMPLE / "scans" / file).vertices)[::10]
        found = getattr(tracks, f"T_world_{name}")
        error = transform_points(found, vertices) - transform_points(truth[f"T_world_{name}"][rows], vertices)
        assert np.linalg.norm(error, axis=-1).mean() < 0.15
    offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    assert summary["sync"]["offsets"] == offsets


def test_the_model_reconstructs_what_was_tracked(built):
    _, summary = built
    assert summary["fit"]["errors"]["train"]["mandible"]["mean"] < 0.6


def test_every_usd_file_passes_every_validator(built):
    out, _ = built
    layers = sorted(path for path in out.iterdir() if path.suffix in (".usda", ".usdc", ".usdz"))
    assert len(layers) >= 4
    for path in layers:
        assert [f for f in validate_stage(path) if f.severity == "error"] == [], path.name


def test_the_baked_ops_are_the_evaluators_poses_at_every_captured_frame(built):
    out, _ = built
    stage = Usd.Stage.Open(str(out / "anim_capture.usdc"))
    mandible = UsdGeom.Xformable(stage.GetDefaultPrim().GetPrimAtPath("geo/Mandible"))
    prim, rig = stage.GetDefaultPrim(), jawusd.load(out / "actor.usda")
    vertices = points_of_mandible()
    tracks = load_tracks(out / "tracks.npz")
    for frame in tracks.frames:
        d = [prim.GetAttribute(f"jaw:d{i}").Get(float(frame)) for i in (1, 2, 3)]
        baked = np.array(mandible.GetLocalTransformation(float(frame))).T
        gap = transform_points(baked, vertices) - transform_points(rig.pose(d), vertices)
        assert np.linalg.norm(gap, axis=1).max() < 0.01


def test_exact_model_table_and_onnx_agree_on_random_valid_parameters(built):
    out, _ = built
    rig = jawusd.load(out / "actor.usda")
    rng = np.random.default_rng(0)
    low, high = rig.d_range.T
    d = rng.uniform(low, high, (60000, 3))
    d = d[rig.margin(d) >= 0][:1000]
    assert len(d) == 1000
    vertices = points_of_mandible()[::7]
    exact = transform_points(rig.pose(d), vertices)
    session = onnxruntime.InferenceSession(str(out / "actor.onnx"), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    dtype = np.float32 if "float)" in session.get_inputs()[0].type else np.float64
    outputs = dict(zip(names, session.run(None, {session.get_inputs()[0].name: d.astype(dtype)}), strict=True))
    T = next(value for value in outputs.values() if value.shape[1:] == (4, 4)).astype(float)
    assert np.linalg.norm(transform_points(T, vertices) - exact, axis=-1).max() < 0.01
    from jawusd.rig.read import find_rig_prim, open_stage, read_table

    stage = open_stage(out / "actor.usda")
    table = read_table(find_rig_prim(stage, out))
    from jawusd.geometry import se3_exp

    read = se3_exp(table.twist(d)) @ rig.T_rest
    assert np.linalg.norm(transform_points(read, vertices) - exact, axis=-1).max() < 0.06


def test_the_report_shows_the_take_and_stays_small(built):
    out, summary = built
    text = (out / "report.html").read_text()
    assert len(text.encode()) < 6e6 and summary["report"]["file"] == "report.html"
    assert text.count('with the tracked scans drawn over it" src="data:image/jpeg;base64,') == 6
    assert text.count('<img alt="contacts: ') == 4 and text.count("data:image/jpeg;base64,") == 10
    assert text.count("video/cam") == 0
    for words in ("jaw rig report", "light flash", "cam0.mp4", "replay-data", "Paper Fig. 13"):
        assert words in text
    origin = summary["report"]["origin"]
    assert f"built {origin['finished']}" in text and f"Python {platform.python_version()}" in text
    assert "<li>pictures" not in text and "<li>experiments" not in text


def test_a_second_build_needs_a_word_and_resume_reuses_everything(built):
    out, _ = built
    with pytest.raises(OutputError, match="--resume"):
        build(EXAMPLE, out, BuildOptions(), quiet)
    again = build(EXAMPLE, out, BuildOptions(resume=True), quiet)
    assert again["reused"] == ["check", "sync", "track", "fit", "refine", "bake", "report"]


@pytest.mark.slow
def test_resume_redoes_only_what_depends_on_a_change(built, tmp_path, monkeypatch):
    monkeypatch.setattr("jawusd.pipeline.build.missing_packages", lambda: "no report: nothing here reads it")
    out = tmp_path / "copy"
    shutil.copytree(built[0], out)
    (out / "model.npz").unlink()
    again = build(EXAMPLE, out, BuildOptions(resume=True), quiet)
    assert again["reused"][:3] == ["check", "sync", "track"] and "fit" not in again["reused"]
    assert (out / "model.npz").read_bytes() == (built[0] / "model.npz").read_bytes()


def test_a_resumed_copy_of_a_build_records_its_own_path_to_the_capture(built, tmp_path, monkeypatch):
    monkeypatch.setattr("jawusd.pipeline.build.missing_packages", lambda: "no report: nothing here reads it")
    source = built[0]
    for out in (tmp_path / "copy", tmp_path / "deeper" / "copy"):
        shutil.copytree(source, out)
        again = build(EXAMPLE, out, BuildOptions(resume=True), quiet)
        assert (out / again["report"]["capture"]).resolve() == EXAMPLE.resolve()
        source = out
    assert again["reused"] == ["check", "sync", "track", "fit", "refine", "bake"]


@pytest.fixture
def capture(tmp_path):
    """A copy of the example for tests that damage files; large ones are links until replaced."""
    folder = tmp_path / "capture"
    for source in EXAMPLE.rglob("*"):
        target = folder / source.relative_to(EXAMPLE)
        if source.is_dir():
            target.mkdir(parents=True, exist_ok=True)
        elif source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            os.link(source, target) if source.stat().st_dev == tmp_path.stat().st_dev else shutil.copy(source, target)
    return folder


def replace(folder, name, change):
    """Replace a file of the copy by a modified one without writing through a hard link."""
    data = (folder / name).read_bytes()
    (folder / name).unlink()
    (folder / name).write_bytes(change(data))


def missing_mask_folder(folder):
    shutil.rmtree(folder / "masks")


def masks_of_another_size(folder):
    from jawusd.media.writers import VideoWriter

    path = next((folder / "masks").rglob("*.mkv"))
    path.unlink()
    with VideoWriter(path, (320, 180), 24.0, lossless=True) as writer:
        for _ in range(40):
            writer.write(np.full((180, 320), 255, np.uint8))


def scan_in_metres(folder):
    mesh = trimesh.load(folder / "scans" / "lower_teeth.ply", process=False)
    mesh.apply_scale(0.001)
    (folder / "scans" / "lower_teeth.ply").unlink()
    mesh.export(folder / "scans" / "lower_teeth.ply")


def calibration_without_rotation(folder):
    def change(data):
        lines = data.decode().splitlines()
        first = next(i for i, line in enumerate(lines) if line.startswith("rotation"))
        lines[first] = "rotation = [[1.0, 0.0, 0.0], [0.0, 1.2, 0.0], [0.0, 0.0, 1.0]]"
        return "\n".join(lines).encode()

    replace(folder, "calibration.toml", change)


def calibration_at(width, height):
    """Return a function that rescales the calibration of a copy to another picture size."""

    def change(data):
        import tomllib

        out = []
        for name, entry in tomllib.loads(data.decode()).items():
            if "matrix" not in entry:
                continue
            sx, sy = width / entry["size"][0], height / entry["size"][1]
            K = entry["matrix"]
            K = [[K[0][0] * sx, 0.0, (K[0][2] + 0.5) * sx - 0.5], [0.0, K[1][1] * sy, (K[1][2] + 0.5) * sy - 0.5], K[2]]
            values = {**entry, "size": [width, height], "matrix": K}
            out += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in values.items())]
        return "\n".join(out).encode()

    return change


def calibration_of_another_shape(folder):
    replace(folder, "calibration.toml", calibration_at(1280, 960))


def pick_outside_its_image(folder):
    import re

    replace(folder, "capture.toml", lambda data: re.sub(rb"\bx = [0-9.]+", b"x = 99999.0", data, count=1))


def truncated_video(folder):
    video = next((folder / "video").glob("*.mp4"))
    replace(folder, str(video.relative_to(folder)), lambda data: data[: len(data) // 3])


@pytest.mark.parametrize(
    ("damage", "error", "words"),
    [
        (missing_mask_folder, CaptureError, "masks"),
        pytest.param(masks_of_another_size, CaptureError, "320", marks=pytest.mark.slow),
        pytest.param(calibration_of_another_shape, CaptureError, "the aspect ratios differ", marks=pytest.mark.slow),
        pytest.param(scan_in_metres, CaptureError, "metres", marks=pytest.mark.slow),
        pytest.param(calibration_without_rotation, CaptureError, "not orthonormal", marks=pytest.mark.slow),
        (pick_outside_its_image, CaptureError, "outside"),
        (truncated_video, CaptureError, "video"),
    ],
)
def test_each_broken_capture_is_one_clear_error(capture, tmp_path, damage, error, words):
    damage(capture)
    with pytest.raises(error, match=words) as caught:
        build(capture, tmp_path / "out", BuildOptions(), quiet)
    assert isinstance(caught.value, JawusdError) and str(capture) in str(caught.value)
    left = {path.name for path in (tmp_path / "out").iterdir()} if (tmp_path / "out").exists() else set()
    assert left <= {"build.json", ".jawusd-lock"}


def test_calibration_at_another_size_of_the_same_shape_is_scaled(capture):
    exact = load_cameras(open_capture(capture))
    assert rescaled_cameras(open_capture(capture)) == {}
    replace(capture, "calibration.toml", calibration_at(2560, 1440))
    assert load_calibration(capture / "calibration.toml")[0].size_px == (2560, 1440)
    opened = open_capture(capture)
    assert set(rescaled_cameras(opened)) == {camera.name for camera in exact}
    for found, wanted in zip(load_cameras(opened), exact, strict=True):
        assert found.size_px == wanted.size_px
        np.testing.assert_allclose(found.K, wanted.K, atol=1e-9)


def test_an_output_folder_with_other_files_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(OutputError, match="not empty"):
        build(EXAMPLE, tmp_path, BuildOptions(), quiet)
    assert os.listdir(tmp_path) == ["mine.txt"]


@pytest.mark.slow
def test_the_program_reports_a_broken_capture_without_a_traceback(capture, tmp_path):
    calibration_without_rotation(capture)
    command = [sys.executable, "-m", "jawusd", "build", str(capture), "-o", str(tmp_path / "out")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 5 and "not orthonormal" in result.stderr and "Traceback" not in result.stderr


def test_build_json_names_every_file_with_its_hash(built):
    out, summary = built
    record = json.loads((out / "build.json").read_text())["stages"]
    listed = {name for stage in record.values() for name in stage["outputs"]}
    expected = {"actor.usda", "tracks.npz", "model.npz", "actor.onnx", "cameras.usda", "report.html"}
    assert listed == set(summary["files"]) and expected <= listed
