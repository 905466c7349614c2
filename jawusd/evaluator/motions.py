"""Rigid motions of the mandible, for batches and for one pose in plain floats, and the frames of a rig.

Single poses, which DCC callbacks and face solvers need, have a second implementation in floats, without the call
overhead of numpy; tests compare the two. A motion (R, t) in floats consists of twelve numbers: the rows of ``R - I``,
then the displacement [mm] of a point p, the anchor: ``u = R p + t - p``.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator.curves import HermiteCurve
from jawusd.evaluator.gauge import FLOATS, displacement, gradient_by_u, spline_input
from jawusd.geometry.rodrigues import Triple, angle_coefficients, apply_series, dot, turning
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.geometry.so3 import batched_angle_coefficients

if TYPE_CHECKING:
    from jawusd.evaluator.models import AnchoredModel


def motions_from_twists(twists: Array) -> Array:
    """Return the motions (n, 4, 4) of twists (omega [rad], v [mm]), shape (n, 6): a faster `geometry.se3_exp`."""
    wx, wy, wz, vx, vy, vz = twists.T
    omega = wx, wy, wz
    a, b, c = batched_angle_coefficients(dot(omega, omega))
    M = _with_rotation(omega, a, b)
    M[:, 0, 3], M[:, 1, 3], M[:, 2, 3] = apply_series(omega, (vx, vy, vz), b, c)
    return M


def anchored_motions(omega: Array, moved: Array, anchor: Array) -> Array:
    """Return the motions (n, 4, 4) that rotate by omega (n, 3) [rad] and move an anchor (3,) to `moved` (n, 3) [mm]."""
    wx, wy, wz = omega.T
    a, b, _ = batched_angle_coefficients(dot((wx, wy, wz), (wx, wy, wz)))
    M = _with_rotation((wx, wy, wz), a, b)
    M[:, :3, 3] = moved - (M[:, :3, :3].reshape(-1, 3) @ anchor).reshape(-1, 3)
    return M


def _with_rotation(omega: Triple[Array], a: Array, b: Array) -> Array:
    """Return transforms (n, 4, 4) with the rotations ``I + a W + b W W``, W the skew matrix of omega."""
    M = np.zeros((len(a), 4, 4))
    for i, row in enumerate(turning(omega, a, b)):
        M[:, i, 0], M[:, i, 1], M[:, i, 2] = row
    M.reshape(-1, 16)[:, ::5] += 1.0
    return M


Vector = tuple[float, float, float]
Motion = tuple[float, ...]


class SingleAnchored:
    """A `models.AnchoredModel` for one finite d or u; the anchor is the incisal point."""

    def __init__(self, model: AnchoredModel) -> None:
        self._gauge = model.gauge.numbers
        self._scales: Vector = tuple(model.scales.tolist())
        self.anchor: Vector = tuple(model.incisor.tolist())
        self._offset: Vector = tuple(model.offset.tolist())
        count = len(model.centres)
        self._linear = model.weights[count:].tolist()
        self._kernel = np.ascontiguousarray(model.weights[:count])
        self._moments = np.ascontiguousarray(model.moments[:, :12].T)  # without |c_i|^2
        # |q - c|^2 as one product with (q, |q|^2, 1)
        self._distances = np.column_stack([-2.0 * model.centres, np.ones(count), model.centres_squared])

    def motion(self, d1: float, d2: float, d3: float) -> Motion:
        """Return M(d)."""
        u, _ = displacement(self._gauge, d1, d2, d3, FLOATS)
        q, _ = spline_input(self._gauge, self._scales, u, FLOATS)
        omega, _ = self._rotation(q)
        return _motion(omega, u)

    def decode_derivative(self, d: Array) -> tuple[Array, Array, Array]:
        """Return R (1, 3, 3), t (1, 3) and S (1, 6, 3) for one row d (1, 3)."""
        d1, d2, d3 = d[0].tolist()
        u, (x_1, y_1, y_2, y_3, z_1, z_2) = displacement(self._gauge, d1, d2, d3, FLOATS)
        return self._derivative(u, np.array(((x_1, 1.0, 0.0), (y_1, y_2, y_3), (z_1, z_2, 1.0))))

    def chart_derivative(self, u: Array) -> tuple[Array, Array, Array]:
        """Return R (1, 3, 3), t (1, 3) and S (1, 6, 3) with respect to u for one row u (1, 3)."""
        x, y, z = u[0].tolist()
        return self._derivative((x, y, z), np.eye(3))

    def _derivative(self, u: Vector, by_d: Array) -> tuple[Array, Array, Array]:
        q, slopes = spline_input(self._gauge, self._scales, u, FLOATS)
        omega, r = self._rotation(q)
        sums = self._moments.dot(r).tolist()
        omega_u = []
        for k in range(3):  # 3 sum W r (q - c) plus the linear terms, per output
            a, b, c = (3.0 * (sums[k] * q[i] - sums[3 + 3 * k + i]) + self._linear[i][k] for i in range(3))
            omega_u.append(gradient_by_u((a, b, c), self._scales, slopes))
        M = motion_matrix(_motion(omega, u), self.anchor)
        _, second, third = angle_coefficients(omega[0] * omega[0] + omega[1] * omega[1] + omega[2] * omega[2])
        turn = np.array(omega_u).dot(by_d)
        S = np.empty((1, 6, 3))
        spin = S[0, :3] = turn + np.array(turning(omega, second, third)).dot(turn)
        px, py, pz = (a + b for a, b in zip(u, self.anchor))
        S[0, 3:] = by_d + np.array(((0.0, -pz, py), (pz, 0.0, -px), (-py, px, 0.0))).dot(spin)
        return M[None, :3, :3], M[None, :3, 3], S

    def _rotation(self, q: Vector) -> tuple[Vector, Array]:
        """Return the rotation vector [rad] and the distances (m,) to the centres at the spline's argument."""
        q0, q1, q2 = q
        squared = self._distances.dot(np.array((q0, q1, q2, q0 * q0 + q1 * q1 + q2 * q2, 1.0)))
        np.abs(squared, squared)  # at a centre, rounding may make the square slightly negative
        r = np.sqrt(squared)
        squared *= r
        kx, ky, kz = squared.dot(self._kernel).tolist()
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = self._linear
        ox, oy, oz = self._offset
        return (
            kx + q0 * ax + q1 * bx + q2 * cx - ox,
            ky + q0 * ay + q1 * by + q2 * cy - oy,
            kz + q0 * az + q1 * bz + q2 * cz - oz,
        ), r


