"""The committed example capture: complete, small and consistent."""

from pathlib import Path

import numpy as np
import trimesh

from jawusd.cameras.calibration import load_calibration
from jawusd.formats.capture import load_capture
from jawusd.geometry import transform_point

EXAMPLE = Path(__file__).parents[2] / "examples" / "capture"


def test_the_example_is_at_most_12_megabytes() -> None:
    assert sum(path.stat().st_size for path in EXAMPLE.rglob("*") if path.is_file()) <= 12e6


def test_the_example_is_a_whole_capture() -> None:
    capture = load_capture(EXAMPLE)
    assert len(capture.cameras) == 3 and capture.calibration is not None and capture.boards is not None
    assert capture.scans.mandible is not None and capture.scans.skull is not None
    with np.load(EXAMPLE / "truth" / "truth.npz", allow_pickle=False) as truth:
        assert capture.frames == (truth["frames"][0], truth["frames"][-1] + 1)
        assert {"open", "lateral", "protrude", "frontal border", "sagittal border", "circumduct", "chew"} <= set(
            truth["phase"].tolist()
        )


def test_the_picks_of_the_example_hit_their_vertices() -> None:
    capture = load_capture(EXAMPLE)
    cameras = {camera.name: camera for camera in load_calibration(capture.calibration)}
    with np.load(EXAMPLE / "truth" / "truth.npz", allow_pickle=False) as truth:
        row = int(np.flatnonzero(truth["frames"] == capture.bootstrap.frame)[0])
        poses = {"upper": truth["T_world_upper"][row], "lower": truth["T_world_lower"][row]}
    misses = []
    for jaw, picks in (("upper", capture.bootstrap.upper), ("lower", capture.bootstrap.lower)):
        vertices = np.asarray(trimesh.load(getattr(capture.scans, f"{jaw}_teeth"), process=False).vertices)
        for pick in picks:
            point = transform_point(poses[jaw], vertices[pick.vertex])
            misses += [cameras[view.camera].project(point) - [view.x, view.y] for view in pick.views]
    assert np.abs(misses).max() < 5.0 and 0.3 < np.std(misses) < 2.0
