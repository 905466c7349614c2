"""Piecewise cubic curves with given values and slopes, and the tooth-glide surface, a sum of products of two curves."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import EvaluatorError
from jawusd.evaluator.formula import catmull_rom, cubic


@dataclass(frozen=True)
class HermiteCurve:
    """A C1 cubic Hermite curve of one variable, continued as a straight line outside its knots."""

    knots: Array  # increasing parameter values, shape (n,), n >= 2
    values: Array  # points of the curve at the knots, shape (n, k)
    slopes: Array  # derivatives at the knots, shape (n, k)
    #: origin of the polynomial of each interval, the straight ends first and last, shape (n + 1,)
    starts: Array = field(init=False, repr=False)
    #: coefficients of the powers 0..3 of (x - start) per interval, shape (n + 1, 4, k)
    coefficients: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        # coefficients of s = x - knot per interval; intervals 0 and n are the straight ends, for which all is linear
        y, m = self.values, self.slopes
        inner = np.stack(cubic(np.diff(self.knots)[:, None], y[:-1], y[1:], m[:-1], m[1:]), axis=1)
        straight = np.zeros((2, *inner.shape[1:]))
        straight[0, :2] = y[0], m[0]
        straight[1, :2] = y[-1], m[-1]
        object.__setattr__(self, "starts", np.concatenate([self.knots[:1], self.knots]))
        object.__setattr__(self, "coefficients", np.concatenate([straight[:1], inner, straight[1:]]))

    def value(self, x: Array) -> Array:
        """Return the points at x (n,), shape (n, k)."""
        c, s = self._locate(x)
        return ((c[:, 3] * s + c[:, 2]) * s + c[:, 1]) * s + c[:, 0]

    def value_and_slope(self, x: Array) -> tuple[Array, Array]:
        """Return the points and the derivatives at x (n,), both of shape (n, k)."""
        c, s = self._locate(x)
        c0, c1, c2, c3 = c[:, 0], c[:, 1], c[:, 2], c[:, 3] * s
        return ((c3 + c2) * s + c1) * s + c0, (3 * c3 + 2 * c2) * s + c1

    def slope(self, x: Array) -> Array:
        """Return the derivatives at x (n,), shape (n, k)."""
        c, s = self._locate(x)
        return (3 * c[:, 3] * s + 2 * c[:, 2]) * s + c[:, 1]

    def _locate(self, x: Array) -> tuple[Array, Array]:
        interval = self.knots.searchsorted(x, side="right")
        return self.coefficients[interval], (x - self.starts[interval])[:, None]


_REST_MM = 1e-6


def interpolate_linear(knots: Array, values: Array, at: Array) -> Array:
    """Return the points (*at.shape, k) on straight lines between values (n, k) at knots (n,); constant outside."""
    return np.stack([np.interp(at, knots, column) for column in values.T], axis=-1)


def flat_ended(knots: Array, values: Array) -> HermiteCurve:
    """Return the curve through values (n, k) at knots (n,) with Catmull-Rom slopes, flat at both ends."""
    slopes = np.zeros_like(values)
    slopes[1:-1] = catmull_rom(values[:-2], values[2:], (knots[2:] - knots[:-2])[:, None])
    return HermiteCurve(knots, values, slopes)


class GlideTable:
    """The tooth-glide surface measured on scans: how far the jaw must open to slide with the teeth together.

    The surface is ``sum_r a_r(d2) b_r(d3)`` [mm]; each factor is a C1 cubic Hermite curve, constant outside its knots.

    Attributes:
        knots: Increasing knots of d2 and of d3 [mm].
        factors: Values of a_r at the knots of d2, shape (n2, r), and of b_r at those of d3, shape (n3, r).
        starts: Origins of the polynomials of each interval, the outer ones first and last, (n2 + 1,), (n3 + 1,).
        coefficients: Coefficients of the powers 0..3 of d2 and d3 minus their starts, by cell, (n2 + 1, n3 + 1, 4, 4).
    """

    def __init__(self, knots: tuple[Array, Array], factors: tuple[Array, Array]) -> None:
        self.knots, self.factors = knots, factors
        side, front = (flat_ended(k, f) for k, f in zip(knots, factors))
        self.starts = side.starts, front.starts
        self.coefficients = np.ascontiguousarray(np.einsum("ipr,jqr->ijpq", side.coefficients, front.coefficients))
        self._rising = knots[0].tolist(), knots[1].tolist()
        self._first = side.starts.tolist(), front.starts.tolist()
        self._cells = [list(row) for row in self.coefficients]

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> GlideTable | None:
        """Build the surface from a rig's arrays, None without one; raises EvaluatorError if not 0 in occlusion."""
        if "glide_d2" not in arrays:
            return None
        knots, factors = (
            tuple(np.asarray(arrays[f"glide_{d}{part}"], dtype=float) for d in ("d2", "d3"))
            for part in ("", "_factors")
        )
        table = cls((knots[0], knots[1]), (factors[0], factors[1]))
        rest = table.at_floats(0.0, 0.0)[0]
        if abs(rest) > _REST_MM:
            raise EvaluatorError(
                f'"glide_d2_factors" and "glide_d3_factors" give {rest:g} mm in occlusion; it must be 0.'
            )
        return table

    def arrays(self) -> dict[str, Array]:
        """Return the arrays of the glide surface by their names in a rig."""
        (k2, k3), (f2, f3) = self.knots, self.factors
        return {"glide_d2": k2, "glide_d2_factors": f2, "glide_d3": k3, "glide_d3_factors": f3}

    def at_floats(self, d2: float, d3: float) -> tuple[float, float, float]:
        """Return how far the jaw must open [mm] at d2, d3 [mm], and its derivatives with respect to both."""
        i, j = bisect_right(self._rising[0], d2), bisect_right(self._rising[1], d3)
        s, t = d2 - self._first[0][i], d3 - self._first[1][j]
        powers = np.array(((1.0, s, s * s, s * s * s), (0.0, 1.0, 2.0 * s, 3.0 * s * s)))
        a, b = powers.dot(self._cells[i][j]).tolist()
        down = ((a[3] * t + a[2]) * t + a[1]) * t + a[0]
        return down, ((b[3] * t + b[2]) * t + b[1]) * t + b[0], (3.0 * a[3] * t + 2.0 * a[2]) * t + a[1]

    def at_arrays(self, d2: Array, d3: Array) -> tuple[Array, Array, Array]:
        """Return how far the jaw must open [mm] at d2, d3 [mm], any shape, and its derivatives with respect to both."""
        i, j = self.knots[0].searchsorted(d2, side="right"), self.knots[1].searchsorted(d3, side="right")
        s, t = d2 - self.starts[0][i], d3 - self.starts[1][j]
        c = self.coefficients[i, j]
        x, y = s[..., None], t[..., None]
        a = ((c[..., 3, :] * x + c[..., 2, :]) * x + c[..., 1, :]) * x + c[..., 0, :]
        b = (3.0 * c[..., 3, :] * x + 2.0 * c[..., 2, :]) * x + c[..., 1, :]
        down, down_2 = (((p[..., 3:] * y + p[..., 2:3]) * y + p[..., 1:2]) * y + p[..., :1] for p in (a, b))
        return down[..., 0], down_2[..., 0], (3.0 * a[..., 3] * t + 2.0 * a[..., 2]) * t + a[..., 1]
