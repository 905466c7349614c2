"""Points on the skin of a chin that follows the bone, and a motion of speech."""

import numpy as np

from jawusd.geometry import transform_points

NAMES = ("chin", "left", "right", "lip")


def skin_at(rig, d, rng):
    """Return points (F, 4, 3) that follow three quarters of the bone's motion."""
    points = rig.landmarks[0] + np.array([[0, -30, 5], [12, -28, 0], [-12, -28, 0], [0, -5, 8]])
    rest, moved = (transform_points(T, points) for T in (rig.T_rest, rig.pose(d)))
    return rest + 0.75 * (moved - rest) + rng.normal(0, 0.15, (len(d), 4, 3))


def motion(times):
    """Return d (F, 3) [mm] at times [s]."""
    opening = 9 + 4 * np.sin(2.1 * times) + 2 * np.sin(5.3 * times)
    return np.column_stack([opening, 1.5 * np.sin(3.1 * times), 0.8 + 0.5 * np.cos(2.7 * times)])
