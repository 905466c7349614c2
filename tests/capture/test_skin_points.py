"""Points on drawn skin, found in a frame, matched between cameras and followed."""

import numpy as np
import pytest
from skin_dots import DottedFace

from jawusd.base.errors import CaptureError
from jawusd.capture.skin_points import SkinTracker
from jawusd.geometry import make_transform, transform_points

FRAME, FRAMES = 30, 8  # while the jaw moves


def mouth(face, frame):
    """Return the pose of the anatomical axes at the upper incisal point."""
    return face.T_world_head[frame] @ make_transform(np.eye(3), face.person.landmarks[0])


def dots(face, frame):
    """Return the true positions of the dots in the world (D, 3) [mm]."""
    at = np.einsum("dk,dkj->dj", face.weights, face.vertices(frame)[face.triangles])
    return transform_points(face.T_world_head[frame], at)


def test_points_lie_on_the_skin_and_move_with_it():
    face = DottedFace(2, frames=FRAME + FRAMES, closings=())
    tracker = SkinTracker(
        tuple(face.cameras.values()), face.at(FRAME), mouth(face, FRAME), float(face.opening_mm[FRAME])
    )
    start, true = tracker.points_world, dots(face, FRAME)
    apart = np.linalg.norm(start[:, None] - true, axis=2)
    nearest = apart.argmin(axis=1)
    assert len(start) >= 30 and np.median(apart.min(axis=1)) < 0.4 and np.quantile(apart.min(axis=1), 0.9) < 1.2
    follower = tracker.follower()
    last = FRAME + FRAMES - 1
    for _, pictures in face.walk(range(FRAME + 1, last + 1)):
        found = follower.step(pictures)
    seen = np.isfinite(found[:, 0])
    moved, truly = (found - start)[seen], (dots(face, last) - true)[nearest][seen]
    assert seen.mean() > 0.85
    assert np.linalg.norm(truly, axis=1).max() > 1
    assert np.median(np.linalg.norm(moved - truly, axis=1)) < 0.15
    # a camera that drops out leaves the points that two others see, and none if only one is left
    names = list(pictures)
    assert np.isnan(follower.step({names[0]: pictures[names[0]]})).all()


def test_skin_without_texture_is_refused():
    face = DottedFace(2, frames=2, closings=(), dots=0)
    with pytest.raises(CaptureError, match="points on the skin.*at least 20 are needed.*freckles, stubble"):
        SkinTracker(tuple(face.cameras.values()), face.at(0), mouth(face, 0), float(face.opening_mm[0]))
