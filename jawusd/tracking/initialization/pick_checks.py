"""Check that picks agree with one another and with the masks; if not, find the mistake that explains the misfit.

Each possible mistake is corrected in turn. A mistake is reported if, once it is corrected, all picks agree and the
masks coincide with the scans at the poses from the picks.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.finding import Finding, Severity
from jawusd.geometry import transform_points
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES
from jawusd.tracking.initialization.bootstrap import FEWEST_PICKS, TOLERANCE_MM, picks_miss_mm, pose_from_picks
from jawusd.tracking.initialization.pick_causes import Mistake, Setting, possible_mistakes

_CLOSE_MM = 1.0  # maximum distance of a covered mask pixel from a projected crown point [mm]
_ON = 0.85  # minimum fraction of a camera's mask pixels on the scans for its masks to agree with the picks
# Misfit of the given inputs above which mistakes are tested [-]; exceeded by 1 in 60 valid subjects.
_SUSPECT_MISFIT = 1.7
# Maximum ratio of the misfit after correcting a mistake to that of the given inputs for the mistake to be reported [-]:
# first in general; then for mistakes whose correction makes rejected picks fit and which tracking corrects, so that
# they are only warnings.
_PROOF, _PROOF_BY_PICKS = 0.5, 0.75
# fraction of mask pixels off the scans that adds 1 to the misfit, and rms pick error [mm] that adds 1
_OFF, _MISS_MM = 0.05, 0.3
_UNSEEN = 0.25  # fraction of mask pixels off the scans that is assumed for a camera without masks in this frame
_SURE = 1.0  # misfit below which swapped inputs are reported without testing for mistakes in single cameras
_ALIKE = 0.15  # maximum difference of another mistake's misfit from the smallest one for it to be reported too
# maximum number of mistakes tested: covers 15 cameras; the 6,000 mistakes of 64 cameras would take most of an hour
_MOST_TRIED = 400

#: Returns the mask pixels of both arches in the frame of the picks, shape (N, 2) each, given the names of the camera
#: whose masks are read and of the camera whose frame numbers are used.
Seen = Callable[[str, str], tuple[Array, Array]]


def pick_findings(given: Setting, seen: Sequence[Seen], masked: Sequence[str], frame: int) -> Iterator[Finding]:
    """Yield findings about the picks of a frame, and about other inputs that the picks contradict.

    The inputs are as in the capture; `seen` has a reader of the masks of the cameras in `masked` per candidate set of
    time offsets.

    Raises:
        TrackingError: the picks contradict one another, and no single mistake explains it.
    """
    found, problem = None, None
    try:
        found = _evidence(given, seen, masked)
    except TrackingError as error:
        problem = error
    cause = None
    if found is None or not found.good or found.misfit > _SUSPECT_MISFIT:
        with contextlib.suppress(TrackingError):  # an invalid pick raises a TrackingError
            cause = _explanation(given, found, seen, masked) if _valid(given) else None
    if cause is not None:
        yield _explained(*cause, found, frame)
        yield from _rejected(cause[1], frame)
        return
    if found is None:
        raise problem or TrackingError("the picks contradict one another", frame=frame)
    yield from _rejected(found, frame)
    for name, share in found.on.items():
        if share < _ON:
            message = f"{share:.0%} of its masks lie on the scans as posed by the picks; {_ON:.0%} or more is usual"
            hint = "Check picks, masks, calibration and time offsets of this camera."
            yield Finding("masks_off_picks", "warning", message, share, _ON, camera=name, frame=frame, hint=hint)


@dataclass(frozen=True, eq=False)
class _Evidence:
    """How well picks and masks agree for given inputs."""

    poses: Array  # T_world_upper, T_world_lower, shape (2, 4, 4)
    wrong: Mapping[str, list[int]]  # numbers (from 1) of the rejected picks, by arch
    miss_mm: float  # rms error of the picks [mm], clipped at the rejection limit
    on: Mapping[str, float]  # fraction of each camera's mask pixels on the scans; cameras without masks are omitted
    unseen: int  # number of cameras without masks in this frame

    @property
    def misfit(self) -> float:
        """The total misfit of picks and masks [-]: 0.2 to 1.5 for correct inputs."""
        off = np.array([1.0 - on for on in self.on.values()] + [_UNSEEN] * self.unseen)
        return float(off.mean() if self.on else 0.0) / _OFF + self.miss_mm / _MISS_MM

    @property
    def rejected(self) -> int:
        """The number of rejected picks."""
        return sum(len(numbers) for numbers in self.wrong.values())

    @property
    def placed(self) -> bool:
        """Whether the masks of all cameras lie on the scans."""
        return all(on >= _ON for on in self.on.values())

    @property
    def good(self) -> bool:
        """Whether no contradiction remains."""
        return self.placed and not self.rejected


def _evidence(setting: Setting, seen: Sequence[Seen], masked: Sequence[str]) -> _Evidence:
    """Estimate poses from the picks, and measure how well the masks agree; raises TrackingError if the picks do not."""
    poses, wrong, misses = [], {}, []
    for picks, vertices, name in zip(setting.picks, setting.vertices, ARCH_NAMES, strict=True):
        pose, wrong[name] = pose_from_picks(picks, vertices, setting.cameras, name)
        misses.append(np.minimum(picks_miss_mm(picks, vertices, setting.cameras, pose), TOLERANCE_MM))
        poses.append(pose)
    rms = float(np.sqrt(np.mean(np.concatenate(misses) ** 2)))
    on = _covered(setting, poses, seen, masked)
    return _Evidence(np.stack(poses), wrong, rms, on, len(masked) - len(on))


def _covered(setting: Setting, poses: Sequence[Array], seen: Sequence[Seen], masked: Sequence[str]) -> dict[str, float]:
    """Return the fraction of each camera's mask pixels that lie on the scans, for the best candidate time offset."""
    on = {}
    for name in masked:
        camera = setting.cameras[name]
        points = [transform_points(pose, own) for pose, own in zip(poses, setting.crowns, strict=True)]
        depth = float(np.mean([camera.depth(own.mean(0)) for own in points]))
        if not all((camera.depth(own) > 0).all() for own in points):
            on[name] = 0.0
            continue
        trees = [cKDTree(camera.project_pinhole(own)) for own in points]
        reach_px = _CLOSE_MM * float(camera.K[0, 0]) / depth
        source, arches = setting.sources.get(name, name), (1, 0) if name in setting.exchanged else ARCHES
        shares = []
        for guess in seen:
            pixels = [camera.undistort_pixels(own) if len(own) else own for own in guess(source, name)]
            near = [trees[arches[arch]].query(pixels[arch])[0] < reach_px for arch in ARCHES if len(pixels[arch])]
            shares += [float(np.mean([own.mean() for own in near]))] if near else []
        if shares:
            on[name] = max(shares)
    return on


