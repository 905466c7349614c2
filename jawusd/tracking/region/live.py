"""Live tracking of head and jaw of a known subject."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.geometry import Camera
from jawusd.tracking.contour.quality import residual_px
from jawusd.tracking.contour.scan import Scan, thinned
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.coordinates import JAW, Coordinates, Pose
from jawusd.tracking.performance.instant import InstantSolver, rig_gain
from jawusd.tracking.performance.motion import STEADY
from jawusd.tracking.performance.smoother import VARIANCE_RATIO
from jawusd.tracking.region.appearance import CORRELATION_PX, Cut, LearnedColours
from jawusd.tracking.region.effort import FAST
from jawusd.tracking.region.rig_tracker import FOR_RIGS, RigTracker

_FACES = 3_000
# The settings are coarser than for recorded images, since dropped frames reduce accuracy more than coarse settings.
_SETTINGS = replace(FOR_RIGS, sample_step_px=3.0, redraw_px=4.0, parallax_px=6.0, settled_mm=0.4, judged_mm=0.3)


class LiveTake:
    """Live tracker of head and jaw of a subject with a known rig; `coordinates` convert its poses."""

    def __init__(
        self,
        jaw: JawRig,
        scans: Sequence[Scan],
        axes: Array,
        cameras: Sequence[Camera],
        *,
        fixed_head: bool = False,
        executor: Executor | None = None,
    ) -> None:
        """Prepare the scans for tracking.

        Args:
            jaw: the subject's rig.
            scans: upper and lower teeth, prepared.
            axes: rotation from scan to anatomical axes: left, up, front; shape (3, 3).
            cameras: cameras in the order of the images.
            fixed_head: whether the cameras are head-mounted, so that the head hardly moves relative to them.
            executor: thread pool in which the contours of all cameras are matched in parallel.
        """
        self._scans, self._axes, self._cameras = [thinned(scan, _FACES) for scan in scans], axes, cameras
        self._head = STEADY if fixed_head else 1.0
        self.coordinates = Coordinates(jaw, self._scans)
        self._instants = InstantSolver(ContourSolver(self._scans, _SETTINGS, executor), self.coordinates)
        self._tracker: RigTracker | None = None

    def begin(self, cut: Cut, near: Pose) -> float:
        """Learn the colours of a frame near a pose; return its `RigTracker.first_fit`, 0 .. 1."""
        colours = LearnedColours(self._scans, self._cameras, self._axes)
        self._tracker = RigTracker(self._instants, colours, head=self._head, effort=FAST)
        self._tracker.begin(cut, near, searched=True)
        return self._tracker.first_fit

    def step(self, cut: Cut, frames: float = 1.0) -> FrameFit:
        """Align the images taken `frames` frames after the previous ones.

        Raises:
            ValueError: `begin` was not called.
        """
        if self._tracker is None:
            raise ValueError("`step` was called before `begin`")
        return self._tracker.step(cut, frames)

    def carry(self, d: Array, covariance: Array) -> None:
        """Replace d of a frame with hidden teeth, from which the next step starts.

        Args:
            d: jaw parameters [mm], shape (3,).
            covariance: their covariance [mm^2], shape (3, 3).

        Raises:
            ValueError: `begin` was not called.
        """
        if self._tracker is None:
            raise ValueError("`carry` was called before `begin`")
        self._tracker.carry(d, np.diag(covariance) / VARIANCE_RATIO)

    def covariance_d(self, fit: FrameFit) -> Array:
        """Return the covariance of the jaw parameters d in the last step [mm^2], including the rig error (3, 3).

        Raises:
            ValueError: `begin` was not called.
        """
        if self._tracker is None:
            raise ValueError("the covariance was requested before `begin` was called")
        precision, of_rig = np.diag(self._tracker.expected.precision), np.zeros((3, 3))
        if fit.solution is not None and fit.found.any():
            weight = np.where(fit.found, 1.0 / (residual_px(fit.solution) ** 2 * CORRELATION_PX), 0.0)
            outlines = self._instants.outline_equations(fit.pose, fit.solution, weight)
            precision = precision + outlines.matrix
            gain = rig_gain(self.coordinates, fit.pose, precision, outlines.misfit.precision)
            of_rig = gain @ self.coordinates.jaw.pose_covariance(fit.pose.d) @ gain.T
        return np.asarray(VARIANCE_RATIO * np.linalg.inv(precision)[JAW, JAW] + of_rig, np.float64)
