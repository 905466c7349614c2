"""Tracking through masks that are made around guesses, and therefore tend to confirm them."""

import numpy as np
from bumpy_teeth import arch, make_cameras, render_masks, vertex_error_mm

from jawusd.formats.tracks import LOST
from jawusd.geometry import se3_exp
from jawusd.tracking.contour.frame_record import FrameSummary
from jawusd.tracking.contour.views import View
from jawusd.tracking.sequence.guided import GuidedTracker

MESHES = (arch(True), arch(False))
CAMERAS = make_cameras()
HIDDEN = range(22, 27)  # frames in which lips hide the lower row while it goes down by 6 mm
HALF_HIDDEN = 30  # a frame in which one camera does not see it: something is amiss
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
    masks = [render_masks(MESHES, shown, camera, fine=1) for camera in CAMERAS]
    seen = [frame not in HIDDEN and (k != 1 or frame != HALF_HIDDEN) for k in range(len(CAMERAS))]
    return [
        View(c.projection_matrix(), c.centre_world(), m, np.array([True, s]))
        for c, m, s in zip(CAMERAS, masks, seen, strict=True)
    ]


def followed(agreement):
    """Return the errors of the lower row by frame [mm], which frames were lost, and where it was found again."""
    tracker = GuidedTracker(*MESHES, see, agreement, 2)
    past = [FrameSummary.of(tracker.begin(0, pose_at(0)))]
    found = list(tracker.follow(range(1, 32), past))
    return (
        {frame: lower_error_mm(frame, record.solution.poses) for frame, record, _ in found},
        {frame for frame, record, _ in found if record.status[1] == LOST},
        [frame for frame, _, again in found if again],
    )


def test_a_jaw_that_moved_behind_lips_is_found_again_by_colours():
    errors, lost, again = followed(lambda frame, guesses: 100.0 - np.array([lower_error_mm(frame, g) for g in guesses]))
    assert lost == set(HIDDEN) and again == []  # it never went astray
    assert max(errors[frame] for frame in errors if frame not in lost) < 0.3
    assert max(errors[frame] for frame in lost) < NEAR_MM  # carried along


def test_a_jaw_gone_astray_is_noticed_where_it_is_found():
    def agreement(frame, guesses):  # colours say nothing until then
        misses = [lower_error_mm(frame, guess) for guess in guesses]
        return np.ones(len(guesses)) if frame <= HALF_HIDDEN else 100.0 - np.array(misses)

    errors, _, again = followed(agreement)
    assert errors[27] > NEAR_MM and errors[HALF_HIDDEN] > NEAR_MM
    assert again == [HALF_HIDDEN + 1] and errors[HALF_HIDDEN + 1] < 0.3
