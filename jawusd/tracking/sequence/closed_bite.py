"""Frames with closed teeth, which reveal registration errors of the scans and constant pose errors of a take.

The scans are exported in occlusion, so T_upper_lower is the identity with closed teeth, except for three errors: errors
of the scans' registration, outline biases common to all frames, and the noise of single frames. The spread of each
error is known, so linear least squares attributes the measured deviation to them. Most registrations are accurate to
a few hundredths of a millimetre, but outliers are large: a Student distribution is therefore assumed for registration
errors, and fitted by reweighting (Lange, Little & Taylor 1989).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.finding import Finding, Severity
from jawusd.formats.notes import Registration, registration_sizes
from jawusd.geometry import relative_pose, se3_adjoint, se3_exp, se3_inverse, se3_log
from jawusd.tracking.contour.equations import translation
from jawusd.tracking.contour.frame_record import FrameRecord, whole_frames
from jawusd.tracking.contour.scan import ARCHES
from jawusd.tracking.sequence.nuisance import TakeEquations, pose_response

# Criteria for frames in which the teeth rest in contact: maximum relative motion of the arches [mm/frame at the teeth],
# and maximum distance from the relative pose in the named frame or the frame with the smallest opening [mm]. Weights
# fall to zero at both limits, so that a frame at a limit does not change the result.
_STILL_MM, _SAME_BITE_MM = 0.12, 0.2
_LONGEST_REST = 24  # maximum number of rest frames used on either side; more would add no information


@dataclass(frozen=True, eq=False)
class RestFrames:
    """Frames with closed teeth, and whether they are used to correct the position of the lower scan."""

    weights: Mapping[int, float]  # weight of every such frame, above 0, at most 1
    named: bool  # whether the capture specifies one of the frames
    point: Array  # centre of the teeth in scan coordinates [mm], shape (3,)
    lower: Array  # centre of the lower crowns in scan coordinates [mm], shape (3,)
    apply: bool  # whether to correct the position of the lower scan


def rest_frames(
    records: Mapping[int, FrameRecord], named: int | None, up: Array, point: Array, probes: Array
) -> dict[int, float]:
    """Return weights of the frames in which the teeth rest together, around one that is named or most closed.

    Args:
        named: frame named in the capture, or None.
        up: unit vector from the lower to the upper teeth in scan axes, shape (3,).
        point, probes: centre of the teeth (3,), and points of the lower teeth (N, 3), in scan coordinates [mm].
    """
    relative = {frame: relative_pose(*records[frame].solution.poses) for frame in whole_frames(records)}
    if named is None:
        closed = {f: float((T[:3, :3] @ point + T[:3, 3] - point) @ up) for f, T in relative.items()}
        ranked = sorted(closed, key=lambda f: -closed[f])
        named = next((f for f in ranked if _likeness(relative, f, f + 1, probes, _STILL_MM)), None)
    if named is None or named not in relative:
        return {}
    weights = {named: 1.0}
    for step in (1, -1):
        weight = 1.0
        for frame in range(named + step, named + step * (_LONGEST_REST + 1), step):
            still = _likeness(relative, frame, frame - step, probes, _STILL_MM)
            weight = min(weight, still, _likeness(relative, frame, named, probes, _SAME_BITE_MM))
            if weight == 0:
                break
            weights[frame] = weight
    return dict(sorted(weights.items()))


def _likeness(relative: Mapping[int, Array], frame: int, other: int, probes: Array, limit_mm: float) -> float:
    """Return the bisquare weight (Beaton & Tukey 1974) of the lower arch's motion; 0 if a frame is not tracked."""
    if frame not in relative or other not in relative:
        return 0.0
    ratio = min(_moved_mm(relative[frame], relative[other], probes) / limit_mm, 1.0)
    return (1.0 - ratio**2) ** 2


def _moved_mm(one: Array, other: Array, probes: Array) -> float:
    """Return the mean distance of points (N, 3) between two poses (4, 4) of the lower arch [mm]."""
    gap = probes @ (one - other)[:3, :3].T + (one - other)[:3, 3]
    return float(np.linalg.norm(gap, axis=1).mean())


