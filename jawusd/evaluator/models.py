"""The forms of the jaw model, which map parameters d [mm] to a rigid motion, with exact derivatives.

All quantities are in the anatomical frame (x left, y up, z anterior, mm, origin at the upper incisal point): a model
returns the motion ``M(d)`` away from the closed bite, ``M(0) = I``. `jawusd.evaluator.rig` maps it to the skull frame.
All functions take rows: d has shape (n, 3); a row with a NaN gives NaN.

Derivatives are *spatial*: ``S`` of shape (n, 6, 3) with ``M(d + e) = exp(S e) M(d)`` to first order; twists are
(omega [rad], v [mm]).

The search for the nearest pose runs in a chart chosen by the model, with coordinates x of shape (n, 3) [mm]: the
incisal displacement if the model can be evaluated from it without the gauge, otherwise d itself. The nearest pose does
not depend on the chart.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.gauge import ARRAYS, Gauge, gradient_by_u, spline_input
from jawusd.evaluator.kinds import ADDITIVE, ANCHORED
from jawusd.evaluator.motions import (
    SingleAdditive,
    SingleAnchored,
    SingleForm,
    anchored_motions,
    motion_matrix,
    motions_from_twists,
)
from jawusd.geometry.se3 import se3_left_jacobian, se3_left_jacobian_inverse
from jawusd.geometry.so3 import so3_left_jacobian, so3_left_jacobian_inverse


class JawModelForm(ABC):
    """A jaw model. By default its chart is d, and everything follows from log M(d); a kind may override any of it."""

    kind: ClassVar[str]
    incisor: Array  # the lower incisal point at rest [mm], shape (3,)
    d_range: Array  # box of d [mm] over which searches start, shape (3, 2)
    single: SingleForm  # the model for one d, in floats

    @abstractmethod
    def arrays(self) -> dict[str, Array]:
        """Return the arrays of the model by their names in a rig."""

    @abstractmethod
    def log(self, d: Array) -> Array:
        """Return the twist log M(d), shape (n, 6)."""

    @abstractmethod
    def log_jacobian(self, d: Array) -> Array:
        """Return d log M / dd, shape (n, 6, 3)."""

    @cached_property
    def starts(self) -> StartGrid:
        """Starting points of searches in d."""
        return StartGrid.of(self.decode, self.incisor, self.d_range)

    def motion(self, d: Array) -> Array:
        """Return M(d) as transforms, shape (n, 4, 4)."""
        return motions_from_twists(self.log(d))

    def decode(self, d: Array) -> tuple[Array, Array]:
        """Return the rotation (n, 3, 3) and translation (n, 3) [mm] of M(d)."""
        M = self.motion(d)
        return M[:, :3, :3], M[:, :3, 3]

    def decode_derivative(self, d: Array) -> tuple[Array, Array, Array]:
        """Return rotation, translation [mm] and the spatial derivative S (n, 6, 3) of M(d)."""
        twist = self.log(d)
        M = motions_from_twists(twist)
        return M[:, :3, :3], M[:, :3, 3], se3_left_jacobian(twist) @ self.log_jacobian(d)

    def chart_start(self, R: Array, t: Array) -> Array:
        """Return starting points (n, 3), in chart coordinates, of searches for motions (R, t)."""
        return self.starts.nearest(R @ self.incisor + t - self.incisor)

    def chart_motion(self, x: Array) -> Array:
        """Return the motions at chart coordinates x (n, 3) [mm] as transforms, shape (n, 4, 4)."""
        return self.motion(x)

    def chart_derivative(self, x: Array) -> tuple[Array, Array, Array]:
        """Return rotation, translation [mm] and the derivative S (n, 6, 3) at chart coordinates x (n, 3) [mm]."""
        return self.decode_derivative(x)

    def chart_parameters(self, x: Array) -> Array:
        """Return the d (n, 3) [mm] of chart coordinates x (n, 3) [mm]."""
        return x


@dataclass(frozen=True)
class AnchoredModel(JawModelForm):
    """Rotation as a function of the position of the lower incisal point: ``omega = f(u), t = u + p - R(omega) p``.

    f is a polyharmonic r^3 spline with a linear tail (Duchon 1977) in the displacement u of the incisal point p,
    sheared by the habitual opening path so that its first axis runs along opening; ``f(0) = 0``.
    """

    kind: ClassVar[str] = ANCHORED
    gauge: Gauge  # map between d and u
    incisor: Array  # the incisal point p at rest [mm], shape (3,)
    scales: Array  # lengths dividing the sheared displacement [mm], shape (3,)
    centres: Array  # spline centres, sheared and scaled, shape (m, 3)
    weights: Array  # weights of the m kernels and the 3 linear terms [rad], shape (m + 3, 3)
    centres_squared: Array = field(init=False, repr=False)  # |c_i|^2, shape (m,)
    #: kernel weights times 1, c_i and |c_i|^2, shape (m, 15); see `_spline`
    moments: Array = field(init=False, repr=False)
    #: value of the spline itself at u = 0 [rad], subtracted so that f(0) = 0, shape (3,)
    offset: Array = field(init=False, repr=False)
    _scales: tuple[float, float, float] = field(init=False, repr=False)
    single: SingleAnchored = field(init=False, repr=False)  # the model for one row, in floats

    def __post_init__(self) -> None:
        # one matrix product gives the sums of r_i times W_i, W_i c_i and W_i |c_i|^2, from which `_spline` follows
        squared = np.einsum("ij,ij->i", self.centres, self.centres)
        kernel = self.weights[: len(self.centres)]
        by_centre = (kernel[:, :, None] * self.centres[:, None, :]).reshape(len(kernel), 9)
        moments = np.concatenate([kernel, by_centre, kernel * squared[:, None]], axis=1)
        object.__setattr__(self, "centres_squared", squared)
        object.__setattr__(self, "_scales", tuple(self.scales.tolist()))
        object.__setattr__(self, "moments", np.ascontiguousarray(moments))
        object.__setattr__(self, "offset", np.zeros(3))
        object.__setattr__(self, "offset", self._spline(np.zeros((1, 3)))[0][0])
        object.__setattr__(self, "single", SingleAnchored(self))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> AnchoredModel:
        """Build the model from the named arrays of a rig."""
        return cls(
            gauge=Gauge.from_arrays(arrays),
            incisor=np.asarray(arrays["incisor"], dtype=float),
            scales=np.asarray(arrays["spline_scales"], dtype=float),
            centres=np.asarray(arrays["spline_centres"], dtype=float),
            weights=np.asarray(arrays["spline_weights"], dtype=float),
        )

    def arrays(self) -> dict[str, Array]:
        """Return the arrays of an anchored model by their names in a rig."""
        own = {"spline_scales": self.scales, "spline_centres": self.centres, "spline_weights": self.weights}
        return {**self.gauge.arrays(), **own}

    def decode(self, d: Array) -> tuple[Array, Array]:
        """Return the rotation (n, 3, 3) and translation (n, 3) [mm] of M(d)."""
        if len(d) == 1 and np.isfinite(d).all():
            M = motion_matrix(self.single.motion(*d[0].tolist()), self.single.anchor)[None]
        else:
            M = self.motion(d)
        return M[:, :3, :3], M[:, :3, 3]

    def motion(self, d: Array) -> Array:
        """Return M(d) as transforms, shape (n, 4, 4)."""
        return self.chart_motion(self.gauge.displacement(d))

    def decode_derivative(self, d: Array) -> tuple[Array, Array, Array]:
        """Return rotation, translation [mm] and the spatial derivative S (n, 6, 3) of M(d)."""
        if len(d) == 1 and np.isfinite(d).all():
            return self.single.decode_derivative(d)
        u, du = self.gauge.displacement_jacobian(d)
        R, t, by_u = self.chart_derivative(u)
        return R, t, by_u @ du

    def chart_start(self, R: Array, t: Array) -> Array:
        """Return the incisal displacement u (n, 3) [mm] of the motions (R, t), which is the chart's coordinate."""
        return R @ self.incisor + t - self.incisor

    def chart_motion(self, x: Array) -> Array:
        """Return the motions that displace the incisal point by x (n, 3) [mm] as transforms, shape (n, 4, 4)."""
        return anchored_motions(self.rotation(x), x + self.incisor, self.incisor)

    def chart_derivative(self, x: Array) -> tuple[Array, Array, Array]:
        """Return rotation, translation [mm] and the spatial derivative (n, 6, 3) with respect to x (n, 3) [mm]."""
        if len(x) == 1 and np.isfinite(x).all():
            return self.single.chart_derivative(x)
        omega, omega_x = self.rotation_jacobian(x)
        M = anchored_motions(omega, x + self.incisor, self.incisor)
        S = np.empty((len(x), 6, 3))
        S[:, :3] = so3_left_jacobian(omega) @ omega_x
        # the incisal point itself moves by dx: w x (x + p) + v = dx
        S[:, 3:] = np.eye(3) + np.cross((x + self.incisor)[:, :, None], S[:, :3], axis=1)
        return M[:, :3, :3], M[:, :3, 3], S

    def log(self, d: Array) -> Array:
        """Return the twist log M(d), shape (n, 6)."""
        u = self.gauge.displacement(d)
        omega = self.rotation(u)
        t = anchored_motions(omega, u + self.incisor, self.incisor)[:, :3, 3]
        return np.concatenate([omega, np.einsum("nij,nj->ni", so3_left_jacobian_inverse(omega), t)], axis=1)

    def log_jacobian(self, d: Array) -> Array:
        """Return d log M / dd, shape (n, 6, 3)."""
        return se3_left_jacobian_inverse(self.log(d)) @ self.decode_derivative(d)[2]

    def chart_parameters(self, x: Array) -> Array:
        """Return the d (n, 3) [mm] of incisal displacements x (n, 3) [mm]."""
        return self.gauge.inverse(x)

    def rotation(self, u: Array) -> Array:
        """Return the rotation vector f(u) (n, 3) [rad] for incisal displacements u (n, 3) [mm]."""
        q, _ = spline_input(self.gauge.numbers, self._scales, tuple(u.T), ARRAYS)
        return self._spline(np.stack(q, axis=1))[0]

    def rotation_jacobian(self, u: Array) -> tuple[Array, Array]:
        """Return f(u) (n, 3) [rad] and df/du (n, 3, 3) [rad/mm]."""
        q, slopes = spline_input(self.gauge.numbers, self._scales, tuple(u.T), ARRAYS)
        omega, omega_q = self._spline(np.stack(q, axis=1))
        by_q = omega_q[:, :, 0], omega_q[:, :, 1], omega_q[:, :, 2]
        by_u = gradient_by_u(by_q, self._scales, (slopes[0][:, None], slopes[1][:, None]))
        return omega, np.stack(by_u, axis=2)

    def _spline(self, q: Array) -> tuple[Array, Array]:
        """Return the spline at q (n, 3) and its gradient (n, 3 outputs, 3 inputs).

        With ``r_i = |q - c_i|``: ``sum W_i r_i^3 = sum W_i r_i (|q|^2 - 2 q.c_i + |c_i|^2)`` and its gradient is
        ``3 sum W_i r_i (q - c_i)``.
        """
        q_squared = np.einsum("ni,ni->n", q, q)
        r = q @ (-2.0 * self.centres.T)
        r += self.centres_squared
        r += q_squared[:, None]
        np.maximum(r, 0.0, out=r)  # at a centre, rounding may make the expanded square slightly negative
        np.sqrt(r, out=r)
        sums = r @ self.moments
        plain, by_centre = sums[:, :3], sums[:, 3:12].reshape(-1, 3, 3)
        linear = self.weights[len(self.centres) :]
        value = q_squared[:, None] * plain + sums[:, 12:] + q @ linear - self.offset
        value -= 2.0 * np.einsum("nij,nj->ni", by_centre, q)
        return value, 3.0 * (plain[:, :, None] * q[:, None, :] - by_centre) + linear.T


