"""A whole performance: the start, frame after frame both ways, back into the gaps, then all frames at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.base.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.performance import Performance
from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.performance.attempts import Attempts, FrameFit, usual_residual_px
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.forward import ForwardPass
from jawusd.tracking.performance.instant import InstantSolver, quick, whole
from jawusd.tracking.performance.instants import KeptViews, Views
from jawusd.tracking.performance.results import performance_of
from jawusd.tracking.performance.smoother import Smoothed, Smoother

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Shot:
    """Say what to solve.

    Attributes:
        views: the pictures.
        camera_names: of the pictures, in their order.
        frames: first instant of the reference camera, and one past the last.
        start_frame, start: where to begin.
        fps: frames per second.
        fixed_head: the cameras are worn: the head does not move before them.
        free_focal: the focal lengths are guesses.
    """

    views: Views
    camera_names: tuple[str, ...]
    frames: tuple[int, int]
    start_frame: int
    start: Pose
    fps: float
    fixed_head: bool = False
    free_focal: bool = False


def solve_performance(
    jaw: JawRig,
    scans: Sequence[Scan],
    shot: Shot,
    config: TrackingConfig | None = None,
    *,
    progress: Progress | None = None,
) -> Performance:
    """Solve head pose and jaw parameters of every frame of a shot.

    Args:
        jaw: the person's rig.
        scans: upper and lower teeth, prepared.
        shot: pictures, frames and where to begin.
        config: the tracker's numbers.
        progress: called with frames done and frames in all, once per frame.

    Raises:
        TrackingError: the teeth do not fit the start.
        CaptureError: a mask cannot be read.
    """
    solver = ContourSolver(scans, config or TrackingConfig())
    take = _Take(jaw, solver, shot, progress or (lambda done, total: None))
    take.first_pass()
    smoothed = take.second_pass()
    return performance_of(
        jaw,
        take.coordinates.pivot,
        sorted(take.fits),
        smoothed,
        shot.camera_names,
        shot.fps,
        free_focal=shot.free_focal,
    )


class _Take:
    """Keep the fits of all frames."""

    def __init__(self, jaw: JawRig, solver: ContourSolver, shot: Shot, progress: Progress) -> None:
        self._jaw, self._config, self._shot, self._progress = jaw, solver.config, shot, progress
        self.coordinates = Coordinates(jaw, solver.scans)
        self._quick, self._full = (InstantSolver(one, self.coordinates) for one in (quick(solver), whole(solver)))
        self._views = KeptViews(shot.views)
        self._weight = np.full(2, 1.0 / self._config.typical_noise_px3)
        self.fits: dict[int, FrameFit] = {}

    def first_pass(self) -> None:
        """Align every frame from the start on, both ways, then back into the gaps."""
        first, stop = self._shot.frames
        start = self._shot.start_frame
        attempts = Attempts(self._quick, self._weight)
        begun = attempts.near(self._shot.start, attempts.instant(self._views.at(start)))
        if not begun.found.all():
            raise TrackingError(
                "the teeth with the rig's jaw do not fit the masks where the solve begins",
                frame=start,
                hint="Check that the rig is of this person, and masks and calibration of this frame.",
            )
        self.fits[start] = begun
        for frames in (range(start + 1, stop), range(start - 1, first - 1, -1)):
            passing = ForwardPass(Attempts(self._quick, self._weight), begun, fixed_head=self._shot.fixed_head)
            for frame in frames:
                self.fits[frame] = passing.step(self._views.at(frame))
                self._progress(len(self.fits), stop - first)
        self._close_gaps()

    def _close_gaps(self) -> None:
        """Align backwards into every run of frames with something missed, from the frame after it."""
        usual = usual_residual_px(self.fits.values())
        after: ForwardPass | None = None
        for frame in sorted(self.fits, reverse=True):
            fit = self.fits[frame]
            if not fit.missed.any():
                after = None
                continue
            if after is None and frame + 1 in self.fits and self.fits[frame + 1].found.all():
                attempts = Attempts(self._quick, self._weight, usual)
                after = ForwardPass(attempts, self.fits[frame + 1], fixed_head=self._shot.fixed_head)
            if after is not None:
                again = after.step(self._views.at(frame))
                if again.found.sum() > fit.found.sum():
                    self.fits[frame] = again

    def second_pass(self) -> Smoothed:
        """Return all frames refined together."""
        frames = sorted(self.fits)
        shot, cameras = self._shot, len(self._shot.camera_names)
        smoother = Smoother(
            self._full,
            self._views,
            frames,
            shot.fps,
            cameras,
            fixed_head=shot.fixed_head,
            free_focal=shot.free_focal,
        )
        return smoother.run([self.fits[frame] for frame in frames])