_BITE_MM = 0.03  # scale of the Student distribution of the registration error [mm], including the effect of bite force
_ARCH_MM = 25.0  # lever arm that converts this scale to a rotation [mm]
_DEGREES_OF_FREEDOM = 4.0  # of this distribution: about 1 % of registrations are off by ten times the scale
#: Fraction of the outline error variance that is constant over a take, in addition to annotator bias [-]: if it were
#: larger, noise in a few frames with closed teeth would shift the whole take.
STEADY = 0.3
# Effective number of independent measurements per frame with closed teeth, and maximum for all such frames:
# neighbouring frames have nearly the same outline error.
_NEW_PER_FRAME, _MOST_FRAMES = 0.25, 3.0
_USUAL_FRAMES = 2000  # number of evenly spaced frames from which the median covariance of a long take is computed


@dataclass(frozen=True, eq=False)
class ClosedBite:
    """Errors measured in frames with the teeth closed; twists are (omega [rad], v [mm]) about `point` in scan axes."""

    frames: tuple[int, ...]
    point: Array  # centre of the teeth, scan coordinates [mm], shape (3,)
    registration: Array  # left twist that corrects the lower scan, shape (6,)
    registration_covariance: Array  # shape (6, 6)
    steady: Array  # constant errors of the poses of both arches as right twists, shape (2, 6)
    #: covariances of the constant errors of upper arch, lower arch, and lower arch relative to upper, shape (3, 6, 6)
    spread: Array
    remaining: Array  # the same after the correction

    def correct(self, poses: Array, registered: bool) -> Array:
        """Return poses (F, 2, 4, 4) without constant errors; if `registered`, for the lower scan moved by `motion`."""
        out = poses @ se3_inverse(self.steady_motions(False))
        if registered:
            out[:, 1] = out[:, 1] @ se3_inverse(self.motion())
        return np.asarray(out, np.float64)

    def steady_motions(self, registered: bool) -> Array:
        """Return the motions S in T_aligned = T_corrected @ S of both arches, shape (2, 4, 4); see `correct`."""
        motions = np.array(translation(self.point) @ se3_exp(self.steady) @ translation(-self.point), np.float64)
        if registered:
            motions[1] = self.motion() @ motions[1] @ se3_inverse(self.motion())
        return motions

    def motion(self) -> Array:
        """Return the registration correction as a rigid motion in scan coordinates, shape (4, 4)."""
        return np.asarray(translation(self.point) @ se3_exp(self.registration) @ translation(-self.point), np.float64)

    def report(self, rest: RestFrames) -> Registration:
        """Return the registration as stored in the tracks' metadata."""
        A = se3_adjoint(translation(self.point - rest.lower))
        twist, sigma = A @ self.registration, np.sqrt(np.diag(A @ self.registration_covariance @ A.T))
        return {
            "frames": list(self.frames),
            "named": rest.named,
            "applied": rest.apply,
            "shift_mm": twist[3:].tolist(),
            "turn_deg": np.degrees(twist[:3]).tolist(),
            "shift_sigma_mm": sigma[3:].tolist(),
            "turn_sigma_deg": np.degrees(sigma[:3]).tolist(),
            "T": self.motion().tolist(),
        }

    def reduce(self, covariance: Array, steady: Array, T_world_scan: Array, which: int) -> Array:
        """Return the covariances of left twists about the world origin after the correction, shape (F, 6, 6).

        Args:
            covariance, steady: covariance before the correction, and its constant part, shapes (F, 6, 6).
            T_world_scan: poses in whose axes the error is constant, shape (F, 4, 4); the identity for relative poses.
            which: 0 upper arch, 1 lower arch, 2 lower arch relative to upper arch.
        """
        A = se3_adjoint(translation(-self.point) @ se3_inverse(T_world_scan))
        back = np.linalg.inv(A)
        local = A @ steady @ np.swapaxes(A, -1, -2)
        root = _root(self.spread[which])
        known = self.spread[which] - self.remaining[which]
        unit = np.linalg.solve(root, np.linalg.solve(root, known).T).T
        out = np.full_like(covariance, np.nan)
        for k in np.flatnonzero(np.isfinite(local).all((1, 2))).tolist():
            own = _root(local[k])
            out[k] = covariance[k] - back[k] @ own @ unit @ own @ back[k].T
        return out


