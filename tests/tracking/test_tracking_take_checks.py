"""What a take tells of lenses, scan sizes and times: planted errors are measured, right captures are not accused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jawusd.formats.capture import load_capture
from jawusd.geometry import transform_point
from jawusd.pipeline.prepare import load_cameras, load_meshes
from jawusd.synthetic.short_capture import ShortConfig, write_short_capture
from jawusd.tracking import TrackingConfig
from jawusd.tracking.contour.scan import prepare_scan
from jawusd.tracking.contour.views import MaskViews, View, present_masks
from jawusd.tracking.initialization.magnification import Magnification, magnified, measure_magnification
from jawusd.tracking.sequence.take_checks import _largest_step, lens_findings

NAMES = ("cam0", "cam1", "cam2")


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("person")
    write_short_capture(folder, ShortConfig(3, frames=8))
    return folder


def measured(folder: Path, change, size: float = 1.0) -> Magnification:
    """Measure at the true poses, with cameras changed and scans of another size."""
    described = load_capture(folder)
    meshes = load_meshes(described)
    scans = []
    for row in ("upper", "lower"):
        mesh = meshes[f"{row}_teeth"]
        scans.append(prepare_scan(replace(mesh, vertices=size * mesh.vertices), row))
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as truth:
        poses = np.stack([truth["T_world_upper"], truth["T_world_lower"]], 1)
        frames = truth["frames"]
    for r, scan in enumerate(scans):  # grow about the middle of the teeth
        poses[:, r, :3, 3] += (1.0 - size) * poses[:, r, :3, :3] @ scan.centre / size
    cameras = {c.name: change(c) for c in load_cameras(described)}
    centre = np.mean([transform_point(poses[0, r], scans[r].centre) for r in (0, 1)], axis=0)
    config, instants = TrackingConfig(), []
    with MaskViews(described.cameras, cameras, described.sync.offsets, centre, config.working_px_per_mm) as masks:
        for k in range(1, len(frames), 2):
            views = masks.at(int(frames[k]))
            instants.append((poses[k], views, present_masks(views)))
        return measure_magnification(scans, instants, config)


def test_right_captures_are_not_accused(capture: Path) -> None:
    found = measured(capture, lambda c: c)
    assert np.abs(found.scale).max() < 0.01 and np.abs(found.bend).max() < 0.004
    assert lens_findings(NAMES, found) == []


def test_a_wrong_focal_length_is_named_with_its_camera_and_size(capture: Path) -> None:
    def longer(camera):
        K = camera.K * [[1.05, 1, 1], [1, 1.05, 1], [1, 1, 1]]
        return replace(camera, K=K) if camera.name == "cam1" else camera

    (finding,) = (f for f in lens_findings(NAMES, measured(capture, longer)) if f.kind == "focal_length")
    assert finding.camera == "cam1" and finding.value == pytest.approx(-100 * (1 - 1 / 1.05), abs=1.2)


def test_scans_of_a_wrong_size_are_named(capture: Path) -> None:
    kinds = {f.kind: f for f in lens_findings(NAMES, measured(capture, lambda c: c, size=1.04))}
    assert set(kinds) == {"scan_size"}
    assert kinds["scan_size"].value == pytest.approx(-4.0, abs=1.5)


def test_a_wrong_distortion_is_named(capture: Path) -> None:
    def bent(camera):
        # 1.2 % at 25 mm from the axis
        k1 = 0.012 / (25.0 / 300.0) ** 2
        return replace(camera, distortion=camera.distortion + [k1, 0, 0, 0, 0]) if camera.name == "cam0" else camera

    kinds = [(f.kind, f.camera) for f in lens_findings(NAMES, measured(capture, bent))]
    assert ("lens_distortion", "cam0") in kinds


def test_magnified_views_grow_about_the_optical_axis() -> None:
    K = np.array([[900.0, 0.0, 320.0], [0.0, 900.0, 200.0], [0.0, 0.0, 1.0]])
    view = View(K @ np.eye(3, 4), np.zeros(3), np.zeros((2, 4, 4), np.uint8), np.ones(2, bool))
    point = magnified(view, 0.1).matrix @ [10.0, -5.0, 300.0, 1.0]
    np.testing.assert_allclose(point[:2] / point[2], [320.0 + 1.1 * 30.0, 200.0 - 1.1 * 15.0])


def test_the_clearest_step_of_a_series_is_found() -> None:
    values = np.array([0.05, -0.02, 0.03, 1.02, 0.97, 1.01])
    step, sigma, at = _largest_step(values, np.full(6, 0.05))
    assert at == 3 and step == pytest.approx(0.98, abs=0.05) and sigma < 0.05
    step, sigma, _ = _largest_step(np.zeros(4), np.full(4, 0.1))
    assert abs(step) < sigma
