"""Head and jaw of a subject with a rig in images without masks: recorded takes, solved jointly, and live tracking."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import SkinJaw
from jawusd.formats.performance import Performance
from jawusd.geometry import Camera, transform_points
from jawusd.tracking.contour.annotator import AnnotatorPrior
from jawusd.tracking.contour.quality import residual_px, score_px
from jawusd.tracking.contour.scan import Scan, teeth_centre, thinned
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.follow import Begin, TwoWays, both_ways
from jawusd.tracking.initialization.magnification import zoomed
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.coordinates import JAW, Coordinates, Pose
from jawusd.tracking.performance.instant import InstantSolver, rig_gain
from jawusd.tracking.performance.motion import KNOWN, STEADY
from jawusd.tracking.performance.results import performance_of
from jawusd.tracking.performance.skin import SkinOf, jaw_of_skin
from jawusd.tracking.performance.smoother import VARIANCE_RATIO, Smoothed, Smoother, with_one_head
from jawusd.tracking.region.appearance import CORRELATION_PX, Cut, LearnedColours
from jawusd.tracking.region.rig_tracker import FOR_RIGS, RigTracker
from jawusd.tracking.region.search import FACES, FAST, REDRAW_PX, SAMPLE_STEP_PX

#: Function that returns the cropped images of a range of frames. Arguments: cameras, possibly with changed focal
#: lengths; a world point near the teeth, which determines the resolution [mm], shape (3,); and the frames.
Cuts = Callable[[Sequence[Camera], Array, range], Iterator[Cut]]
#: Function that searches for the teeth in some frames; returns a frame and the pose in it. The second argument is the
#: up direction of the head in the world, shape (3,). Raises TrackingError.
Find = Callable[[range, Array], tuple[int, Pose]]
Progress = Callable[[int, int], None]

# Number of crown faces in the last step; pose update below which intermediate gates are skipped [mm].
_LAST_FACES, _SETTLED_MM = 20_000, 0.08
# Number of frames from which a fixed head pose and unknown focal lengths are estimated in advance, and number of rounds
# for focal lengths.
_FIRST_FRAMES, _FOCAL_ROUNDS = 120, 3
# Prior on the offsets between colour borders and tooth edges in a take. Teeth darken towards their edges, so borders
# lie up to half a pixel inside; gum-line offsets are learned while tracking.
_BORDERS = AnnotatorPrior(common=(0.0, 0.0, 0.0), arch=(0.4, 0.08, 0.02), camera=(0.0, 0.0), frames=5.0)
# Variance times correlation length of errors that neighbouring borders share, such as shading, in addition to that of
# the residuals [px^3]. Of rendered subjects, residuals of 0.18 px have a correlation length of 8 px, but the poses are
# off as if it were 80 px. Of path-traced ones, residuals of 0.4 to 1.1 px add noise with the same length.
_SHARED_PX3 = 2.6
# With one camera, poses of single frames are off by millimetres along the view, so that their contours are matched at
# wrong distances. Maximum number of rounds in which they are matched again at the smoothed poses of the take, and
# change of d below which the rounds end [mm].
_AGAIN_ALONE, _UNCHANGED_MM = 6, 0.1
_OFF_MM = 1.0  # possible error of an unconfirmed pose next to lost frames above which the pose is left out
_CLEARLY = 1.05  # minimum ratio of matched contour for another pose to replace a trusted one


@dataclass(frozen=True, eq=False)
class PictureShot:
    """Input of a solve."""

    cuts: Cuts  # returns the cropped images
    find: Find  # searches for the teeth
    cameras: Sequence[Camera]  # cameras in the order of the images
    frames: range  # frame numbers of the reference camera
    fps: float
    fixed_head: bool = False  # whether the cameras are head-mounted, so that the head pose is constant
    free_focal: bool = False  # whether to estimate the focal lengths
    skin: SkinOf | None = None  # jaw parameters estimated from facial skin, if known


class PictureTake:
    """Solves a shot from the colours of its images."""

    def __init__(
        self,
        jaw: JawRig,
        scans: Sequence[Scan],
        axes: Array,
        shot: PictureShot,
    ) -> None:
        """Prepare both scans; `axes` is the rotation from scan to anatomical axes: left, up, front; shape (3, 3)."""
        self._axes, self._jaw, self._shot = axes, jaw, shot
        self._scans = [thinned(scan, _LAST_FACES) for scan in scans]
        self.coordinates = Coordinates(jaw, self._scans)
        config = replace(FOR_RIGS, sample_step_px=SAMPLE_STEP_PX, redraw_px=REDRAW_PX, settled_mm=_SETTLED_MM)
        self._instants, self._rough = (
            InstantSolver(ContourSolver([thinned(scan, faces) for scan in scans], config), self.coordinates)
            for faces in (_LAST_FACES, FACES)
        )

    def begun(self, frame: int, near: Pose) -> tuple[Pose, float]:
        """Return the pose in a frame near a guess, and its `RigTracker.first_fit`, 0 .. 1; errors as for `solve`."""
        tracker, fit = self._began(self._shot.cameras, 1.0, frame, near, searched=True)
        return fit.pose, tracker.first_fit

    def solve(self, frame: int, start: Pose, progress: Progress = lambda done, total: None) -> Performance:
        """Solve head pose and jaw parameters of every frame, from an initial frame and pose.

        Raises:
            CaptureError: an image cannot be decoded.
        """
        shot = self._shot
        cameras, start, factors = self._known_before(frame, start, progress)
        head = KNOWN if shot.fixed_head else 1.0
        fits = self._follow(cameras, (frame, start), shot.frames, head, progress, recover=True)
        smoothed = self._smoothed(shot.frames, fits, jaw_of_skin(shot.skin, shot.frames, fits))
        for _ in range(_AGAIN_ALONE if len(cameras) == 1 else 0):
            before = _parameters(smoothed)
            fits = self._again(cameras, head, frame, smoothed.fits, progress)
            smoothed = self._smoothed(shot.frames, fits, jaw_of_skin(shot.skin, shot.frames, fits))
            if np.abs(_parameters(smoothed) - before).max() < _UNCHANGED_MM:
                break
        if shot.free_focal:
            log_focal = smoothed.state.log_focal + np.log(factors)
            smoothed = replace(smoothed, state=replace(smoothed.state, log_focal=log_focal))
        names, pivot = tuple(camera.name for camera in cameras), self.coordinates.pivot
        return performance_of(self._jaw, pivot, shot.frames, smoothed, names, shot.fps, free_focal=shot.free_focal)

    def _known_before(self, at: int, start: Pose, progress: Progress) -> tuple[Sequence[Camera], Pose, Array]:
        """Return cameras, start pose, and focal-length factors (C,); unknown ones are estimated from some frames."""
        shot = self._shot
        cameras, factors = shot.cameras, np.ones(len(shot.cameras))
        rounds = _FOCAL_ROUNDS if shot.free_focal else int(shot.fixed_head)
        first = max(shot.frames.start, min(at, shot.frames.stop - _FIRST_FRAMES))
        some = range(first, min(first + _FIRST_FRAMES, shot.frames.stop))
        for round_ in range(rounds):
            head = STEADY if shot.fixed_head and round_ == 0 else KNOWN if shot.fixed_head else 1.0
            fits = self._follow(cameras, (at, start), some, head, progress)
            if head == STEADY:
                fits = with_one_head(self.coordinates, fits)
            elif shot.free_focal:
                smoothed = self._smoothed(some, fits)
                fits, growth = smoothed.fits, np.exp(smoothed.state.log_focal)
                factors = factors * growth
                cameras = [zoomed(camera, float(f)) for camera, f in zip(cameras, growth, strict=True)]
            start = fits[some.index(at)].pose
        return cameras, start, factors

    def _begin(self, cameras: Sequence[Camera], head: float, at: int, near: Pose) -> Begin[FrameFit]:
        """Return the fit of a frame near a guess, from which a take can be followed."""
        tracker, fit = self._began(cameras, head, at, near)

        def follow(way: range, begin: FrameFit) -> Iterator[FrameFit]:
            return map(tracker.reversed_from(begin).step, self._shot.cuts(cameras, self._centre(begin.pose), way))

        return Begin(at, fit, follow)

    def _began(
        self, cameras: Sequence[Camera], head: float, at: int, near: Pose, searched: bool = False
    ) -> tuple[RigTracker, FrameFit]:
        """Return a tracker that begins in a frame near a guess, and the fit of that frame; see `RigTracker.begin`."""
        colours = LearnedColours(self._scans, cameras, self._axes)
        tracker = RigTracker(self._rough, colours, head=head, free_focal=self._shot.free_focal, whole=self._instants)
        cut = next(self._shot.cuts(cameras, self._centre(near), range(at, at + 1)))
        return tracker, tracker.begin(cut, near, searched=searched)

    def _centre(self, pose: Pose) -> Array:
        return teeth_centre(self._scans, self.coordinates.arches(pose))

    def _follow(
        self,
        cameras: Sequence[Camera],
        start: tuple[int, Pose],
        frames: range,
        head: float,
        progress: Progress,
        recover: bool = False,
    ) -> list[FrameFit]:
        """Return the fits of frames, tracked from an initial pose in both directions.

        If `recover`, teeth that stay lost are searched for, and unconfirmed poses next to lost frames are left out.
        """

        def search(lost: range, near: FrameFit) -> Begin[FrameFit]:
            return self._begin(cameras, head, *self._shot.find(lost, near.pose.head[:3, :3] @ self._axes[1]))

        take = TwoWays(frames, self._places, _fitting_px, _CLEARLY, at_once=True, progress=progress)
        begin = self._begin(cameras, head, *start)
        take.follow(begin)
        if recover:
            take.recover(search)
            for frame, least_mm in take.unconfirmed(begin.follow).items():
                if least_mm > _OFF_MM:
                    take.known[frame] = replace(take.known[frame], use=np.zeros_like(take.known[frame].use))
        return [take.known[frame] for frame in frames]

    def _again(
        self, cameras: Sequence[Camera], head: float, start: int, fits: Sequence[FrameFit], progress: Progress
    ) -> list[FrameFit]:
        """Return the fits of all frames, aligned again from smoothed fits; colours are learned in frame `start`."""
        shot = self._shot
        smoothed, found = dict(zip(shot.frames, fits, strict=True)), dict[int, FrameFit]()
        tracker, begin = self._began(cameras, head, start, smoothed[start].pose)
        for way in both_ways(start, shot.frames):
            one_way, frames = tracker.reversed_from(begin), range(start, way.stop, way.step)
            for frame, cut in zip(frames, shot.cuts(cameras, self._centre(begin.pose), frames), strict=True):
                found[frame] = one_way.again(cut, smoothed[frame])
                progress(len(found), len(fits))
        return [found[frame] for frame in shot.frames]

    def _places(self, fit: FrameFit) -> Array:
        return transform_points(self._jaw.pose(fit.pose.d), self._scans[1].probes)

    def _smoothed(self, frames: range, fits: Sequence[FrameFit], skin: SkinJaw | None = None) -> Smoothed:
        """Refine all frames jointly."""
        shot = self._shot
        smoother = Smoother(
            self._instants,
            None,
            frames,
            shot.fps,
            len(shot.cameras),
            fixed_head=shot.fixed_head,
            free_focal=shot.free_focal,
            shared_px3=_SHARED_PX3,
            annotator=_BORDERS,
            skin=skin,
        )
        return smoother.run(fits)


def _parameters(smoothed: Smoothed) -> Array:
    """Return the jaw parameters of all frames [mm], shape (F, 3)."""
    return np.stack([fit.pose.d for fit in smoothed.fits])


def _fitting_px(fit: FrameFit) -> float:
    return 0.0 if fit.solution is None else float(score_px(fit.solution).sum())


# Number of crown faces and settings, which are coarser than for recorded images, since dropped frames reduce accuracy
# more than coarse settings.
_LIVE_FACES = 3_000
_LIVE_SETTINGS = replace(FOR_RIGS, sample_step_px=3.0, redraw_px=4.0, parallax_px=6.0, settled_mm=0.4, judged_mm=0.3)


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
        """Prepare both scans; arguments are as for `PictureTake` and `PictureShot`, `executor` matches contours."""
        self._scans, self._axes, self._cameras = [thinned(scan, _LIVE_FACES) for scan in scans], axes, cameras
        self._head = STEADY if fixed_head else 1.0
        self.coordinates = Coordinates(jaw, self._scans)
        self._instants = InstantSolver(ContourSolver(self._scans, _LIVE_SETTINGS, executor), self.coordinates)
        self._tracker: RigTracker | None = None

    def begin(self, cut: Cut, near: Pose) -> float:
        """Learn the colours of a frame near a pose; return its `RigTracker.first_fit`, 0 .. 1.

        The other methods raise ValueError before.
        """
        colours = LearnedColours(self._scans, self._cameras, self._axes)
        self._tracker = RigTracker(self._instants, colours, head=self._head, effort=FAST)
        self._tracker.begin(cut, near, searched=True)
        return self._tracker.first_fit

    def _begun(self, method: str) -> RigTracker:
        if self._tracker is None:
            raise ValueError(f"`{method}` was called before `begin`")
        return self._tracker

    def step(self, cut: Cut, frames: float = 1.0) -> FrameFit:
        """Align the images taken `frames` frames after the previous ones."""
        return self._begun("step").step(cut, frames)

    def carry(self, d: Array, covariance: Array) -> None:
        """Start the next step from d (3,) [mm] with covariance (3, 3) [mm^2], as after a frame with hidden teeth."""
        self._begun("carry").carry(d, np.diag(covariance) / VARIANCE_RATIO)

    def covariance_d(self, fit: FrameFit) -> Array:
        """Return the covariance of the jaw parameters d in the last step [mm^2], including the rig error (3, 3)."""
        precision, of_rig = np.diag(self._begun("covariance_d").expected.precision), np.zeros((3, 3))
        if fit.solution is not None and fit.found.any():
            weight = np.where(fit.found, 1.0 / (residual_px(fit.solution) ** 2 * CORRELATION_PX), 0.0)
            outlines = self._instants.outline_equations(fit.pose, fit.solution, weight)
            precision = precision + outlines.matrix
            gain = rig_gain(self.coordinates, fit.pose, precision, outlines.misfit.precision)
            of_rig = gain @ self.coordinates.jaw.pose_covariance(fit.pose.d) @ gain.T
        return np.asarray(VARIANCE_RATIO * np.linalg.inv(precision)[JAW, JAW] + of_rig, np.float64)