class SingleAdditive:
    """A `models.AdditiveModel`, given its curves, for one finite d; the anchor is the origin."""

    anchor: Vector = (0.0, 0.0, 0.0)

    def __init__(self, curves: Sequence[HermiteCurve]) -> None:
        self._curves = [(curve.knots.tolist(), list(curve.coefficients.transpose(0, 2, 1).copy())) for curve in curves]

    def motion(self, d1: float, d2: float, d3: float) -> Motion:
        """Return M(d)."""
        first, second, third = (_point(*curve, x) for curve, x in zip(self._curves, (d1, d2, d3)))
        wx, wy, wz, vx, vy, vz = (first + second + third).tolist()
        omega = wx, wy, wz
        a, b, c = angle_coefficients(wx * wx + wy * wy + wz * wz)
        x, y, z = turning(omega, a, b)
        return *x, *y, *z, *apply_series(omega, (vx, vy, vz), b, c)


SingleForm = SingleAnchored | SingleAdditive


def _point(knots: list[float], coefficients: list[Array], x: float) -> Array:
    """Return the point at x of a curve, given its knots and the polynomial coefficients of each interval."""
    interval = bisect_right(knots, x)
    s = x - knots[max(interval - 1, 0)]
    return coefficients[interval].dot(np.array((1.0, s, s * s, s * s * s)))