@dataclass(frozen=True)
class AdditiveModel(JawModelForm):
    """A sum of three curves in se(3), 0 at d = 0: ``log M(d) = Phi1(d1) + Phi2(d2) + Phi3(d3)`` (Yang 2019, eq. 5)."""

    kind: ClassVar[str] = ADDITIVE
    #: the three curves of twists, about the origin of the anatomical frame
    curves: tuple[HermiteCurve, HermiteCurve, HermiteCurve]
    incisor: Array  # the incisal point at rest [mm], shape (3,)
    d_range: Array  # box of valid d [mm], shape (3, 2)
    single: SingleAdditive = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "single", SingleAdditive(self.curves))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> AdditiveModel:
        """Build the model from the named arrays of a rig."""
        parts = ("knots", "twists", "slopes")
        first, second, third = (
            HermiteCurve(*(np.asarray(arrays[f"curve{i}_{part}"], dtype=float) for part in parts)) for i in (1, 2, 3)
        )
        return cls(
            curves=(first, second, third),
            incisor=np.asarray(arrays["incisor"], dtype=float),
            d_range=np.asarray(arrays["d_range"], dtype=float),
        )

    def arrays(self) -> dict[str, Array]:
        """Return the arrays of an additive model by their names in a rig."""
        own: dict[str, Array] = {}
        for i, curve in enumerate(self.curves, start=1):
            parts = {"knots": curve.knots, "twists": curve.values, "slopes": curve.slopes}
            own |= {f"curve{i}_{part}": values for part, values in parts.items()}
        return own

    def log(self, d: Array) -> Array:
        """Return the twist log M(d), shape (n, 6)."""
        first, second, third = self.curves
        return first.value(d[:, 0]) + second.value(d[:, 1]) + third.value(d[:, 2])

    def log_jacobian(self, d: Array) -> Array:
        """Return d log M / dd, shape (n, 6, 3)."""
        return np.stack([curve.slope(d[:, i]) for i, curve in enumerate(self.curves)], axis=2)


