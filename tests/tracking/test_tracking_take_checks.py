"""Errors of calibration and synchronisation found in a tracked take."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small_take import CAMERAS, FIRST, LANDMARKS, MESHES, OFFSETS, errors_mm, make_capture, track, write_masks

from jawusd.tracking import track_capture
from jawusd.tracking.contour.equations import OutlineSums
from jawusd.tracking.initialization.magnification import Magnification
from jawusd.tracking.sequence.take_checks import OF_COLOURS, OF_MASKS, lens_findings, misfit_findings

FRAMES = 16


@pytest.fixture(scope="module")
def capture(clean_take):
    return clean_take[0]


def _kinds(tracks):
    return {(found["kind"], found.get("camera")) for found in tracks.meta["findings"]}


def test_a_good_take_has_no_findings(clean_take):
    timely = {"camera_late", "frame_dropped", "camera_moved", "focal_length", "scan_size", "lens_distortion"}
    timely |= {"scans_mirrored"}
    assert not timely & {kind for kind, _ in _kinds(clean_take[1])}


@pytest.mark.slow
def test_a_camera_a_frame_late_is_reported_and_corrected(tmp_path):
    late = make_capture(write_masks(tmp_path / "late", FRAMES, delays=(0.0, 1.0, 0.0)), FRAMES)
    tracks = track(late)
    assert ("camera_late", "cam1") in _kinds(tracks)
    assert tracks.meta["delays_frames"]["cam1"] == pytest.approx(1.0, abs=0.05)
    assert not tracks.meta["extrinsics"]["corrected"]
    assert errors_mm(tracks, raw=True)[1:-1].mean() < 0.06


@pytest.mark.slow
def test_a_frame_dropped_within_a_take_is_reported(tmp_path):
    folder = write_masks(tmp_path / "take", FRAMES + 1)
    for row in ("upper", "lower"):
        files = sorted((folder / "cam1" / row).glob("*.png"))
        for earlier, later in zip(files[8:-1], files[9:], strict=True):
            later.rename(earlier)
    found = track(make_capture(folder, FRAMES)).meta["findings"]
    (dropped,) = [f for f in found if f["kind"] == "frame_dropped"]
    assert dropped["camera"] == "cam1" and abs(dropped["frame"] - (5 + 8)) <= 2


@pytest.mark.slow
def test_a_wrong_focal_length_is_named(capture):
    K = CAMERAS[2].K.copy()
    K[0, 0], K[1, 1] = 1.05 * K[0, 0], 1.05 * K[1, 1]
    wrong = [*CAMERAS[:2], replace(CAMERAS[2], K=K)]
    few = capture.model_copy(update={"frames": (FIRST, FIRST + 8)})  # as many as the check looks at
    tracks = track_capture(few, wrong, OFFSETS, *MESHES, LANDMARKS)
    assert ("focal_length", "cam2") in _kinds(tracks)
    (value,) = [f["value"] for f in tracks.meta["findings"] if f["kind"] == "focal_length"]
    assert value == pytest.approx(-100 * 0.05 / 1.05, abs=1.0)  # seen smaller than expected


@pytest.mark.slow
def test_scans_of_a_wrong_size_are_named(capture):
    larger = [replace(mesh, vertices=1.03 * mesh.vertices) for mesh in MESHES]
    tracks = track_capture(capture, CAMERAS, OFFSETS, *larger, LANDMARKS)
    assert "scan_size" in {kind for kind, _ in _kinds(tracks)}
    assert np.isfinite(tracks.T_upper_lower).all()


@pytest.mark.slow
def test_mirrored_scans_are_named(capture):
    hand = np.array([-1.0, 1.0, 1.0])
    mirrored = [replace(mesh, vertices=hand * mesh.vertices, faces=mesh.faces[:, ::-1]) for mesh in MESHES]
    unpicked = capture.model_copy(update={"bootstrap": None})
    tracks = track_capture(unpicked, CAMERAS, OFFSETS, *mirrored, LANDMARKS)
    assert ("scans_mirrored", None) in _kinds(tracks) and np.isfinite(tracks.T_upper_lower).all()


def lens_kinds(bend):
    """Return the findings if the first of three cameras magnifies side teeth."""
    bends, none, small = np.array([bend, 0.0, 0.0]), np.zeros(3), np.full(3, 1e-4)
    return _lens_kinds(Magnification(none, small, bends, small, *_masks_and_motion(none)))


def _masks_and_motion(clear):
    """Return fields for correct masks, and cameras with the given significance of motion, shape (3,)."""
    return np.zeros((3, 2)), np.full((3, 2), 0.1), np.full(3, 0.005), np.full(3, 2.0), np.array(clear, float)


def _lens_kinds(found, limits=OF_MASKS):
    return [(f.kind, f.camera) for f in lens_findings(["cam0", "cam1", "cam2"], found, limits)]


@pytest.mark.parametrize(
    ("clear", "named"),
    [
        ((4.6, 13.8, 4.9), "cam1"),  # knocked by half a degree and 2 mm
        ((10.0, 9.8, 19.0), "cam2"),
        ((9.4, 9.6, 10.6), None),  # the masks of the last one are drawn 6 px too wide
        ((2.6, 4.8, 4.5), None),
    ],
)
def test_a_knocked_camera_is_named_and_its_lens_is_not(clear, named):
    small, bend = np.full(3, 1e-4), np.array([0.0, 0.007, 0.0])  # pictures of another position seem distorted
    found = Magnification(np.zeros(3), small, bend, small, *_masks_and_motion(clear))
    bent = [] if named == "cam1" else [("lens_distortion", "cam1")]
    assert sorted(_lens_kinds(found)) == sorted(bent + ([("camera_moved", named)] if named else []))
    assert _lens_kinds(found, OF_COLOURS) == []


@pytest.mark.parametrize(
    ("bias_px", "bend", "kinds"),
    [
        ([[-0.13, -0.09], [1.88, 1.84], [-0.07, -0.20]], 0.0, ["masks_wide"]),  # by 6 px of 1080 lines
        ([[0.33, 0.35], [3.85, 2.01], [0.53, 0.23]], -0.015, ["masks_wide"]),  # by 6 px of 540 lines: no lens is wrong
        ([[0.0, 0.1], [0.22, 0.32], [0.0, 0.1]], 0.0, []),  # the most of 49 valid persons
        ([[0.0, 0.0], [1.9, -1.9], [0.0, 0.0]], 0.0, []),  # one arch wider, one narrower: the camera is off
    ],
)
def test_masks_drawn_wider_in_one_camera_are_named(bias_px, bend, kinds):
    none, small, masks = np.zeros(3), np.full(3, 1e-4), _masks_and_motion(np.zeros(3))
    found = Magnification(none, small, np.array([0.0, bend, 0.0]), small, np.array(bias_px), *masks[1:])
    assert _lens_kinds(found) == [(kind, "cam1") for kind in kinds]


def test_distortion_beyond_any_lens_is_reported_as_side_teeth():
    """Masks that end in the shadow of the cheeks shrink side teeth more than any lens."""
    assert lens_kinds(0.005) == lens_kinds(-0.005) == [("lens_distortion", "cam0")]
    assert lens_kinds(-0.03) == lens_kinds(0.03) == [("side_teeth", "cam0")]
    assert lens_kinds(-0.001) == []


def _fits(share, rough_px, frames=5):
    """Return records with given matched shares [-] and residuals [px] of both arches."""
    share, rough = np.array(share)[:, None] * np.ones(3), np.array(rough_px)[:, None] * np.ones(3)
    none, weight = OutlineSums.zeros(3), np.full((2, 3), 100.0)
    edges = none._replace(score_px=500 * share, weight=weight, square=100 * 0.828 * rough**2)
    solution = SimpleNamespace(outline=edges, visible_px=np.full((2, 3), 500.0))
    return {k: SimpleNamespace(solution=solution, found=np.ones(2, bool)) for k in range(frames)}


@pytest.mark.parametrize(
    ("share", "rough_px", "named"),
    [
        ((0.72, 0.09), (0.58, 1.23), "lower"),  # another person's lower scan
        ((0.09, 0.72), (1.23, 0.58), "upper"),
        ((0.55, 0.30), (0.57, 0.56), None),  # lips over the lower teeth
        ((0.72, 0.09), (0.58, 0.60), None),  # barely visible
        ((0.48, 0.56), (0.29, 0.47), None),
    ],
)
def test_a_scan_that_barely_fits_is_reported(share, rough_px, named):
    found = misfit_findings(_fits(share, rough_px))
    assert [(f.kind, f.message.split(" scan")[0]) for f in found] == (
        [] if named is None else [("scan_misfit", f"the {named}")]
    )
    assert not misfit_findings(_fits(share, rough_px, 2))
