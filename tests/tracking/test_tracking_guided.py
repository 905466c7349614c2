"""Tracking with masks made around poses found by colour."""

import numpy as np
from bumpy_teeth import arch, make_cameras, render_masks, vertex_error_mm

from jawusd.formats.tracks import LOST
from jawusd.geometry import se3_exp
from jawusd.tracking.contour.frame_record import FrameSummary
from jawusd.tracking.contour.views import View
from jawusd.tracking.sequence.guided import GuidedTracker

MESHES = (arch(True), arch(False))
CAMERAS = make_cameras()
HIDDEN = range(4, 6)  # frames in which lips hide the lower row
FRAMES = 8
GUIDE_ERROR = se3_exp([0.01, 0, 0, 0.2, 0.3, -0.2])


def pose_at(frame):
    """Return T_world_upper, T_world_lower of a still head whose jaw opens, shape (2, 4, 4)."""
    opening = 1.5 * frame
    return np.stack([np.eye(4), se3_exp([0.012 * opening, 0, 0, 0, -0.8 * opening, 0.1 * opening])])


def see(frame, poses, turn):
    masks = [render_masks(MESHES, pose_at(frame), camera, fine=1) for camera in CAMERAS]
    present = np.array([True, frame not in HIDDEN])
    return [View(c.projection_matrix(), c.centre_world(), m, present) for c, m in zip(CAMERAS, masks, strict=True)]


def test_masks_correct_the_guide_and_lost_arches_keep_its_poses():
    guide = {frame: np.stack([GUIDE_ERROR, GUIDE_ERROR]) @ pose_at(frame) for frame in range(FRAMES)}
    tracker = GuidedTracker(*MESHES, see, 2)
    past = [FrameSummary.of(tracker.begin(0, guide[0]))]
    found = dict(tracker.follow(range(1, FRAMES), guide, past))
    assert {frame for frame, record in found.items() if record.status[1] == LOST} == set(HIDDEN)
    for frame, record in found.items():
        errors = [vertex_error_mm(MESHES[r], record.solution.poses[r], pose_at(frame)[r]) for r in (0, 1)]
        assert errors[0] < 0.1 and (frame in HIDDEN or errors[1] < 0.1)
        if frame in HIDDEN:
            np.testing.assert_array_equal(record.solution.poses[1], guide[frame][1])
