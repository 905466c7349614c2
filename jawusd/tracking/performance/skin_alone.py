"""Jaw parameters from facial skin alone, without images of the teeth; the pose of the head is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jawusd.evaluator import JawRig
from jawusd.formats.performance import Performance
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.coordinates import HEAD, Coordinates, Pose
from jawusd.tracking.performance.instant import InstantSolver
from jawusd.tracking.performance.results import performance_of
from jawusd.tracking.performance.skin import SkinOf
from jawusd.tracking.performance.smoother import Smoother


def solve_by_skin(jaw: JawRig, scans: Sequence[Scan], skin: SkinOf, frames: range, fps: float) -> Performance:
    """Solve the jaw parameters of every frame from facial skin.

    The head frame is used as the world frame: the head pose is the identity, without uncertainty. There are no cameras.

    Args:
        jaw: the subject's rig.
        scans: prepared scans of the upper and lower teeth.
        skin: jaw parameters estimated from facial skin.
        frames: frame numbers.
        fps: frames per second.
    """
    coordinates = Coordinates(jaw, scans)
    count, none = len(frames), np.zeros((2, 0), bool)
    fits = [FrameFit(Pose(np.eye(4), np.zeros(3)), None, none, none, np.zeros((2, 0)))] * count
    by_skin = skin(
        np.array(frames, np.float64), np.zeros((count, 3)), np.zeros(count, bool), np.tile(np.eye(4), (count, 1, 1))
    )
    instants = InstantSolver(ContourSolver(scans, TrackingConfig()), coordinates)
    smoothed = Smoother(instants, None, frames, fps, 0, skin=by_skin).run(fits)
    covariance = smoothed.covariance.copy()
    covariance[:, HEAD] = covariance[:, :, HEAD] = 0.0
    return performance_of(jaw, coordinates.pivot, frames, replace(smoothed, covariance=covariance), (), fps)
