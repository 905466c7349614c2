"""The quick checks find all planted faults at once, and none in a good capture."""

import json
import os
import re
import shutil
import threading

import cv2
import numpy as np
import pytest
import trimesh
from package_copy import ROOT
from run_jawusd import program

from jawusd.base.errors import CaptureError
from jawusd.capture.camera_checks import swapped_cameras
from jawusd.formats.capture import load_capture
from jawusd.formats.finding import Finding
from jawusd.media.writers import VideoWriter
from jawusd.pipeline import check as checks
from jawusd.pipeline.build import BuildOptions, build
from jawusd.pipeline.check import check_capture

EXAMPLE = ROOT / "examples" / "capture"


@pytest.fixture
def capture(tmp_path):
    """A copy of the example whose files may be replaced but not modified: large ones are links."""
    folder = tmp_path / "capture"
    for source in EXAMPLE.rglob("*"):
        target = folder / source.relative_to(EXAMPLE)
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_file():
            os.link(source, target) if source.stat().st_dev == tmp_path.stat().st_dev else shutil.copy(source, target)
    return folder


def written(path, data):
    path.unlink(missing_ok=True)
    path.write_bytes(data)


def described(folder, old, new):
    text = (folder / "capture.toml").read_text()
    assert old in text
    written(folder / "capture.toml", text.replace(old, new).encode())


def scan(folder, name, change):
    mesh = trimesh.load(folder / "scans" / name, process=False)
    mesh.vertices = change(mesh.vertices)
    written(folder / "scans" / name, mesh.export(file_type="ply"))


def mask_video(folder, name, value, size=(1280, 720), count=336):
    path = folder / "masks" / name
    path.unlink()
    with VideoWriter(path, size, 24.0, lossless=True) as writer:
        for k in range(count):
            writer.write(np.full(size[::-1], value if k > 30 else 0, np.uint8))


def exchanged(folder, a, b):
    (folder / a).rename(folder / "aside")
    (folder / b).rename(folder / a)
    (folder / "aside").rename(folder / b)


def found(folder, **options):
    return check_capture(folder, **options)


def checking(monkeypatch, *names):
    """Leave out all checks but some: together they take seconds."""
    monkeypatch.setattr(checks, "_CHECKS", tuple(check for check in checks._CHECKS if check.what in names))


def test_nothing_is_said_of_the_example():
    assert found(EXAMPLE) == []


def frames_beyond(folder):
    described(folder, "frames = [20, 320]", "frames = [20, 3200]")


def rest_frame_outside(folder):
    described(folder, "rest_frame = 36", "rest_frame = 12")


def pick_frame_outside(folder):
    described(folder, "[bootstrap]\nframe = 20", "[bootstrap]\nframe = 12")


def rate_of_another_take(folder):
    described(folder, "fps = 24.0", "fps = 30.0")


def offset_beyond(folder):
    offsets = 'method = "offsets"\noffsets = { cam0 = 0, cam1 = 4000, cam2 = 0 }'
    described(folder, 'method = "flash"', offsets)


def calibration_in_metres(folder):
    described(
        folder, 'calibration = "calibration.toml"', 'calibration = "calibration.toml"\ncalibration_unit_mm = 0.001'
    )


def no_calibration(folder):
    described(folder, 'calibration = "calibration.toml"\n', "")
    text = (folder / "capture.toml").read_text()
    written(folder / "capture.toml", re.sub(r"\[boards\]\n(?:\w+ = .*\n)+", "", text).encode())


