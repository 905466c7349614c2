"""Widen what is claimed of frames whose condyles are where the rest of the take does not let them be, and judge takes.

Masks made around a wrong pose confirm it, and colours may prefer it; but such poses seldom fit the jaw's own motion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding
from jawusd.formats.tracks import Tracks
from jawusd.tracking.contour.quality import landmark_sigmas
from jawusd.tracking.region.condyles import CondyleMotion

# Squared distance of the condyles from what is expected, per coordinate, from which a frame is strained: of 1,400 right
# frames of five persons with closing lips and of three takes none had more than 1.7, of 17 frames 0.4 to 2.0 mm off 16
# had more than 2.3.
_STRAINED = 2.0
# Standard deviation of the lower teeth from which a frame tells little [mm], and shares of such frames from which a
# take is doubtful, and not usable. Of six path-traced mouths none had such a frame but under closed lips. Of 28 takes
# that three of them were spoilt to, all 6 with frames a millimetre off are called so, or refused at their start, and so
# are 10 without: those of flickering light, blur, and a resolution of 1.4 px/mm.
_UNKNOWN_MM, _FEW, _MANY = 1.0, 0.03, 0.2
_MOST = 0.6  # of the frames, that are good and adjoin, are a take without its beginning and end
_USUAL, _LEAST = 0.9, 0.25  # quantile of the take with which a strained frame is compared, and its least value


def strain_factors(motion: CondyleMotion, relative: Array, covariance: Array) -> Array:
    """Teach a motion all frames; return by how much covariances are to be wider, 1 where nothing is strained (F,).

    Their strain over the usual one (Birge 1932).

    Args:
        motion: one that was taught nothing yet.
        relative: T_upper_lower, shape (F, 4, 4).
        covariance: of their left twists about the skull origin, shape (F, 6, 6).
    """
    for pose, spread in zip(relative, covariance, strict=True):
        motion.learn(pose, spread)
    strain = np.array([motion.strain(pose) / 6 for pose in relative])
    usual = max(float(np.quantile(strain, _USUAL)), _LEAST)
    return np.where(strain > _STRAINED, np.maximum(strain / usual, 1.0), 1.0)


def widen_strained(tracks: Tracks, landmarks: Array, axes: Array) -> Tracks:
    """Return tracks whose strained frames have a wider covariance; see `strain_factors`.

    Args:
        landmarks, axes: as in `CondyleMotion`.
    """
    relative, between = tracks.raw_T_upper_lower, tracks.covariance_relative
    known = np.asarray(np.isfinite(relative).all((1, 2)) & np.isfinite(between).all((1, 2)))
    if not known.any():
        return tracks
    wider = np.ones((len(known), 1, 1))
    wider[known, 0, 0] = strain_factors(CondyleMotion(landmarks, axes), relative[known], between[known])
    between = wider * between
    return replace(
        tracks,
        covariance_upper=wider * tracks.covariance_upper,
        covariance_lower=wider * tracks.covariance_lower,
        covariance_relative=between,
        sigma_mm=landmark_sigmas(relative, between, landmarks),
    )


def _longest_run(good: NDArray[np.bool_]) -> tuple[int, int]:
    """Return the longest run of frames, first and one past the last."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    runs = ends.reshape(-1, 2)
    if len(runs) == 0:
        return 0, 0
    first, last = runs[np.argmax(np.ptp(runs, axis=1))].tolist()
    return first, last


def footage_doubts(tracks: Tracks) -> list[Finding]:
    """Return a warning if the jaw is lost, or not known to a millimetre, in too many frames that colours alone showed.

    Kind: "footage_doubtful" [%].
    """
    sigma_mm = tracks.sigma_mm[:, :3].mean(1)
    bad = ~(sigma_mm <= _UNKNOWN_MM)  # NaN where an arch is lost
    share = float(bad.mean())
    if share <= _FEW:
        return []
    judgement = "is not usable as it is" if share > _MANY else "is doubtful in parts"
    message = (
        f"the footage {judgement}: in {bad.sum()} of {len(bad)} frames the jaw is lost, or its teeth are not known to "
        f"{_UNKNOWN_MM:g} mm; at most {_FEW:.0%} of the frames is usual"
    )
    worst = int(np.argmax(np.where(np.isfinite(sigma_mm), sigma_mm, np.inf)))
    hint = "Look at the overlay, light the mouth better, or draw masks (`jawusd segment`)."
    first, last = _longest_run(~bad)
    if last - first >= _MOST * len(bad):
        kept = f"[{tracks.frames[first]}, {tracks.frames[last - 1] + 1}]"
        hint = f"If the others are dark, as in light flashes, write frames = {kept} in capture.toml. {hint}"
    value, limit = round(100 * share, 1), 100 * _FEW
    return [Finding("footage_doubtful", "warning", message, value, limit, frame=int(tracks.frames[worst]), hint=hint)]