def closed_bite(
    frames: NDArray[np.int64], poses: Array, outline: Array, habits: Array, rest: RestFrames
) -> ClosedBite | None:
    """Attribute the deviation from occlusion in the rest frames to its causes; None if no rest frame is tracked.

    `outline` and `habits` are covariances (F, 2, 6, 6) of the left twists of poses (F, 2, 4, 4), NaN where lost, by
    outline errors of frames and by annotator bias.
    """
    point = rest.point
    known = np.asarray(np.isfinite(poses).all((1, 2, 3)) & np.isfinite(outline).all((1, 2, 3)), bool)
    weights = np.array([rest.weights.get(frame, 0.0) for frame in frames.tolist()])
    used = np.asarray(known & (weights > 0), bool)
    if not used.any():
        return None
    weights = weights[used]
    there, back = translation(point), translation(-point)
    relative = relative_pose(poses[used, 0], poses[used, 1])
    found = np.average(se3_log(back @ relative @ there), axis=0, weights=weights)

    def local(covariance: Array, at: Array) -> Array:
        A = se3_adjoint(back @ se3_inverse(at.reshape(-1, 4, 4))).reshape(-1, 2, 6, 6)
        return np.asarray(A @ covariance @ np.swapaxes(A, -1, -2), np.float64)

    usual = np.flatnonzero(known)[:: max(1, int(known.sum()) // _USUAL_FRAMES)]
    steady = local(STEADY * outline[usual] + habits[usual], poses[usual])
    upper, lower = (_positive(part) for part in np.median(steady, axis=0))
    count = weights.sum() ** 2 / (weights**2).sum()  # effective number of frames (Kish 1965)
    independent = min(1.0 + _NEW_PER_FRAME * (count - 1.0), _MOST_FRAMES)
    single = np.average(local(outline[used], poses[used]), axis=0, weights=weights).sum(0)
    noise = (1.0 - STEADY) / independent * single
    both = upper + lower
    prior = _registration_spread(found, both + noise)
    gain = np.linalg.inv(both + noise + prior)
    spread = np.stack([upper, lower, both])
    return ClosedBite(
        frames=tuple(int(f) for f in frames[used]),
        point=point,
        registration=prior @ gain @ found,
        registration_covariance=prior - prior @ gain @ prior,
        steady=np.stack([-upper @ gain @ found, lower @ gain @ found]),
        spread=spread,
        remaining=spread - spread @ gain @ spread,
    )


# Registration error above which a warning is given [mm, deg], and its minimum significance [sigmas].
_OFF_MM, _OFF_DEG, _OFF_SIGMAS = 0.2, 0.5, 3.0


def registration_findings(found: Registration) -> list[Finding]:
    """Return a warning if the registration of the scans contradicts the rest frames; a note if it was corrected."""
    shift, turn, sigma_mm, sigma_deg = registration_sizes(found)
    shifted, turned = shift > max(_OFF_MM, _OFF_SIGMAS * sigma_mm), turn > max(_OFF_DEG, _OFF_SIGMAS * sigma_deg)
    if not shifted and not turned:
        return []
    frames = f"{found['frames'][0]} to {found['frames'][-1]}"
    where = f"in frames {frames}" + ("" if found["named"] else ", which have the smallest jaw opening")
    off = f"the lower scan is {shift:.2f} mm and {turn:.1f} degrees off the bite of the take {where}"
    if found["applied"]:
        return [Finding("scan_registration", "note", f"{off}: corrected", value=shift, limit=_OFF_MM)]
    # without a named frame, the teeth may never have been closed
    severity: Severity = "warning" if found["named"] else "note"
    hint = 'Register the scans again, or set registration = "take" in [scans] if the teeth are in occlusion there.'
    return [Finding("scan_registration", severity, off, value=shift, limit=_OFF_MM, hint=hint)]


def registration_unknown(rest: RestFrames) -> Finding:
    """Return a note that the take cannot verify the registration of the scans."""
    where = "no frame shows the teeth at rest together"
    if rest.named:
        where = "the frame named in rest_frame is not tracked"
    hint = "Record closed teeth with both arches in view, and name such a frame as rest_frame in [motion]."
    return Finding("registration_unknown", "note", f"{where}: the bite of the scans was not checked", hint=hint)


# Maximum registration error [mm, deg]; with larger deviations, the teeth cannot have been closed.
_MOST_MM, _MOST_DEG = 3.0, 8.0


def check_registration(found: Registration) -> None:
    """Raise a TrackingError if the registration correction of the lower scan is too large."""
    shift, turn, *_ = registration_sizes(found)
    if found["applied"] and (shift > _MOST_MM or turn > _MOST_DEG):
        raise TrackingError(
            f"the teeth are {shift:.1f} mm and {turn:.1f} degrees off the bite of the scans; at most {_MOST_MM:g} mm "
            f"and {_MOST_DEG:g} degrees can be a registration error",
            frame=found["frames"][0],
            hint="Set rest_frame in [motion] to a frame with the teeth together, or register the scans again.",
        )


def observe_bite(equations: TakeEquations, rest: RestFrames) -> None:
    """Add the observation that the teeth are closed: outline biases that separate the teeth become unlikely."""
    records = equations.records
    used = {f: w for f, w in rest.weights.items() if f in records and records[f].found.all()}
    if not used:
        return
    there, back = translation(rest.point), translation(-rest.point)
    found, slopes, spread = [], [], []
    for frame in used:
        solution = records[frame].solution
        head = solution.poses[0]
        found.append(se3_log(back @ relative_pose(*solution.poses) @ there))
        to_skull = [se3_adjoint(back @ se3_inverse(head) @ translation(solution.centres[r])) for r in ARCHES]
        upper, lower = (to_skull[r] @ pose_response(records, frame, r, equations.extrinsics) for r in ARCHES)
        slopes.append(lower - upper)
        H = solution.outline.precision.sum(1) / equations.variance_px3[:, None, None]
        spread.append(np.sum([to_skull[r] @ np.linalg.pinv(H[r]) @ to_skull[r].T for r in ARCHES], axis=0))
    weights = np.array([*used.values()])
    deviation, slope, outline = (np.average(part, axis=0, weights=weights) for part in (found, slopes, spread))
    bite = _registration_spread(deviation, outline + slope @ equations.prior_covariance() @ slope.T)
    equations.observe(slope, deviation, np.asarray(np.linalg.inv(outline + bite), np.float64))


def _registration_spread(found: Array, others: Array) -> Array:
    """Return the covariance of the registration for a deviation (6,) and the covariance of all other errors (6, 6)."""
    bite = np.diag(np.r_[np.full(3, (_BITE_MM / _ARCH_MM) ** 2), np.full(3, _BITE_MM**2)])
    spread = bite
    for _ in range(50):
        registration = spread @ np.linalg.solve(others + spread, found)
        excess = float(registration @ np.linalg.solve(bite, registration))
        spread = bite * max(1.0, (_DEGREES_OF_FREEDOM + excess) / (_DEGREES_OF_FREEDOM + 6.0))
    return spread


def _root(matrix: Array) -> Array:
    """Return the symmetric square root of a covariance (6, 6)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, np.float64)


def _positive(matrix: Array) -> Array:
    """Return the nearest positive definite matrix to a median of covariances, shape (6, 6)."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 1e-9 * values.max())) @ vectors.T, np.float64)
