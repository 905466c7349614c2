"""Tracking through masks that are made around guesses, and therefore tend to confirm them."""

import numpy as np
from bumpy_teeth import arch, make_cameras, render_masks, vertex_error_mm

from jawusd.formats.tracks import LOST
from jawusd.geometry import se3_exp
from jawusd.tracking.guided import GuidedTracker
from jawusd.tracking.history import Past
from jawusd.tracking.solver import View

MESHES = (arch(True), arch(False))
CAMERAS = make_cameras()
HIDDEN = range(22, 27)  # frames in which lips hide the lower row while it goes down by 6 mm
NEAR_MM = 2.0  # how far off a guess may be for its masks to be the true ones


def pose_at(frame):
    """Return T_world_upper, T_world_lower of a still head whose jaw opens and closes, shape (2, 4, 4)."""
    opening = 7.0 - 6.0 * np.cos(0.3 * frame)
    return np.stack([np.eye(4), se3_exp([0.012 * opening, 0, 0, 0, -0.8 * opening, 0.1 * opening])])


def lower_error_mm(frame, poses):
    return vertex_error_mm(MESHES[1], poses[1], pose_at(frame)[1])


def see(frame, poses, turn):
    """Return the true masks if the guess is near the truth; else masks that look just like the guess."""
    shown = pose_at(frame) if lower_error_mm(frame, poses) < NEAR_MM else np.stack([pose_at(frame)[0], poses[1]])
    present = np.array([True, frame not in HIDDEN])
    masks = [render_masks(MESHES, shown, camera, fine=1) for camera in CAMERAS]
    return [View(c.projection_matrix(), c.centre_world(), m, present) for c, m in zip(CAMERAS, masks, strict=True)]


def followed(agreement):
    """Return the errors of the lower row by frame [mm], and which frames were lost."""
    tracker = GuidedTracker(*MESHES, see, agreement, 2)
    past = [Past.of(tracker.begin(0, pose_at(0)))]
    found = list(tracker.follow(range(1, 32), past))
    return (
        {frame: lower_error_mm(frame, record.solution.poses) for frame, record in found},
        {frame for frame, record in found if record.status[1] == LOST},
    )


def test_a_jaw_that_moved_behind_lips_is_found_again_by_colours():
    errors, lost = followed(lambda frame, guesses: 100.0 - np.array([lower_error_mm(frame, g) for g in guesses]))
    assert lost == set(HIDDEN)
    assert max(errors[frame] for frame in errors if frame not in lost) < 0.3
    assert max(errors[frame] for frame in lost) < NEAR_MM  # carried along
    errors, _ = followed(lambda frame, guesses: np.ones(len(guesses)))  # colours that say nothing
    assert errors[27] > NEAR_MM