def truncated_clip(folder):
    path = folder / "video" / "cam1.mp4"
    written(path, path.read_bytes()[: path.stat().st_size // 2])


def damaged_scan(folder):
    path = folder / "scans" / "upper_teeth.ply"
    written(path, path.read_bytes()[:4000])


def scan_in_metres(folder):
    scan(folder, "lower_teeth.ply", lambda v: v * 0.001)


def scan_apart(folder):
    scan(folder, "lower_teeth.ply", lambda v: v - [0, 8, 0])


def mandible_elsewhere(folder):
    scan(folder, "mandible.ply", lambda v: v - [0, 60, 0])


def black_masks(folder):
    for arch in ("upper", "lower"):
        mask_video(folder, f"cam1/{arch}.mkv", 0)


def masks_of_another_size(folder):
    mask_video(folder, "cam1/upper.mkv", 255, (320, 180), 40)


def arches_exchanged(folder):
    exchanged(folder, "masks/cam1/upper.mkv", "masks/cam1/lower.mkv")


def cameras_exchanged(folder):
    exchanged(folder, "masks/cam1", "masks/cam2")


def pick_on_another_vertex(folder):
    described(folder, "vertex = 1674", "vertex = 100")


#: Per fault: severity, kind and words of its line.
SAID = {
    frames_beyond: ("error", "frames_missing", "frames end at 3199"),
    rest_frame_outside: ("warning", "rest_frame", "motion.rest_frame is 12; frames run from 20 to 319"),
    pick_frame_outside: ("error", "bootstrap_frame", "bootstrap.frame is 12"),
    rate_of_another_take: ("warning", "fps_differs", "30 in the capture, but the clip has 24"),
    offset_beyond: ("error", "offset_wrong", "offset of +4000"),
    calibration_in_metres: ("error", "cameras_together", "in metres"),
    no_calibration: ("error", "no_calibration", "neither"),
    truncated_clip: ("error", "clip", "cannot be opened"),
    damaged_scan: ("error", "mesh", "is truncated"),
    scan_in_metres: ("error", "mesh", "metres"),
    scan_apart: ("error", "scans_apart", "mm apart"),
    mandible_elsewhere: ("warning", "bone_elsewhere", "mandible is"),
    black_masks: ("warning", "masks_black", "all black"),
    masks_of_another_size: ("error", "masks", "320 x 180"),
    arches_exchanged: ("error", "masks_arches_exchanged", "exchanged"),
    cameras_exchanged: ("error", "masks_cameras_exchanged", "cameras cam1 and cam2 are"),
    pick_on_another_vertex: ("warning", "pick_wrong", "pick 1 on the upper teeth"),
}


# Faults that do not hide one another share a capture, as each check takes seconds.
@pytest.mark.slow
@pytest.mark.parametrize(
    "plants",
    [
        (frames_beyond, rate_of_another_take, scan_apart, mandible_elsewhere),
        (rest_frame_outside, pick_frame_outside, damaged_scan, masks_of_another_size),
        (scan_in_metres, truncated_clip),
        (no_calibration, black_masks, offset_beyond),
        (calibration_in_metres,),
        (arches_exchanged,),
        (cameras_exchanged, pick_on_another_vertex),
    ],
    ids=lambda plants: " ".join(plant.__name__ for plant in plants),
)
def test_each_fault_is_found_by_its_cause(capture, plants):
    for plant in plants:
        plant(capture)
    got = found(capture)
    for plant in plants:
        severity, kind, words = SAID[plant]
        matching = [f for f in got if f.kind == kind]
        assert matching and all(f.severity == severity for f in matching), plant
        assert any(words in f.line() for f in matching), plant


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes of POSIX")
@pytest.mark.parametrize(
    "names", [("video/cam1.mp4", "masks/cam2/upper.mkv", "scans/upper_teeth.ply"), ("calibration.toml",)]
)
def test_pipes_that_nobody_writes_to_are_named_and_not_waited_for(capture, names):
    for name in names:
        (capture / name).unlink()
        os.mkfifo(capture / name)
    got = []
    thread = threading.Thread(target=lambda: got.extend(found(capture)), daemon=True)
    thread.start()
    thread.join(60)
    lines = [f.line() for f in got if f.severity == "error"]
    for name in names:
        assert any(name in line and "is not a regular file" in line for line in lines), (name, lines)


@pytest.mark.slow
def test_the_reference_camera_may_lack_the_last_masks(capture):
    described(capture, 'video = "video/cam0.mp4"\n', "")
    for arch in ("upper", "lower"):
        mask_video(capture, f"cam0/{arch}.mkv", 255, count=319)
    assert "frames_missing" not in {f.kind for f in found(capture)}  # frame 319 is the last one


def test_masks_numbered_for_another_camera_are_exchanged():
    offsets = {"cam0": 0, "cam1": 4, "cam2": -3}
    right = {name: ((10 - offset, 29 - offset), None) for name, offset in offsets.items()}
    assert swapped_cameras(right, offsets, 10, 30) == []
    wrong = {**right, "cam0": right["cam2"], "cam2": right["cam0"]}
    assert swapped_cameras(wrong, offsets, 10, 30) == [("cam0", "cam2")]
    short = {**right, "cam1": ((12, 20), (12, 20)), "cam2": (None, None)}  # no swap explains that
    assert swapped_cameras(short, offsets, 10, 30) == []


def test_a_full_disk_is_told(tmp_path, monkeypatch):
    checking(monkeypatch, "the disk")
    for free, severity in ((25e6, "warning"), (5e6, "error")):
        monkeypatch.setattr(checks.shutil, "disk_usage", lambda place: type("Usage", (), {"free": free}))  # noqa: B023
        (only,) = check_capture(EXAMPLE, tmp_path / "not" / "there")
        assert (only.kind, only.severity) == ("disk_space", severity)


def test_all_faults_are_listed_at_once_and_what_they_hide_is_named(capture):
    (capture / "scans" / "skull.ply").unlink()
    (capture / "video" / "cam2.mp4").unlink()
    damaged_scan(capture)
    rest_frame_outside(capture)
    lines = [f.line() for f in found(capture)]
    for words in ("skull.ply", "cam2.mp4", "upper_teeth.ply: is truncated", "motion.rest_frame is 12"):
        assert sum(words in line for line in lines) == 1, words
    assert any("the bite: not checked" in line for line in lines)
    assert [line.split(":")[0] for line in lines] == sorted(
        (line.split(":")[0] for line in lines), key=["error", "warning", "note"].index
    )


def test_every_wrong_key_is_listed(capture):
    described(capture, "fps = 24.0", "fsp = 24.0")
    described(capture, "cols = 9", "colums = 9")
    lines = [f.line() for f in found(capture) if f.severity == "error"]
    assert any("fsp" in line for line in lines) and any("colums" in line for line in lines)


def test_missing_packages_are_named(monkeypatch):
    checking(monkeypatch, "the packages")
    monkeypatch.setattr(checks, "find_spec", lambda name: None if name in ("torch", "jinja2") else True)
    lines = [f.line() for f in found(EXAMPLE)]
    assert any("torch" in line and "jawusd[build]" in line for line in lines)
    assert any("no report" in line for line in lines)


def test_a_check_that_stumbles_is_a_finding_and_the_others_go_on(capture, monkeypatch):
    def stumbles(parts):
        raise ZeroDivisionError("planted")

    broken = tuple(checks._Check(c.what, c.needs, stumbles) if c.what == "the scans" else c for c in checks._CHECKS)
    monkeypatch.setattr(checks, "_CHECKS", broken)
    rest_frame_outside(capture)
    got = found(capture)
    assert {"check_failed", "rest_frame", "not_checked"} <= {f.kind for f in got}


@pytest.mark.slow
def test_build_refuses_with_all_errors_before_any_work(capture, tmp_path):
    scan_in_metres(capture)
    pick_frame_outside(capture)
    with pytest.raises(CaptureError, match=r"(?s)2 errors.*metres.*bootstrap\.frame|2 errors.*bootstrap.*metres"):
        build(capture, tmp_path / "out", BuildOptions())
    assert not (tmp_path / "out" / "build.json").exists()


def test_the_program_prints_findings_and_leaves_with_5(capture, monkeypatch):
    checking(monkeypatch, "the scans")
    scan_in_metres(capture)
    plain = program("check", capture)
    assert plain.returncode == 5 and "metres" in plain.stdout and "Traceback" not in plain.stderr
    as_json = program("check", capture, "--json")
    summary = json.loads(as_json.stdout)
    assert as_json.returncode == 5 and summary["errors"] == 1
    assert Finding.from_json(summary["findings"][0]).severity == "error"


def test_a_black_picture_in_between_does_not_end_the_masks(tmp_path):
    from jawusd.formats.capture_parts import CameraSource, Masks
    from jawusd.media.checks import MaskSamples

    for k in range(40):
        picture = np.zeros((90, 160), np.uint8)
        if 7 <= k <= 33 and k != 20:
            picture[20:50, 30:90] = 255
        cv2.imwrite(str(tmp_path / f"{k:06d}.png"), picture)
    masks = Masks(upper=tmp_path / "%06d.png", lower=tmp_path / "%06d.png", upper_value=255, lower_value=128)
    from contextlib import ExitStack

    with ExitStack() as files:
        sample = MaskSamples(CameraSource(name="cam", masks=masks), (160, 90), files)
        assert sample.first_last[0] == (7, 33) and sample.first_frame == 7
        assert len(sample.pixels(0, 8)) > 100 and len(sample.pixels(0, 3)) == 0


def test_nothing_is_said_of_masks_that_a_capture_does_not_have():
    capture = load_capture(EXAMPLE)
    cameras = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    assert check_capture(capture.model_copy(update={"cameras": cameras})) == []


def test_what_boards_will_tell_is_said_to_come_later(capture):
    described(capture, 'calibration = "calibration.toml"\n', "")
    (capture / "calibration.toml").unlink()
    said = [finding.message for finding in found(capture) if finding.kind == "not_checked"]
    assert said and all("the cameras will be calibrated from the boards first" in message for message in said)
