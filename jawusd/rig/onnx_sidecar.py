"""The ONNX sidecar: the exact model as a graph d -> pose, twist, margin, for any runtime.

Built operator by operator from the model's own arrays, so it is the model and not a fit of it. Dynamic batch.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper

from jawusd import __version__
from jawusd.evaluator import JawRig
from jawusd.evaluator.bounds import SliceHull
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.rig.arrays import model_hash
from jawusd.rig.onnx_graph import Graph, Rotation

FORMAT = "jawusd-onnx/1"
OPSET = 17
_IR_VERSION = 8  # the one that came with opset 17: older runtimes refuse a newer number

# constants of the gauge, as in jawusd.evaluator.gauge
_FADE_SOFTNESS_MM = 1.0
_LIMIT_SOFTNESS_MM = 4.0
_ARCH_BOW_MM = 10.0
_DROP_BEND = 0.15
_DROP_SATURATION_MM2 = 16.0

Arrays = Mapping[str, NDArray]


def write_onnx(path: str | os.PathLike[str], rig: JawRig, dtype: type = np.float32) -> Path:
    """Write the decode and margin graph of a rig; see `decode_model`.

    Raises:
        OutputError: the file cannot be written.
    """
    model = decode_model(rig, dtype)
    write_bytes_atomic(path, model.SerializeToString(deterministic=True))
    return Path(path)


def decode_model(rig: JawRig, dtype: type = np.float32) -> onnx.ModelProto:
    """Build the graph that decodes jaw parameters.

    Input `d` (N, 3) [mm]. Outputs `pose` (N, 4, 4): T_skull_mandible, row-major, for column vectors [mm]; `twist`
    (N, 6): log(pose rest^-1), (omega [rad], v [mm]), skull frame; `margin` (N,): signed distance to the bound [mm],
    positive inside.

    Args:
        rig: the exact model.
        dtype: float32 or float64, of input, outputs and all arithmetic.
    """
    g = Graph(np.dtype(dtype))
    decode = _anchored if rig.meta["kind"] == "anchored" else _additive
    omega, v, rotation, t = decode(g, rig.arrays, "d")
    g.concat(omega, v)
    g.nodes[-1].output[0] = "twist"
    _pose(g, rotation, t, rig.arrays["T_rest"])
    _margin(g, rig.arrays, "d")
    outputs = {"pose": ["N", 4, 4], "twist": ["N", 6], "margin": ["N"]}
    graph = helper.make_graph(
        g.nodes,
        "jaw_decode",
        [helper.make_tensor_value_info("d", g.elem_type, ["N", 3])],
        [helper.make_tensor_value_info(name, g.elem_type, shape) for name, shape in outputs.items()],
        g.initializers,
        doc_string=decode_model.__doc__,
    )
    model = helper.make_model(
        graph,
        producer_name="jawusd",
        producer_version=__version__,
        ir_version=_IR_VERSION,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
    helper.set_model_props(model, _metadata(rig))
    onnx.checker.check_model(model, full_check=True)
    return model


def _metadata(rig: JawRig) -> dict[str, str]:
    return {
        "format": FORMAT,
        "length_unit": "mm",
        "angle_unit": "rad",
        "twist_order": "omega v",
        "kind": rig.meta["kind"],
        "actor": str(rig.meta.get("actor", "")),
        "rig_hash": model_hash(rig),
        "d_range_mm": json.dumps(rig.arrays["d_range"].tolist()),
    }


def _anchored(g: Graph, arrays: Arrays, d: str) -> tuple[str, str, Rotation, str]:
    """Add the anchored model, turned into the skull frame; return omega, v, the rotation and the translation."""
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
    return omega, rotation.differentiate(t), rotation, t


def _displacement(g: Graph, arrays: Arrays, d: str) -> str:
    """Add the gauge: displacement (n, 3) of the incisal point, anatomical frame (jawusd.evaluator.gauge)."""
    d1, d2, d3 = g.columns(d, 3)
    e = float(arrays["glide_softness_mm"])
    gx, gz = _path(g, arrays, d1)
    low, high = (float(x) for x in arrays["path_limits"])
    rise = _soft_ramp(g, g.sub(d1, low), _LIMIT_SOFTNESS_MM)
    stop = _soft_ramp(g, g.sub(d1, high), _LIMIT_SOFTNESS_MM)
    s = g.mul(g.add(g.sub(rise, stop), low), 1.0 / float(arrays["path_scale_mm"]))
    side = g.sub(g.op("Sqrt", g.add(g.mul(d2, d2), e * e)), e)
    front = _soft_ramp(g, d3, e)

    c = [float(x) for x in arrays["glide_arch"]]
    by_side = g.horner(s, c[:3])
    by_d2 = g.horner(s, c[3:5])
    by_bow = g.mul(g.horner(s, c[5:]), 1.0 / _ARCH_BOW_MM)
    rho = g.add(g.mul(side, by_side), g.mul(d2, g.add(by_d2, g.mul(d2, by_bow))))

    w = [float(x) for x in arrays["glide_drop"]]
    drop = g.add(g.mul(side, w[0]), g.mul(front, w[1]), g.mul(_bent(g, side), w[2]), g.mul(_bent(g, front), w[3]))
    share = g.mul(_soft_ramp(g, d1, _FADE_SOFTNESS_MM), 1.0 / float(arrays["glide_fade_mm"]))
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
    return g.div(g.mul(square, _DROP_BEND), g.op("Sqrt", g.add(g.mul(square, 1.0 / _DROP_SATURATION_MM2), 1.0)))


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


def _additive(g: Graph, arrays: Arrays, d: str) -> tuple[str, str, Rotation, str]:
    """Add the sum of three twist curves, turned into the skull frame; return omega, v, rotation and translation."""
    turn = se3_adjoint(se3_inverse(arrays["T_anatomical_skull"])).T
    curves = []
    for i, x in enumerate(g.columns(d, 3), start=1):
        knots, twists, slopes = (arrays[f"curve{i}_{part}"] for part in ("knots", "twists", "slopes"))
        curves.append(g.hermite(x, knots, twists @ turn, slopes @ turn))
    twist = g.add(*curves)
    omega = g.matmul(twist, np.eye(6)[:, :3])
    v = g.matmul(twist, np.eye(6)[:, 3:])
    rotation = Rotation.of(g, omega)
    return omega, v, rotation, rotation.integrate(v)


def _pose(g: Graph, rotation: Rotation, t: str, T_rest: NDArray) -> None:
    """Add the output `pose` = exp(twist) rest: every column of rest is rotated, the last one moved as well."""
    images = [rotation.rotate(g.constant(T_rest[None, :3, i])) for i in range(4)]
    images[3] = g.add(images[3], t)
    axes = g.constant([2], np.int64)
    upper = g.concat(*(g.op("Unsqueeze", image, axes) for image in images), axis=2)
    zero = g.mul(g.sum_rows(rotation.omega), 0.0)  # as long as the batch
    bottom = g.concat(zero, zero, zero, g.add(zero, 1.0))
    g.op("Concat", upper, g.op("Unsqueeze", bottom, g.constant([1], np.int64)), axis=1, name="pose")


def _margin(g: Graph, arrays: Arrays, d: str) -> None:
    """Add the output `margin`: minus the soft maximum of the half-spaces (jawusd.evaluator.bounds)."""
    hull = SliceHull.from_arrays(arrays)
    knots = hull.supports.knots
    d1, d2, d3 = g.columns(d, 3)
    reach = g.hermite(d1, knots, hull.supports.values, hull.supports.slopes)
    sides = g.sub(g.matmul(g.concat(d2, d3), hull.directions.T), reach)
    v = g.concat(sides, g.sub(float(knots[0]), d1), g.sub(d1, float(knots[-1])))
    peak = g.op("ReduceMax", v, axes=[1], keepdims=1)
    powers = g.op("Exp", g.mul(g.sub(v, peak), 1.0 / hull.softness_mm))
    excess = g.add(peak, g.mul(g.op("Log", g.sum_rows(powers)), hull.softness_mm), -hull.margin_mm)
    g.op("Squeeze", g.op("Neg", excess), g.constant([1], np.int64), name="margin")
