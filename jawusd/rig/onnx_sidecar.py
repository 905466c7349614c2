"""The ONNX sidecars of a rig: exact graphs from d to pose, twist and margin, and from a pose to d and residual.

Decoder and encoder are separate files: the decoder needs only arithmetic, which every runtime supports, but the encoder
needs a loop. Graphs are run by onnxruntime if it is installed, otherwise by the slower evaluator of the package onnx.
The metadata of the decoder contain the whole rig as JSON: `arrays`, named as in `jawusd.evaluator.kinds`, and `header`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper
from onnx.external_data_helper import convert_model_from_external_data
from onnx.reference import ReferenceEvaluator

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, EvaluatorError, FormatError, JawusdError, RigError
from jawusd.base.inputs import check_input
from jawusd.base.version import __version__
from jawusd.evaluator import JawRig
from jawusd.evaluator.kinds import every_array
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.rig.onnx_encoder import add_encoder, add_margin, add_twist, decode_motion, images
from jawusd.rig.onnx_graph import FloatType, Graph, Value, float_type
from jawusd.rig.table import landmark_distance, sample_valid

FORMAT = "jawusd-onnx/1"
OPSET = 17
_IR_VERSION = 8  # ONNX file version released with opset 17; older runtimes reject newer versions

#: Maximum landmark distance of a graph's poses from those of the model [mm].
ALLOWED_MM = 0.01
PROBES = 100  # number of random valid d at which graphs are compared with the model

Shapes = dict[str, list[str | int]]
Floats = NDArray[np.float32] | NDArray[np.float64]
# (names of outputs, inputs by name) -> outputs
Run = Callable[[Sequence[str], Mapping[str, Floats]], list[Array]]


def write_onnx(path: AnyPath, model: onnx.ModelProto) -> Path:
    """Write a graph atomically; raises OutputError if that fails."""
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
    columns = images(g, rig, motion, np.eye(4))  # columns of the pose without its bottom row, concatenated
    flat = columns @ np.eye(16).reshape(4, 4, 16)[:3].swapaxes(0, 1).reshape(12, 16) + g.constant([np.eye(16)[15]])
    g.op("Reshape", flat, g.constant([-1, 4, 4], np.int64), name="pose")
    g.op("Squeeze", add_margin(g, rig, d), g.constant([1], np.int64), name="margin")
    outputs: Shapes = {"pose": ["N", 4, 4], "twist": ["N", 6], "margin": ["N"]}
    return _model(g, rig, "jaw_decode", decode_model.__doc__, {"d": ["N", 3]}, outputs, _whole_rig(rig))


def encode_model(rig: JawRig, dtype: FloatType = np.float32) -> onnx.ModelProto:
    """Build the graph that finds the jaw parameters of poses.

    Input `pose` (N, 4, 4): T_skull_mandible, row-major, for column vectors [mm]. Outputs `d` (N, 3) [mm]: the
    parameters of the nearest pose of the model, by landmark distance, without regard to bounds; `residual` (N,): that
    distance (rms over the landmarks) [mm]. A row with a NaN gives NaN.

    Args:
        rig: the exact model.
        dtype: float32 or float64, of input and outputs; the search computes in float64.
    """
    g = Graph(dtype)
    add_encoder(g, rig, Value(g, "pose"), "d", "residual")
    outputs: Shapes = {"d": ["N", 3], "residual": ["N"]}
    return _model(g, rig, "jaw_encode", encode_model.__doc__, {"pose": ["N", 4, 4]}, outputs)


def _model(
    g: Graph,
    rig: JawRig,
    name: str,
    doc: str | None,
    inputs: Shapes,
    outputs: Shapes,
    more: Mapping[str, str] = MappingProxyType({}),
) -> onnx.ModelProto:
    """Return a checked ONNX model made from a graph, with the metadata of the rig and those in ``more``."""

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
    metadata = {
        "format": FORMAT,
        "length_unit": "mm",
        "angle_unit": "rad",
        "twist_order": "omega v",
        "kind": rig.kind,
        "actor": rig.actor,
        "rig_hash": rig.model_hash,
        "d_range_mm": json.dumps(rig.d_range.tolist()),
    }
    helper.set_model_props(model, {**metadata, **more})
    onnx.checker.check_model(model, full_check=True)
    return model


def _whole_rig(rig: JawRig) -> dict[str, str]:
    """Return the arrays and the header of a rig as JSON, read by `rig_in`."""
    integer = {name for name, spec in every_array().items() if spec.integer}
    arrays = {name: (a.astype(int) if name in integer else a).tolist() for name, a in rig.arrays.items()}
    return {"arrays": json.dumps(arrays), "header": json.dumps(rig.meta, sort_keys=True)}


def rig_in(model: onnx.ModelProto, path: AnyPath) -> JawRig | None:
    """Return the rig in the metadata of a graph, None in older files; raises FormatError if it is damaged."""
    properties = _properties(model)
    if "arrays" not in properties:
        return None
    try:
        arrays, header = (json.loads(properties.get(name, "")) for name in ("arrays", "header"))
        if isinstance(arrays, dict) and isinstance(header, dict):
            return JawRig(arrays, header)
    except (ValueError, RecursionError, EvaluatorError) as error:
        raise FormatError(f"has no usable rig in its metadata ({error}).", path=path) from error
    raise FormatError("has no usable rig in its metadata: its entries must be JSON objects.", path=path)


def _properties(model: onnx.ModelProto) -> dict[str, str]:
    return {entry.key: entry.value for entry in model.metadata_props}


def runner(graph: bytes) -> Run:
    """Return a function that runs a graph from `load_sidecar` on one thread, with inputs of any float type."""
    model = onnx.load_from_string(graph)
    dtype = float_type(model)
    try:
        import onnxruntime
    except ImportError:
        run = ReferenceEvaluator(model).run
    else:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 4  # no log: failures are raised as exceptions
        # optimising the graph takes longer than it saves over thousands of poses
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        run = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"]).run

    def run_cast(outputs: Sequence[str], inputs: Mapping[str, Floats]) -> list[Array]:
        found = run(list(outputs), {name: value.astype(dtype) for name, value in inputs.items()})
        return [np.asarray(value, dtype=np.float64) for value in found]

    return run_cast


def check_written(path: AnyPath, rig: JawRig) -> None:
    """Raise RigError if the results of a written sidecar deviate too far from those of its model."""
    error_mm = onnx_error_mm(path, rig, sample_valid(rig, PROBES))
    if not error_mm <= ALLOWED_MM:
        raise RigError(f"is {error_mm:.3f} mm from the model; the maximum is {ALLOWED_MM} mm.", path=path)


def onnx_error_mm(path: AnyPath, rig: JawRig, d: Array, recorded: str | None = None) -> float:
    """Return the largest landmark distance [mm] between a graph and the model over parameters d (n, 3) [mm].

    A decoder's poses of d are compared with the model's. An encoder gets the model's poses of d; the model's poses of
    the parameters it returns are compared with them. `recorded` is the SHA-256 of the file in the rig; rigs baked
    before 0.1.0 record none.

    Raises:
        FormatError: The file is not the recorded one, is not an ONNX file of jawusd, or was made from another model.
    """
    model = load_sidecar(path, rig, recorded)
    try:
        return _error_mm(model, rig, d)
    except JawusdError:
        raise
    except Exception as error:  # damaged graphs raise errors of any type, depending on the operator
        raise FormatError(f"cannot be run ({type(error).__name__}).", path=path) from error


def _error_mm(model: onnx.ModelProto, rig: JawRig, d: Array) -> float:
    dtype = float_type(model)
    run = runner(model.SerializeToString())
    if model.graph.input[0].name == "d":
        d = d.astype(dtype)
        exact = rig.pose(d.astype(np.float64))
        (found,) = run(["pose"], {"d": d})
    else:
        exact = rig.pose(d).astype(dtype).astype(np.float64)
        (encoded,) = run(["d"], {"pose": exact})
        found = rig.pose(encoded)
    return float(landmark_distance(rig, found, exact).max())


def load_sidecar(path: AnyPath, rig: JawRig, recorded: str | None = None) -> onnx.ModelProto:
    """Read a graph that was made from the model of a rig; raises FormatError as `onnx_error_mm` does."""
    model = read_sidecar(path, recorded)
    check_made_from(model, rig, path)
    return model


def check_made_from(model: onnx.ModelProto, rig: JawRig, path: AnyPath) -> None:
    """Raise FormatError if a graph was not made from the model of a rig."""
    if _properties(model).get("rig_hash") != rig.model_hash:
        raise FormatError("was made from another model (rig_hash differs); bake the rig again.", path=path)


def read_sidecar(path: AnyPath, recorded: str | None = None) -> onnx.ModelProto:
    """Read a graph; raises FormatError if it is not the recorded file, or not an ONNX file of jawusd."""
    check_input(path)
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}.", path=path) from error
    if recorded is not None and hashlib.sha256(content).hexdigest() != recorded:
        raise FormatError("is not the file baked with the rig (SHA-256 differs); bake the rig again.", path=path)
    try:
        model = onnx.load_from_string(content)
        onnx.checker.check_model(model)
        # fails if the weights are stored in external files, because a runtime would open those files
        convert_model_from_external_data(model)
    except Exception as error:  # the exceptions of protobuf and onnx have no common base class
        raise FormatError(f"is not a valid ONNX file ({type(error).__name__}).", path=path) from error
    # the check above does not search these fields for external data
    if model.functions or model.graph.sparse_initializer:
        raise FormatError("has functions or sparse weights; graphs written by jawusd have neither.", path=path)
    found = _properties(model).get("format")
    if found != FORMAT:
        raise FormatError(f"has the format {found!r}; expected {FORMAT!r}.", path=path)
    return model