def motion_matrix(motion: Motion, anchor: Vector = (0.0, 0.0, 0.0)) -> Array:
    """Return a motion as a transform (4, 4)."""
    a, b, c, d, e, f, g, h, i, x, y, z = motion
    px, py, pz = anchor
    x, y, z = x - (a * px + b * py + c * pz), y - (d * px + e * py + f * pz), z - (g * px + h * py + i * pz)
    return np.array(((1.0 + a, b, c, x), (d, 1.0 + e, f, y), (g, h, 1.0 + i, z), (0.0, 0.0, 0.0, 1.0)))


def _motion(omega: Vector, u: Vector) -> Motion:
    x, y, z = omega
    a, b, _ = angle_coefficients(x * x + y * y + z * z)
    first, second, third = turning(omega, a, b)
    return *first, *second, *third, *u


class RigFrames:
    """The coordinate frames of a rig: for a motion M, ``T_skull_mandible = A^-1 M T_anatomical_mandible_rest``.

    Here A is T_anatomical_skull (4, 4). `adjoint` (6, 6) is Ad(A^-1), which maps twists to the skull frame.
    """

    def __init__(self, T_anatomical_skull: Array, T_rest: Array, anchor: Vector) -> None:
        """Precompute the matrix products; ``anchor`` [mm] is the anchor of the motions in floats, anatomical frame."""
        self.T_anatomical_skull = T_anatomical_skull
        self.T_skull_anatomical = se3_inverse(T_anatomical_skull)
        self.T_anatomical_mandible_rest = T_anatomical_skull @ T_rest
        self.T_mandible_anatomical_rest = se3_inverse(self.T_anatomical_mandible_rest)
        self.adjoint = se3_adjoint(self.T_skull_anatomical)
        # L M Q as one matrix product over all motions: rows of 16 times the Kronecker product of L^T and Q
        self._to_pose = np.kron(self.T_skull_anatomical.T, self.T_anatomical_mandible_rest)
        self._to_motion = np.kron(T_anatomical_skull.T, self.T_mandible_anatomical_rest)
        # likewise for the twelve numbers of one motion, ``M - I = (R - I, u - (R - I) p)``, and a 1 for the rest pose
        entries = self._to_pose.reshape(4, 4, 16)[:3]
        turn = entries[:, :3] - np.multiply.outer(anchor, entries[:, 3]).swapaxes(0, 1)
        self._single_to_pose = np.concatenate([turn.reshape(9, 16), entries[:, 3], T_rest.reshape(1, 16)])

    def pose(self, motion: Motion) -> Array:
        """Return the pose T_skull_mandible (4, 4) of one motion given as Python floats."""
        return np.array((*motion, 1.0)).dot(self._single_to_pose).reshape(4, 4)

    def poses(self, M: Array) -> Array:
        """Return the poses T_skull_mandible of motions, both of shape (n, 4, 4)."""
        return (M.reshape(-1, 16) @ self._to_pose).reshape(-1, 4, 4)

    def motions(self, T_skull_mandible: Array) -> tuple[Array, Array]:
        """Return rotation (n, 3, 3) and translation (n, 3) [mm] of the motions of poses (n, 4, 4)."""
        M = (T_skull_mandible.reshape(-1, 16) @ self._to_motion).reshape(-1, 4, 4)
        return M[:, :3, :3], M[:, :3, 3]


def motions_of_poses(T_skull_mandible: Array, T_anatomical_skull: Array, T_rest: Array) -> Array:
    """Return the motions ``M = A T rest^-1 A^-1`` away from the closed bite of poses, both of shape (..., 4, 4)."""
    return T_anatomical_skull @ T_skull_mandible @ se3_inverse(T_anatomical_skull @ T_rest)


def poses_of_motions(motion: Array, T_anatomical_skull: Array, T_rest: Array) -> Array:
    """Return the poses T_skull_mandible of motions away from the closed bite, both of shape (..., 4, 4)."""
    return se3_inverse(T_anatomical_skull) @ motion @ T_anatomical_skull @ T_rest
