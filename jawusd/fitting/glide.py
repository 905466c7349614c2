"""Align d1 = 0 with tooth contact: measure the glide surface of a gauge on the scans, and adapt the bounds.

The gauge fitted to captured poses approximates the glide surface by a smooth bowl. The true surface is rough: this
module measures, on a grid of d2 and d3, the opening at which the scans touch. It then builds an upper envelope of these
openings with limited slopes, so that the gauge remains invertible. The poses of the model do not change, only their
parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from jawusd.base.arrays import Array, Indices, Mask
from jawusd.evaluator import JawRig
from jawusd.evaluator.curves import GlideTable
from jawusd.evaluator.gauge import Gauge
from jawusd.evaluator.models import AnchoredModel
from jawusd.fitting.bounds import fit_bounds
from jawusd.fitting.data import ranges_of
from jawusd.fitting.gauge_fit import SMALLEST_MINOR, smallest_minor_around
from jawusd.formats.model import JawModel
from jawusd.geometry.se3 import make_transform
from jawusd.meshes.contact import Teeth

_STEP_MM = 0.5  # knot spacing [mm]; cusps and fossae are a few times wider
_BEYOND_MM = 1.5  # distance beyond the captured parameters up to which contact is measured [mm]
_HIGHEST_MM, _LOWEST_MM = 5.0, -2.5  # range of vertical offsets searched for contact
_HALVINGS = 4  # number of bisections of the search step, which reduce it to 0.03 mm
_SMOOTHING = 0.7  # standard deviation of the Gaussian filter, in knots
_RAISES = 3  # number of iterations that restore the height lost in smoothing
_REST_MM = 2.0  # radius around the closed bite [mm], the bottom of the fossae, within which the surface is blended to 0
# Maximum slopes along d2 and d3, in the order tried; steeper surfaces follow deep fossae more closely.
_SLOPES = ((1.5, 1.0), (1.0, 0.7), (0.6, 0.4))
_RANK_ERROR_MM = 0.03


def follow_teeth(model: JawModel, teeth: Teeth) -> JawModel:
    """Return an anchored model whose d1 is measured from tooth contact, with bounds that end at contact.

    A model is returned unchanged if it has no gauge, or if the gauge would not be invertible with any surface.
    """
    form = JawRig(model.arrays, model.meta).model
    if not isinstance(form, AnchoredModel):
        return model
    known = np.isfinite(model.d).all(axis=1)
    d2, d3 = (_axis(model.d[known, axis]) for axis in (1, 2))
    down = _contact_drop(form, teeth, d2, d3, model.d[known])
    for slopes in _SLOPES:
        gauge = replace(form.gauge, glide_drop=np.zeros(4), glide=_factored(d2, d3, _hull(d2, d3, down, slopes)))
        d = _carried(form.gauge, gauge, model.d)
        if smallest_minor_around(gauge, d[known]) > SMALLEST_MINOR:
            return _regauged(model, form.gauge, gauge, d)
    return model


def _regauged(model: JawModel, old: Gauge, gauge: Gauge, d: Array) -> JawModel:
    """Return the model with a new gauge, its parameters d (F, 3), and bounds that end at closed teeth."""
    trained = d[model.trained]
    config = model.meta["config"]
    alpha = float(config["alpha"]) if isinstance(config, dict) else 1.0
    bounds = fit_bounds(trained, alpha, closed_mm=0.0)
    arrays = {
        **model.arrays,
        **gauge.arrays(),
        **{name: value for name, value in bounds.items() if name in model.arrays},
        "codes": _carried(old, gauge, model.arrays["codes"]),
    }
    return replace(model, arrays=arrays, d=d, meta={**model.meta, "ranges_mm": ranges_of(trained)})


def _carried(old: Gauge, new: Gauge, d: Array) -> Array:
    """Convert parameters d (n, 3) [mm] of the old gauge to the new gauge; NaN stays NaN."""
    out = np.full(d.shape, np.nan)
    known = np.isfinite(d).all(axis=1)
    out[known] = new.inverse(old.displacement(d[known]))
    return out


def _axis(values: Array) -> Array:
    """Return knots [mm] that cover the captured values and include 0."""
    low, high = min(values.min(), 0.0) - _BEYOND_MM, max(values.max(), 0.0) + _BEYOND_MM
    return _STEP_MM * np.arange(np.floor(low / _STEP_MM), np.ceil(high / _STEP_MM) + 1)


def _contact_drop(form: AnchoredModel, teeth: Teeth, d2: Array, d3: Array, captured: Array) -> Array:
    """Return how far below the closed bite the incisal point is when the teeth just touch [mm], on a grid (n2, n3)."""
    side, front = (x.ravel() for x in np.meshgrid(d2, d3, indexing="ij"))
    wanted = _near(np.stack([side, front], axis=1), captured[:, 1:])
    ahead = front + form.gauge.arch(np.zeros_like(side), side)[0]

    def touches(rows: Indices, down: Array) -> Mask:
        R, t, _ = form.chart_derivative(np.stack([side[rows], -down, ahead[rows]], axis=1))
        return teeth.pair.is_deeper(make_transform(R, t), teeth.closed_mm)

    found = np.full(len(side), np.nan)
    left = np.flatnonzero(wanted)
    for height in np.arange(_HIGHEST_MM, _LOWEST_MM, -_STEP_MM):
        hit = touches(left, np.full(len(left), height))
        rows, low, high = left[hit], np.full(hit.sum(), height), np.full(hit.sum(), height + _STEP_MM)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            inside = touches(rows, middle)
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        found[rows] = 0.5 * (low + high)
        left = left[~hit]
    found[left] = _LOWEST_MM
    down = found.reshape(len(d2), len(d3))
    nearest = distance_transform_edt(np.isnan(down), return_distances=False, return_indices=True)
    return np.asarray(down[tuple(nearest)])


def _near(points: Array, captured: Array) -> Mask:
    """Return which points (n, 2) are within about `_BEYOND_MM` of a captured point (m, 2) or of 0, by grid cells."""
    reach = int(np.ceil(_BEYOND_MM / _STEP_MM)) + 1
    cells = cKDTree(np.round(np.vstack([captured, [[0.0, 0.0]]]) / _STEP_MM))
    return cells.query(np.round(points / _STEP_MM), p=np.inf)[0] <= reach


def _hull(d2: Array, d3: Array, down: Array, slopes: tuple[float, float]) -> Array:
    """Return a smooth surface (n2, n3) [mm] on or above contact, with limited slopes; 0 at the closed bite."""
    limited = _dilated(down, slopes)
    surface = gaussian_filter(limited, _SMOOTHING, mode="nearest")
    for _ in range(_RAISES):
        missing = _dilated(np.maximum(limited - surface, 0.0), slopes)
        surface = surface + gaussian_filter(missing, _SMOOTHING, mode="nearest")
    away = (d2[:, None] ** 2 + d3**2) / _REST_MM**2
    rest = surface[np.argmin(np.abs(d2)), np.argmin(np.abs(d3))]
    return np.asarray(surface - rest * np.maximum(1.0 - away, 0.0) ** 2)


def _dilated(surface: Array, slopes: tuple[float, float]) -> Array:
    """Return the lowest surface on or above a surface (n2, n3) [mm] with limited slopes [mm/mm] along both axes."""
    out = surface
    for axis, slope in enumerate(slopes):
        n = surface.shape[axis]
        below = slope * _STEP_MM * np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
        out = np.moveaxis((np.moveaxis(out, axis, -1)[..., None, :] - below).max(axis=-1), -1, axis)
    return np.asarray(out)


def _factored(d2: Array, d3: Array, surface: Array) -> GlideTable:
    """Factor a surface (n2, n3) into a low-rank sum of products of curves, exactly 0 at the closed bite."""
    left, sizes, right = np.linalg.svd(surface, full_matrices=False)
    rank = 1
    while np.abs(surface - (left[:, :rank] * sizes[:rank]) @ right[:rank]).max() > _RANK_ERROR_MM:
        rank += 1
    root = np.sqrt(sizes[:rank])
    side, front = left[:, :rank] * root, right[:rank].T * root
    rest = side[np.argmin(np.abs(d2))] @ front[np.argmin(np.abs(d3))]
    return GlideTable(
        (d2, d3), (np.column_stack([side, np.full(len(d2), -rest)]), np.column_stack([front, np.ones(len(d3))]))
    )