def _explanation(
    given: Setting, found: _Evidence | None, seen: Sequence[Seen], masked: Sequence[str]
) -> tuple[Mistake, _Evidence] | None:
    """Return the mistake that best explains the misfit, with the evidence once it is corrected, or None."""
    allowed = 0 if found is None else found.rejected
    tried: list[tuple[Mistake, _Evidence]] = []
    for mistake in islice(possible_mistakes(given), _MOST_TRIED):
        if mistake.camera is not None and any(not m.correctable and e.misfit < _SURE for m, e in tried):
            break  # only mistakes of single cameras follow, which take longest to test
        try:
            undone = _evidence(mistake.setting, seen, masked)
        except TrackingError:
            continue
        if undone.rejected <= allowed and undone.placed:
            tried.append((mistake, undone))
    if not tried:
        return None
    mistake, undone = min(tried, key=lambda one: one[1].misfit)
    if found is not None:
        by_picks = mistake.correctable and undone.rejected < found.rejected
        if undone.misfit > (_PROOF_BY_PICKS if by_picks else _PROOF) * found.misfit:
            return None
    alike = [other for other, left in tried if other is not mistake and left.misfit < undone.misfit + _ALIKE]
    if mistake.correctable and alike:
        causes = "; or else ".join(one.message for one in (mistake, *(one for one in alike if one.correctable)))
        mistake = replace(mistake, message=causes)
    return mistake, undone


def _explained(mistake: Mistake, undone: _Evidence, found: _Evidence | None, frame: int) -> Finding:
    """Return the finding that reports a mistake: a warning if tracking corrects it, otherwise an error."""
    as_given = "the picks contradict one another" if found is None else _summary(found)
    message = f"{mistake.message}; as given, {as_given}; once corrected, {_summary(undone)}"
    severity: Severity = "warning" if mistake.correctable and found is not None else "error"
    value = None if found is None else round(found.misfit, 2)
    return Finding(mistake.kind, severity, message, value, camera=mistake.camera, frame=frame, hint=mistake.hint)


def _summary(found: _Evidence) -> str:
    worst = f" and {min(found.on.values()):.0%} or more of each camera's masks lie on the scans" if found.on else ""
    return f"the picks agree to {found.miss_mm:.1f} mm{worst}"


def _rejected(found: _Evidence, frame: int) -> Iterator[Finding]:
    for arch, numbers in found.wrong.items():
        for number in numbers:
            message = f"pick {number} on the {arch} teeth does not fit the others and is ignored"
            hint = "Check its vertex, pixels and camera names."
            yield Finding("pick_wrong", "warning", message, frame=frame, hint=hint)


def _valid(given: Setting) -> bool:
    """Return whether there are enough picks, all on existing vertices and cameras."""
    for picks, vertices in zip(given.picks, given.vertices, strict=True):
        cameras = [{view.camera for view in pick.views} for pick in picks]
        known = all(len(own) >= 2 and own <= set(given.cameras) for own in cameras)
        if len(picks) < FEWEST_PICKS or not known or any(pick.vertex >= len(vertices) for pick in picks):
            return False
    return True
