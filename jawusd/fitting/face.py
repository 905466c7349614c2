"""Jaws learned from faces: clocks of both takes, training frames, what these must contain, and errors of baselines."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.fitting.data import PARAMETERS
from jawusd.formats.arkit import shares_of
from jawusd.geometry import make_transform, se3_exp, se3_inverse, transform_points
from jawusd.geometry.so3 import nearest_rotation

COARSE_S, _FINE_S, _FINE_STEPS = 0.1, 0.01, 15  # offset search: coarse and fine step [s], number of fine steps per side
_LEAST_SECONDS = 10.0
_LEAST_REACH = 0.4  # minimum fraction of the subject's range that a take must reach in each direction
_DIRECTIONS = ("opening", "movement to the left", "movement to the right", "movement forward")

LEAST_FRAMES, MOST_FRAMES = 60, 300  # minimum number of frames with visible teeth, and maximum of training frames
_BLOCKS = 6  # number of contiguous blocks that are held out in turn
_LEAST_MOVED_MM = 0.5  # minimum standard deviation of each parameter in the training frames; 12 subjects have 1.4 mm
_CHIN_POINTS = 3
_MOST_SHARE = 0.65  # maximum ratio of the prediction error to that of each baseline; see docs/explanation/constants.md


def columns_at(face_s: Array, weights: Array, times_s: Array) -> Array:
    """Interpolate columns (F, K) to times (N,), shape (N, K); NaN outside the capture and where no face was found."""
    return np.stack([np.interp(times_s, face_s, column, np.nan, np.nan) for column in weights.T], axis=1)


def offsets_between(face_s: Array, times_s: Array) -> Array:
    """Return clock offsets [s] at which two takes overlap by half of the shorter; raises FittingError if too short."""
    shorter = min(face_s[-1] - face_s[0], times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0
    if shorter < _LEAST_SECONDS:
        raise FittingError(
            f"the shorter of the two takes lasts {shorter:.1f} s; at least {_LEAST_SECONDS:g} s are needed to learn a "
            "mapping."
        )
    return np.arange(times_s[0] + shorter / 2 - face_s[-1], times_s[-1] - shorter / 2 - face_s[0], COARSE_S)


def refined_offset(offset_s: float, face_s: Array, weights: Array, times_s: Array, d: Array) -> float:
    """Return the clock offset [s] near an initial one at which all columns (F, K) together predict d best."""
    tried = offset_s + _FINE_S * np.arange(-_FINE_STEPS, _FINE_STEPS + 1)
    left = []
    for offset in tried:
        seen = columns_at(face_s + offset, weights, times_s)
        rows = np.isfinite(seen).all(axis=1)
        left.append(float(np.mean(unexplained(seen[rows], d[rows]) ** 2)))
    best = int(np.argmin(left))
    if not 0 < best < len(tried) - 1:
        return float(tried[best])
    before, low, after = left[best - 1 : best + 2]  # refine by the vertex of the parabola through three values
    bend = before - 2 * low + after
    return float(tried[best] + (0.5 * _FINE_S * (before - after) / bend if bend > 0 else 0.0))


def unexplained(columns: Array, d: Array) -> Array:
    """Return what a linear function of columns (N, K) leaves of d (N, n)."""
    design = np.column_stack([np.ones(len(columns)), columns])
    return d - design @ np.linalg.lstsq(design, d, rcond=1e-6)[0]


def incisal_error(rig: JawRig, found: Array, d: Array) -> float:
    """Return the mean distance [mm] of the incisal point between two sets of d (N, 3) [mm], clamped to the bound."""
    incisor = rig.landmarks[:1]
    positions = [transform_points(rig.pose(x), incisor) for x in (rig.project(found), d)]
    return float(np.linalg.norm(positions[0] - positions[1], axis=-1).mean())


def check_jaw_weights(rig: JawRig, weights: Array, d: Array, error_mm: float) -> None:
    """Check that a take exercises every direction, and that learning from its weights improves on fixed fractions.

    The four ARKit jaw weights (N, 4), NaN without a face, and d (N, 3) [mm] are of the same frames; the learned jaw has
    a held-out error [mm] at the incisal point.

    Raises:
        FittingError: a direction is not exercised, a weight is constant, or fixed fractions of the ranges are as
            accurate as the learned jaw.
    """
    rows = np.isfinite(weights).all(axis=1)
    weights, d = weights[rows], d[rows]
    low, high = rig.d_range.T
    reach = [d[:, 0].max() / high[0], d[:, 1].max() / high[1], d[:, 1].min() / low[1], d[:, 2].max() / high[2]]
    worst = int(np.argmin(reach))
    if reach[worst] < _LEAST_REACH:
        raise FittingError(
            f"the take covers {max(reach[worst], 0.0):.0%} of the range of {_DIRECTIONS[worst]}; "
            f"{_LEAST_REACH:.0%} is needed to learn from jaw weights.",
            hint="Record wide opening, both sides and forward, teeth together and apart, for half a minute.",
        )
    constant = np.ptp(weights, axis=0) == 0
    if constant.any():
        raise FittingError(f"the weight of {_DIRECTIONS[int(np.argmax(constant))]} never changes.")
    shares_mm = incisal_error(rig, rig.denormalized(shares_of(weights)), d)
    if error_mm >= shares_mm:
        raise FittingError(
            f"the jaw learned from this take has an error of {error_mm:.2f} mm on held-out frames; fixed fractions of "
            f"the ranges have {shares_mm:.2f} mm. It would not be an improvement.",
            hint="Check that both takes show the same performance, or use `animate --arkit` without a mapping.",
        )


def training_rows(usable: Mask) -> Indices:
    """Return the training frames, evenly spaced among the usable ones; raises FittingError if these are too few."""
    rows = np.flatnonzero(usable)
    if len(rows) < LEAST_FRAMES:
        raise FittingError(
            f"{len(rows)} frames show the teeth and have values in all columns of the face data; at least "
            f"{LEAST_FRAMES} are needed.",
            hint="Check that both files show the same performance, and that no point is hidden throughout.",
        )
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_FRAMES)).astype(int)]


def blocks_of(count: int) -> list[Indices]:
    """Return the blocks of training frames that are held out in turn."""
    return np.array_split(np.arange(count), _BLOCKS)


def check_motion(flat: Array, d: Array, sigma: Array) -> None:
    """Raise FittingError if columns of the face (M, K) or d (M, 3) [mm] hardly move, or sigma is not positive."""
    moved = d.std(axis=0)
    least = int(np.argmin(moved))
    if moved[least] < _LEAST_MOVED_MM:
        raise FittingError(
            f"the {PARAMETERS[least]} varies by {moved[least]:.2f} mm (standard deviation) where the teeth are "
            f"visible; at least {_LEAST_MOVED_MM:g} mm is needed to learn it.",
            hint="Record opening, both sides and forward movement with parted lips.",
        )
    if not np.ptp(flat, axis=0).any():
        raise FittingError("all columns of the face data are constant.")
    if not (sigma > 0).all():
        raise FittingError(f"sigma of d must be positive, found {sigma.min():g} mm.")


def held_out_errors(rig: JawRig, held_out: Array, d: Array, blocks: list[Indices], X: Array) -> dict[str, float]:
    """Return the mean errors at the incisal point [mm] of held-out predictions and of baselines; see `fit_skin`.

    Predicted and measured d are (M, 3) [mm], X are the points (M, N, 3) [mm] or columns (M, K) of the same frames.
    """
    guesses = {"skin": held_out, "carried": _carried(d, blocks), "mean": np.broadcast_to(d.mean(axis=0), d.shape)}
    if X.ndim == 3 and X.shape[1] >= _CHIN_POINTS:
        guesses["chin"] = _of_chin(rig, X, d, blocks)
    return {name: incisal_error(rig, guess, d) for name, guess in guesses.items()}


def check_errors(errors: dict[str, float]) -> None:
    """Raise FittingError if held-out errors exceed 65 % of those of the baselines given."""
    called = {"carried": "holding the last d", "mean": "the mean d", "chin": "a chin rigid with the bone"}
    for name, words in called.items():
        if name in errors and errors["skin"] > _MOST_SHARE * errors[name]:
            raise FittingError(
                f"the jaw learned from the face has an error of {errors['skin']:.2f} mm at the incisal point on "
                f"held-out frames; the error of {words} is {errors[name]:.2f} mm. At most {_MOST_SHARE:.0%} of that "
                f"is accepted.",
                hint="Check that face and jaw data show the same performance on one clock, and that the head is "
                "stabilised. Add points or expressions; if a rigid chin is as good, use inverse kinematics (`rig.ik`).",
            )


def head_motions(points: Array, shift_mm: float, turn_rad: float) -> Array:
    """Return the motions (6, 3 N) [mm] of points (N, 3) by shifts along and turns about each axis, at their centre."""
    shifts = np.broadcast_to(np.eye(3)[:, None] * shift_mm, (3, len(points), 3))
    turns = np.cross(np.eye(3)[:, None], points - points.mean(axis=0)) * turn_rad
    return np.concatenate([shifts, turns]).reshape(6, -1)


def _carried(d: Array, blocks: list[Indices]) -> Array:
    """Return d of the last frame before each block, shape (M, 3); for the first block, of the frame after it."""
    held = [d[b[0] - 1] if b[0] else d[b[-1] + 1] for b in blocks]
    return np.concatenate([np.repeat(each[None], len(b), axis=0) for each, b in zip(held, blocks, strict=True)])


def _of_chin(rig: JawRig, X: Array, d: Array, blocks: list[Indices]) -> Array:
    """Return d (M, 3) of held-out blocks, by inverse kinematics from the skin points that follow the bone best."""
    poses, found = rig.pose(d), np.empty_like(d)
    for b in blocks:
        others = np.delete(np.arange(len(d)), b)
        T, on_bone_mm, chosen = on_bone(rig, X[others], poses[others])
        found[b] = rig.ik(on_bone_mm, transform_points(T, X[b][:, chosen])).d
    return found


def on_bone(rig: JawRig, X: Array, poses: Array) -> tuple[Array, Array, Indices]:
    """Fit points (F, N, 3) as if rigid with the bone; return T_skull_face (4, 4) and the three points that fit best.

    These are given by their positions in the mandible (3, 3) [mm] and their indices.
    """
    swing = transform_points(poses, rig.landmarks[:1])[:, 0]
    moved = X.mean(axis=1)
    # The skin follows the incisal point, so the search starts from the rotation between the two point clouds.
    R = nearest_rotation((swing - swing.mean(axis=0)).T @ (moved - moved.mean(axis=0)))
    start = make_transform(R, rig.landmarks[0] - R @ X.mean(axis=(0, 1)))

    def residual(unknown: Array, chosen: Indices) -> Array:
        in_skull = transform_points(se3_exp(unknown[:6]) @ start, X[:, chosen])
        return np.asarray(transform_points(poses, unknown[6:].reshape(-1, 3)) - in_skull)

    def rest(T: Array, chosen: Indices) -> Array:
        return np.asarray(transform_points(se3_inverse(poses) @ T, X[:, chosen]).mean(axis=0))

    every = np.arange(X.shape[1])
    first = np.concatenate([np.zeros(6), rest(start, every).ravel()])
    chosen = np.argsort(np.square(residual(first, every)).sum(axis=(0, 2)))[:_CHIN_POINTS]
    guess = np.concatenate([np.zeros(6), rest(start, chosen).ravel()])
    unknown = least_squares(lambda x: residual(x, chosen).ravel(), guess, x_scale="jac").x
    return se3_exp(unknown[:6]) @ start, unknown[6:].reshape(-1, 3), chosen
