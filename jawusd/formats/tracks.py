"""Tracked poses of both arches: `tracks.npz`, format jawusd-tracks/1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import cast

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, FormatError
from jawusd.base.npz import fields_of_shapes, read_npz, take
from jawusd.formats.atomic import write_described_npz
from jawusd.formats.notes import TracksMeta, check_notes
from jawusd.formats.performance import SolvedJaw, take_solved
from jawusd.geometry import LANDMARKS, rigidity_defect

FAMILY, VERSION = "jawusd-tracks", 1
_APART_S = 0.5  # minimum time between chosen frames, since adjacent frames have the same problems


class TrackStatus(IntEnum):
    """Values of `Tracks.status`."""

    LOST = 0
    TRACKED = 1
    RECOVERED = 2  # tracked again after a loss
    PARTIAL = 3  # tracked without one of the cameras

    def __str__(self) -> str:
        return self.name.lower()


LOST, TRACKED, RECOVERED, PARTIAL = TrackStatus


_WHOLE = ("frames", "status", "prior_aided", "masks_used", "lost_reason")


class LostReason(IntEnum):
    """Values of `Tracks.lost_reason`: the check that failed when an arch was lost, and the checked quantity."""

    NONE = 0  # the arch was not lost, or the reason was not recorded
    FEW_MASKS = 1  # number of masks that were used
    LITTLE_CONTOUR = 2  # length of matched contour [px]
    ROUGH_FIT = 3  # Standard deviation of the residuals [px].
    LOW_SCORE = 4  # Ratio of matched contour to its recent median, checked if residuals exceed their recent median [-].
    UNCOVERED_MASK = 5  # largest fraction of a mask not covered by the scan [-]
    UNCERTAIN = 6  # standard deviation of the position of the crowns [mm]

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")

    def explain(self, value: float, limit: float) -> str:
        """Return the measured value and the limit in words."""
        return _EXPLANATIONS[self].format(value=value, limit=limit)


_EXPLANATIONS = {
    LostReason.NONE: "no reason is recorded",
    LostReason.FEW_MASKS: "{value:.0f} masks used; at least {limit:.0f} are needed",
    LostReason.LITTLE_CONTOUR: "matched contour {value:.0f} px; at least {limit:.0f} px is needed",
    LostReason.ROUGH_FIT: "residual {value:.2f} px; less than {limit:.2f} px is needed",
    LostReason.LOW_SCORE: "matched contour {value:.0%} of the usual; at least {limit:.0%} is needed",
    LostReason.UNCOVERED_MASK: "{value:.1%} of a mask is not covered by the scan; at most {limit:.0%} is allowed",
    LostReason.UNCERTAIN: "expected error of the crowns {value:.2f} mm; at most {limit:.2f} mm is allowed",
}


@dataclass(eq=False)
class Tracks:
    """Tracked poses over a take; NaN where an arch was not tracked.

    Poses without prefix are final. `raw_` poses are from the first pass, without smoothing or kinematic prior; models
    are fitted to them and evaluated on them.
    """

    frames: NDArray[np.int64]  # frame numbers of the reference camera, shape (F,)
    T_world_upper: Array  # final pose, shape (F, 4, 4), like the next two
    T_world_lower: Array
    T_upper_lower: Array  # T_skull_mandible
    raw_T_world_upper: Array  # first-pass pose, shape (F, 4, 4), like the next two
    raw_T_world_lower: Array
    raw_T_upper_lower: Array
    status: NDArray[np.int8]  # `TrackStatus` of (upper, lower), shape (F, 2)
    #: whether a frame was recovered with a kinematic prior, (F,). If the metadata has `prior_spread_mm`, all final
    #: poses used a prior, as in tracking by colour
    prior_aided: Mask
    #: fraction of mask pixels not covered by the projected scan (paper eq. 8), shape (F, 2, C); NaN without a mask
    coverage_error: Array
    #: which masks were used for the raw poses, shape (F, 2, C); all other masks are missing or outliers
    masks_used: Mask
    #: covariance of xi [rad, mm] with T_true = exp(xi) T, world frame, about the world origin, shape (F, 6, 6)
    covariance_upper: Array
    covariance_lower: Array  # likewise
    covariance_relative: Array  # covariance of T_upper_lower, likewise in the skull frame, shape (F, 6, 6)
    sigma_mm: Array  # standard deviation of the landmarks' position in the skull frame [mm], shape (F, 5)
    residual_px: Array  # rms distance of matched contour samples at the working size [px], shape (F, 2)
    matched_px: Array  # matched contour length at the working size [px], shape (F, 2)
    camera_names: tuple[str, ...]  # names of the cameras, length C
    meta: TracksMeta = field(default_factory=TracksMeta)
    solved: SolvedJaw | None = None  # jaw parameters and state of each frame of a solved performance; otherwise None
    #: `LostReason` of the first pass, shape (F, 2), kept if a prior recovered the pose; optional in files
    lost_reason: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 2), np.uint8))
    #: measured value in the unit of the reason, shape (F, 2); NaN without a reason
    lost_value: Array = field(default_factory=lambda: np.zeros((0, 2)))
    lost_limit: Array = field(default_factory=lambda: np.zeros((0, 2)))  # limit of the value, shape (F, 2)

    def __post_init__(self) -> None:
        if not len(self.lost_reason):
            shape = np.shape(self.status)
            self.lost_reason = np.zeros(shape, np.uint8)
            self.lost_value, self.lost_limit = np.full(shape, np.nan), np.full(shape, np.nan)

    def tracked(self) -> Mask:
        """Return which frames have both final poses, shape (F,)."""
        return np.asarray(np.isfinite(self.T_upper_lower).all((1, 2)))

    def row_of(self, frame: int) -> int | None:
        """Return the index of a frame; None if it is not in the tracks."""
        row = int(np.searchsorted(self.frames, frame))
        return row if row < len(self.frames) and self.frames[row] == frame else None

    def explain_loss(self, index: int, arch: int) -> str:
        """Return the reason why an arch (0 upper, 1 lower) was lost at a frame index."""
        reason = LostReason(int(self.lost_reason[index, arch]))
        return reason.explain(self.lost_value[index, arch], self.lost_limit[index, arch])


def _shapes(count: int, cameras: int) -> dict[str, tuple[int, ...]]:
    poses = {
        name: (count, 4, 4)
        for kind in ("", "raw_")
        for name in (f"{kind}T_world_upper", f"{kind}T_world_lower", f"{kind}T_upper_lower")
    }
    covariances = {f"covariance_{name}": (count, 6, 6) for name in ("upper", "lower", "relative")}
    return {
        "frames": (count,),
        **poses,
        "status": (count, 2),
        "prior_aided": (count,),
        "coverage_error": (count, 2, cameras),
        "masks_used": (count, 2, cameras),
        **covariances,
        "sigma_mm": (count, len(LANDMARKS)),
        "residual_px": (count, 2),
        "matched_px": (count, 2),
        "lost_reason": (count, 2),
        "lost_value": (count, 2),
        "lost_limit": (count, 2),
    }


def save_tracks(path: AnyPath, tracks: Tracks) -> None:
    """Write tracks atomically as `.npz`.

    Raises:
        OutputError: the file cannot be written.
        ValueError: an array has the wrong shape.
    """
    arrays = fields_of_shapes(tracks, _shapes(len(tracks.frames), len(tracks.camera_names)), "tracks")
    arrays |= tracks.solved.arrays() if tracks.solved else {}
    meta = {
        "frames": "T_a_b maps b to a; world, upper = skull, lower = mandible",
        **tracks.meta,
        "camera_names": list(tracks.camera_names),
        "landmark_names": list(LANDMARKS),
    }
    write_described_npz(path, f"{FAMILY}/{VERSION}", arrays, meta)


def load_tracks(path: AnyPath) -> Tracks:
    """Read tracks of format jawusd-tracks/1 and check them.

    Raises:
        FormatError: the file is not a tracks file, arrays have wrong shapes, or poses are not rigid.
        VersionError: the file was written by a newer version.
        UnitsError: the file uses other units or another twist order.
    """
    arrays, meta = read_npz(path, FAMILY, VERSION)
    limit = meta.pop("margin_limit_mm", None)  # older files contain the minimum allowed margin, a negative value
    if isinstance(limit, float):
        meta["tolerance_mm"] = -limit
    check_notes(meta, TracksMeta, path)
    names = meta.get("camera_names")
    if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
        raise FormatError('"meta" has no list "camera_names".', path=path)
    count = len(take(arrays, "frames", (None,), path))
    if "masks_used" not in arrays and "coverage_error" in arrays:  # optional, since other trackers may omit the array
        arrays["masks_used"] = np.isfinite(arrays["coverage_error"])
    values = {
        # Lost frames are NaN, so only integer arrays must be finite.
        name: take(arrays, name, shape, path, finite=name in _WHOLE)
        for name, shape in _shapes(count, len(names)).items()
        if not name.startswith("lost_") or "lost_reason" in arrays  # older files lack all lost_* arrays
    }
    if not np.isin(values.get("lost_reason", 0), list(LostReason)).all():
        raise FormatError('"lost_reason" contains an unknown reason.', path=path)
    for name in values:
        if "T_" in name:
            present = np.isfinite(values[name]).all((1, 2))
            defect = rigidity_defect(values[name][present])
            if defect.size and defect.max() > 1e-6:
                frame = values["frames"][present][int(defect.argmax())]
                raise FormatError(
                    f'"{name}" of frame {frame} is not rigid (deviation {defect.max():.2g}; at most 1e-6 is allowed).',
                    path=path,
                )
    return Tracks(
        frames=values.pop("frames").astype(np.int64),
        status=values.pop("status").astype(np.int8),
        prior_aided=values.pop("prior_aided").astype(bool),
        masks_used=values.pop("masks_used").astype(bool),
        lost_reason=values.pop("lost_reason", np.zeros((0, 2))).astype(np.uint8),
        **values,
        camera_names=tuple(names),
        meta=cast(TracksMeta, meta),
        solved=take_solved(arrays, count, path),
    )


def used_coverage(tracks: Tracks) -> Array:
    """Return the uncovered fraction of each mask, shape (F, 2, C); NaN where a mask is missing or unused."""
    return np.where(tracks.masks_used, tracks.coverage_error, np.nan)


def uncovered_percent(tracks: Tracks) -> Array:
    """Return the uncovered mask area [%] per frame and arch, mean over the used masks, (F, 2); NaN if none."""
    value = used_coverage(tracks)
    known = np.isfinite(value)
    total = np.where(known, value, 0.0).sum(axis=2)
    return 100 * np.divide(total, known.sum(axis=2), out=np.full(total.shape, np.nan), where=known.any(axis=2))


def worst_frames(
    badness: Array, frames: NDArray[np.int64], fps: float, most: int, taken: Sequence[int] = ()
) -> list[int]:
    """Return indices of the frames with the highest badness (F,), worst first, no two within half a second; never NaN.

    `frames` (F,) are their numbers; they are as far from the indices in `taken` as from each other.
    """
    apart = max(round(_APART_S * fps), 1)
    found: list[int] = []
    for index in np.argsort(-badness, kind="stable").tolist():
        if len(found) == most or np.isnan(badness[index]):
            break
        if all(abs(int(frames[index] - frames[other])) >= apart for other in (*taken, *found)):
            found.append(index)
    return found
