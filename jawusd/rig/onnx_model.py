"""The exact jaw model as ONNX operators, in the skull frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.evaluator import JawRig
from jawusd.evaluator import gauge as shape
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.rig.onnx_graph import Graph, Rotation

Arrays = Mapping[str, NDArray]


@dataclass(frozen=True)
class Motion:
    """Hold the motion exp(twist) away from the closed bite, as values of a graph.

    Attributes:
        omega: rotation vectors (n, 3) [rad].
        v: the other half of the twists (n, 3) [mm].
        rotation: exp(omega).
        t: translations (n, 3) [mm].
    """

    omega: str
    v: str
    rotation: Rotation
    t: str

    def carry(self, g: Graph, vector: NDArray, *, moves: bool) -> str:
        """Return the images (n, 3) of one constant vector (3,): rotated, and moved as well if it is a point."""
        image = self.rotation.rotate(g.constant(vector[None]))
        return g.add(image, self.t) if moves else image


def decode_motion(g: Graph, rig: JawRig, d: str) -> Motion:
    """Add the model to a graph: parameters d (n, 3) [mm] to a motion in the skull frame."""
    return _anchored(g, rig.arrays, d) if rig.meta["kind"] == "anchored" else _additive(g, rig.arrays, d)


def _anchored(g: Graph, arrays: Arrays, d: str) -> Motion:
    """Add the anchored model, turned into the skull frame."""
    u = _displacement(g, arrays, d)
    ux, uy, uz = g.columns(u, 3)
    opening = g.op("Neg", uy)
    gx, gz = _path(g, arrays, opening)
    q = g.div(g.concat(opening, g.sub(ux, gx), g.sub(uz, gz)), g.constant(arrays["spline_scales"][None]))
    to_skull = arrays["T_anatomical_skull"][:3, :3]  # a row vector times this is its skull coordinates
    omega = _spline(g, arrays["spline_centres"], arrays["spline_weights"] @ to_skull, q)
    u_skull = g.matmul(u, to_skull)
    incisor = (arrays["incisor"] - arrays["T_anatomical_skull"][:3, 3]) @ to_skull
    rotation = Rotation.of(g, omega)
    p = g.constant(incisor[None])
    t = g.sub(g.add(u_skull, p), rotation.rotate(p))
    return Motion(omega, rotation.differentiate(t), rotation, t)


def _displacement(g: Graph, arrays: Arrays, d: str) -> str:
    """Add the gauge: displacement (n, 3) [mm] of the incisal point, anatomical frame."""
    d1, d2, d3 = g.columns(d, 3)
    e = float(arrays["glide_softness_mm"])
    gx, gz = _path(g, arrays, d1)
    low, high = (float(x) for x in arrays["path_limits"])
    rise = _soft_ramp(g, g.sub(d1, low), shape.LIMIT_SOFTNESS_MM)
    stop = _soft_ramp(g, g.sub(d1, high), shape.LIMIT_SOFTNESS_MM)
    s = g.mul(g.add(g.sub(rise, stop), low), 1.0 / float(arrays["path_scale_mm"]))
    side = g.sub(g.op("Sqrt", g.add(g.mul(d2, d2), e * e)), e)
    front = _soft_ramp(g, d3, e)

    c = [float(x) for x in arrays["glide_arch"]]
    by_side = g.horner(s, c[:3])
    by_d2 = g.horner(s, c[3:5])
    by_bow = g.mul(g.horner(s, c[5:]), 1.0 / shape.ARCH_BOW_MM)
    rho = g.add(g.mul(side, by_side), g.mul(d2, g.add(by_d2, g.mul(d2, by_bow))))

    w = [float(x) for x in arrays["glide_drop"]]
    drop = g.add(g.mul(side, w[0]), g.mul(front, w[1]), g.mul(_bent(g, side), w[2]), g.mul(_bent(g, front), w[3]))
    share = g.mul(_soft_ramp(g, d1, shape.FADE_SOFTNESS_MM), 1.0 / float(arrays["glide_fade_mm"]))
    fade = g.op("Exp", g.op("Neg", g.mul(share, share)))
    y = g.op("Neg", g.add(d1, g.mul(drop, fade)))
    return g.concat(g.add(gx, d2), y, g.add(gz, rho, d3))


def _path(g: Graph, arrays: Arrays, opening: str) -> tuple[str, str]:
    """Add the habitual path at openings (n, 1); return gx and gz [mm]."""
    low, high = (float(x) for x in arrays["path_limits"])
    scale = float(arrays["path_scale_mm"])
    inside = g.clip(opening, low, high)
    s = g.mul(inside, 1.0 / scale)
    beyond = g.sub(opening, inside)
    points = []
    for c in arrays["path_coefficients"].tolist():
        value = g.mul(g.horner(s, c), s)
        slope = g.mul(g.horner(s, [k * x for k, x in enumerate(c, start=1)]), 1.0 / scale)
        points.append(g.add(value, g.mul(slope, beyond)))
    return points[0], points[1]


def _soft_ramp(g: Graph, x: str, e: float) -> str:
    return g.mul(g.add(x, g.sub(g.op("Sqrt", g.add(g.mul(x, x), e * e)), e)), 0.5)


def _bent(g: Graph, x: str) -> str:
    square = g.mul(x, x)
    straightening = g.op("Sqrt", g.add(g.mul(square, 1.0 / shape.DROP_SATURATION_MM2), 1.0))
    return g.div(g.mul(square, shape.DROP_BEND), straightening)


def _spline(g: Graph, centres: NDArray, weights: NDArray, q: str) -> str:
    """Add the polyharmonic spline sum_i w_i |q - c_i|^3 + q L, less its value at q = 0."""
    m = len(centres)
    r2: str | None = None
    for column, centre in zip(g.columns(q, 3), centres.T, strict=True):
        difference = g.sub(column, g.constant(centre[None]))
        square = g.mul(difference, difference)
        r2 = square if r2 is None else g.add(r2, square)
    kernel = g.mul(str(r2), g.op("Sqrt", str(r2)))
    at_rest = (np.linalg.norm(centres, axis=1) ** 3) @ weights[:m]
    return g.sub(g.add(g.matmul(kernel, weights[:m]), g.matmul(q, weights[m:])), g.constant(at_rest[None]))


def _additive(g: Graph, arrays: Arrays, d: str) -> Motion:
    """Add the sum of three twist curves, turned into the skull frame."""
    turn = se3_adjoint(se3_inverse(arrays["T_anatomical_skull"])).T
    curves = []
    for i, x in enumerate(g.columns(d, 3), start=1):
        knots, twists, slopes = (arrays[f"curve{i}_{part}"] for part in ("knots", "twists", "slopes"))
        curves.append(g.hermite(x, knots, twists @ turn, slopes @ turn))
    twist = g.add(*curves)
    omega = g.matmul(twist, np.eye(6)[:, :3])
    v = g.matmul(twist, np.eye(6)[:, 3:])
    rotation = Rotation.of(g, omega)
    return Motion(omega, v, rotation, rotation.integrate(v))