@dataclass(frozen=True)
class StartGrid:
    """A grid of starting points for searches in models without a closed-form inverse."""

    d: Array  # jaw parameters [mm], shape (s, 3)
    displacements: Array  # displacements of the incisal point there [mm], shape (s, 3)

    @classmethod
    def of(cls, decode: Callable[[Array], tuple[Array, Array]], incisor: Array, d_range: Array) -> StartGrid:
        """Decode a grid over the box d_range (3, 2) [mm]."""
        # the opening axis is long and curved, the others short; with 13 x 9 x 9 nodes, every point lies in the
        # Gauss-Newton basin of at least one node
        axes = [np.linspace(low, high, n) for (low, high), n in zip(d_range, (13, 9, 9))]
        d = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        R, t = decode(d)
        return cls(d, R @ incisor + t - incisor)

    def nearest(self, u: Array) -> Array:
        """Return the d (n, 3) whose incisal displacement is nearest to u (n, 3) [mm]; NaN for NaN."""
        grid = self.displacements
        distance = np.einsum("ij,ij->i", grid, grid) - 2.0 * u @ grid.T
        return np.where(np.isfinite(u).all(axis=1, keepdims=True), self.d[np.argmin(distance, axis=1)], np.nan)


FORMS: dict[str, Callable[[Mapping[str, Array]], JawModelForm]] = {
    model.kind: model.from_arrays for model in (AnchoredModel, AdditiveModel)
}
