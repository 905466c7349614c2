"""The ONNX sidecars: the exact model, not a fit of it, as graphs d -> pose, twist, margin and pose -> d, residual.

The batch size is dynamic. Two files, because decoding needs only arithmetic, which every runtime has, and encoding
needs a loop.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import onnx
from onnx import helper

from jawusd.base.version import __version__
from jawusd.evaluator import JawRig
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.rig.arrays import model_hash
from jawusd.rig.onnx_encode import add_encoder
from jawusd.rig.onnx_graph import FloatType, Graph, Value
from jawusd.rig.onnx_model import add_margin, add_twist, decode_motion, images

FORMAT = "jawusd-onnx/1"
OPSET = 17
_IR_VERSION = 8  # the one that came with opset 17: older runtimes refuse a newer number

Shapes = dict[str, list[str | int]]


def write_onnx(path: str | os.PathLike[str], model: onnx.ModelProto) -> Path:
    """Write a graph atomically.

    Raises:
        OutputError: The file cannot be written.
    """
    write_bytes_atomic(path, model.SerializeToString(deterministic=True))
    return Path(path)


def decode_model(rig: JawRig, dtype: FloatType = np.float32) -> onnx.ModelProto:
    """Build the graph that decodes jaw parameters.

    Input `d` (N, 3) [mm]. Outputs `pose` (N, 4, 4): T_skull_mandible, row-major, for column vectors [mm]; `twist`
    (N, 6): log(pose rest^-1), (omega [rad], v [mm]), skull frame; `margin` (N,): signed distance to the bound [mm],
    positive inside.

    Args:
        rig: the exact model.
        dtype: float32 or float64, of input, outputs and all arithmetic.
    """
    g = Graph(dtype)
    d = Value(g, "d")
    motion = decode_motion(g, rig, d)
    add_twist(g, rig, motion, "twist")
    columns = images(g, rig, motion, np.eye(4))  # of the pose, one after another, without its bottom row
    flat = columns @ np.eye(16).reshape(4, 4, 16)[:3].swapaxes(0, 1).reshape(12, 16) + g.constant([np.eye(16)[15]])
    g.op("Reshape", flat, g.constant([-1, 4, 4], np.int64), name="pose")
    g.op("Squeeze", add_margin(g, rig, d), g.constant([1], np.int64), name="margin")
    outputs: Shapes = {"pose": ["N", 4, 4], "twist": ["N", 6], "margin": ["N"]}
    return _model(g, rig, "jaw_decode", decode_model.__doc__, {"d": ["N", 3]}, outputs)


def encode_model(rig: JawRig, dtype: FloatType = np.float32) -> onnx.ModelProto:
    """Build the graph that finds the jaw parameters of poses.

    Input `pose` (N, 4, 4): T_skull_mandible, row-major, for column vectors [mm]. Outputs `d` (N, 3) [mm]: the
    parameters of the nearest pose of the model, by landmark distance, bounds ignored; `residual` (N,): that distance
    (rms over the landmarks) [mm]. A row with a NaN gives NaN.

    Args:
        rig: the exact model.
        dtype: float32 or float64, of input and outputs; the search computes in float64.
    """
    g = Graph(dtype)
    add_encoder(g, rig, Value(g, "pose"), "d", "residual")
    outputs: Shapes = {"d": ["N", 3], "residual": ["N"]}
    return _model(g, rig, "jaw_encode", encode_model.__doc__, {"pose": ["N", 4, 4]}, outputs)


def _model(g: Graph, rig: JawRig, name: str, doc: str | None, inputs: Shapes, outputs: Shapes) -> onnx.ModelProto:
    """Close a graph and label it."""

    def declared(shapes: Shapes) -> list[onnx.ValueInfoProto]:
        return [helper.make_tensor_value_info(key, g.elem_type, shape) for key, shape in shapes.items()]

    graph = helper.make_graph(g.nodes, name, declared(inputs), declared(outputs), g.initializers, doc_string=doc)
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
        "kind": rig.kind,
        "actor": rig.actor,
        "rig_hash": model_hash(rig),
        "d_range_mm": json.dumps(rig.d_range.tolist()),
    }
