"""Align a face model with a rig by a few corresponding points, and state the expected error."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.base.errors import FittingError
from jawusd.evaluator import JawRig
from jawusd.formats.alignment import Alignment, motion_of_points
from jawusd.geometry import LANDMARKS, rigid_fit, se3_inverse, transform_points

UPPER_INCISOR = "upper_incisor"
_FEWEST = 3
# Distance [standard deviations] beyond which a point weighs less: 95 % of 3-vectors are shorter (chi distribution).
_OUTLIER = 2.8
_ROUNDS = 100
_SETTLED = 1e-9  # change of weights at which the iteration ends
# Largest median distance of the points after the fit, in standard deviations, and minimum decrease of the sum of
# squares for left and right to count as exchanged. See docs/explanation/constants.md.
_LARGEST_MEDIAN, _EXCHANGED = 4.0, 20.0
# Smallest distance of the points from a line, relative to their standard deviation there: the rotation about the line
# is then uncertain by 20 degrees.
_LEAST_SPREAD = 3.0
_HINT = (
    "Check the unit, the names of the points, and that model and rig have the teeth in occlusion; if the model has no "
    "true size, estimate its scale."
)


def rig_points(rig: JawRig) -> dict[str, Array]:
    """Return the points (3,) [mm] that a rig provides by name, skull frame, teeth in occlusion.

    `upper_incisor` is the origin of the anatomical frame; in a rig made without scans, this is the lower incisal point.
    """
    closed = dict(zip(LANDMARKS, transform_points(rig.T_rest, rig.landmarks), strict=True))
    return {**closed, UPPER_INCISOR: se3_inverse(rig.T_anatomical_skull)[:3, 3]}


def align(
    rig: JawRig,
    points_model: Mapping[str, ArrayLike],
    points_rig: Mapping[str, ArrayLike] | None = None,
    *,
    sigma_mm: float | Mapping[str, float],
    unit_mm: float = 1.0,
    scale: bool = False,
    joint: ArrayLike | None = None,
) -> Alignment:
    """Align a face model with a rig by corresponding points with the teeth in occlusion.

    The rigid motion, or the similarity, minimises the sum of weighted squared distances (Umeyama 1991). Points beyond
    2.8 standard deviations count less (Huber's weights, iterated). The covariance follows from the standard deviations,
    and is enlarged if the points scatter more than these suggest.

    Args:
        points_model: Points of the face model by name, its own frame and unit, each (3,).
        points_rig: The same points in the skull frame of the rig [mm], each (3,); default: see `rig_points`.
        sigma_mm: Standard deviation of the difference between both, per axis: one number, or one for each name.
        unit_mm: Length of a unit of the model; 1000 for models in metres.
        scale: Estimate the unit as well, starting from `unit_mm`; needed only for models without a true size.
        joint: Jaw joint of the model [model units], (3,), to store with the alignment.

    Returns:
        The alignment, with its covariance and its expected error at teeth and condyles.

    Raises:
        FittingError: fewer than three points, points on a line, points that the rig does not provide, points that
            scatter far more than their standard deviations, or left and right exchanged.
        ValueError: a point or standard deviation that is not finite, or a standard deviation or unit not above 0.
    """
    names = tuple(points_model)
    target = {**rig_points(rig), **(points_rig or {})}
    _check_names(names, target)
    X = unit_mm * np.array([points_model[name] for name in names], dtype=np.float64)
    Y = np.array([target[name] for name in names], dtype=np.float64)
    sigma = np.array(
        [sigma_mm[name] if isinstance(sigma_mm, Mapping) else sigma_mm for name in names], dtype=np.float64
    )
    if X.shape != Y.shape or X.shape[1:] != (3,) or not np.isfinite([X, Y]).all() or not (unit_mm > 0):
        raise ValueError("every point must have three finite numbers, and unit_mm must be above 0")
    if not (np.isfinite(sigma) & (sigma > 0)).all():
        raise ValueError("sigma_mm must be finite and above 0 for every point")
    _check_spread(Y, sigma)
    T, ratio, weights = _robust(X, Y, sigma, scale)
    placed = transform_points(T, ratio * X)
    distance_mm = np.linalg.norm(placed - Y, axis=1)
    _check_distances(names, X, Y, sigma, scale, distance_mm)
    J = motion_of_points(placed)[..., : 7 if scale else 6]
    free = 3 * len(X) - J.shape[-1]
    misfit = float(np.sqrt(weights @ distance_mm**2 / free))
    covariance = np.zeros((7, 7))
    inner = np.einsum("n,nij,nik->jk", weights, J, J)
    covariance[: len(inner), : len(inner)] = _inverse(inner) * max(misfit, 1.0) ** 2
    found = Alignment(
        actor=rig.actor,
        unit_mm=unit_mm * ratio,
        T_skull_model=T.tolist(),
        covariance=covariance.tolist(),
        off_mm=dict(zip(names, distance_mm.tolist())),
        teeth_mm=0.0,
        condyles_mm=0.0,
        joint=None if joint is None else tuple(np.asarray(joint, dtype=np.float64).tolist()),
    )
    error = found.error_mm(transform_points(rig.T_rest, rig.landmarks))
    teeth, condyles = (float(np.sqrt(np.mean(part**2))) for part in (error[:3], error[3:]))
    return found.model_copy(update={"teeth_mm": teeth, "condyles_mm": condyles})


def _check_names(names: tuple[str, ...], target: Mapping[str, ArrayLike]) -> None:
    unknown = [name for name in names if name not in target]
    if unknown:
        raise FittingError(
            f'the rig provides no point "{unknown[0]}"; it provides {", ".join((*LANDMARKS, UPPER_INCISOR))}.',
            hint='Give its position in the skull frame of the rig as well ("rig" in the file, points_rig in Python).',
        )
    if len(names) < _FEWEST:
        raise FittingError(
            f"there are {len(names)} points ({', '.join(names) or 'none'}); at least {_FEWEST} that do not lie on a "
            "line are needed, such as incisor, molar_left and molar_right.",
        )


def _check_spread(Y: Array, sigma: Array) -> None:
    """Raise FittingError if the points lie on a line within their standard deviations."""
    w = sigma**-2
    centred = (Y - w @ Y / w.sum()) / sigma[:, None]
    across = float(np.linalg.svd(centred, compute_uv=False)[1])
    if across < _LEAST_SPREAD:
        raise FittingError(
            f"the points lie nearly on a line: their distance from it is only {across:.1f} standard deviations; "
            f"at least {_LEAST_SPREAD:g} are needed. The rotation about this line is undetermined.",
            hint="Add a point away from the line, such as the chin, or one on the other side of the face.",
        )


def _check_distances(names: tuple[str, ...], X: Array, Y: Array, sigma: Array, scale: bool, distance_mm: Array) -> None:
    """Raise FittingError if distances are too large for the standard deviations, or left and right seem exchanged."""
    listed = ", ".join(f"{name} {x:.1f}" for name, x in zip(names, distance_mm))
    sides = {"left": "right", "right": "left"}
    other = [re.sub("left|right", lambda side: sides[side[0]], name) for name in names]
    if other != list(names) and set(other) == set(names):
        order = [names.index(name) for name in other]
        T, ratio, weights = _robust(X[order], Y, sigma, scale)
        exchanged = weights @ ((transform_points(T, ratio * X[order]) - Y) ** 2).sum(axis=1)
        z = distance_mm / sigma
        if (np.minimum(z, _OUTLIER) * z).sum() - exchanged > _EXCHANGED:
            raise FittingError(
                f"the points fit better with left and right exchanged. Distances after the fit [mm]: {listed}.",
                hint="Left is the subject's left.",
            )
    median = float(np.median(distance_mm / sigma))
    if median > _LARGEST_MEDIAN:
        raise FittingError(
            f"the median distance of the points is {median:.1f} standard deviations; at most {_LARGEST_MEDIAN:g} is "
            f"accepted. Distances after the fit [mm]: {listed}.",
            hint=_HINT,
        )


def _robust(X: Array, Y: Array, sigma: Array, scale: bool) -> tuple[Array, float, Array]:
    """Return T (4, 4), the factor of size, and the weights (N,) [1/mm^2], by iteration of Huber's weights."""
    weights = sigma**-2
    for _ in range(_ROUNDS):
        T, ratio = _similarity(X, Y, weights, scale)
        z = np.linalg.norm(transform_points(T, ratio * X) - Y, axis=1) / sigma
        changed = np.minimum(1.0, _OUTLIER / np.maximum(z, 1e-12)) / sigma**2
        settled = np.abs(changed / weights - 1).max() < _SETTLED
        weights = changed
        if settled:
            break
    return T, ratio, weights


def _similarity(X: Array, Y: Array, weights: Array, scale: bool) -> tuple[Array, float]:
    """Return T (4, 4) and the factor of size that minimise sum w |T (factor X) - Y|^2 (Umeyama 1991)."""
    if not scale:
        return rigid_fit(X, Y, weights), 1.0
    R = rigid_fit(X, Y, weights)[:3, :3]  # the rotation does not depend on the size
    w = weights / weights.sum()
    x, y = (X - w @ X) @ R.T, Y - w @ Y
    ratio = float((w[:, None] * x * y).sum() / (w[:, None] * x**2).sum())
    if ratio <= 0:
        raise FittingError("no size of the model fits the points.", hint=_HINT)
    return rigid_fit(ratio * X, Y, weights), ratio


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a positive definite matrix with rows of different units."""
    size = np.sqrt(np.diag(matrix))
    found: Array = np.linalg.inv(matrix / np.outer(size, size)) / np.outer(size, size)
    return found
