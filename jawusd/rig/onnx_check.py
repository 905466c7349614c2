"""Run ONNX sidecars and compare them with their model.

They run in onnxruntime where it is installed, else in the reference evaluator of the package onnx, which is slower.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx.external_data_helper import convert_model_from_external_data
from onnx.reference import ReferenceEvaluator

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, JawusdError, RigError
from jawusd.base.inputs import check_input
from jawusd.evaluator import JawRig
from jawusd.rig.arrays import model_hash
from jawusd.rig.onnx_graph import float_type
from jawusd.rig.onnx_sidecar import FORMAT
from jawusd.rig.sampling import sample_valid
from jawusd.rig.table import landmark_distance

#: No landmark may be farther from the model [mm].
ALLOWED_MM = 0.01
PROBES = 100

Floats = NDArray[np.float32] | NDArray[np.float64]
# (names of outputs, inputs by name) -> outputs
Run = Callable[[Sequence[str], Mapping[str, Floats]], list[Array]]


def runner(graph: bytes) -> Run:
    """Return what runs a graph, serialised as `load_sidecar` gave it, on one thread, with inputs of any float type."""
    model = onnx.load_from_string(graph)
    dtype = float_type(model)
    try:
        import onnxruntime
    except ImportError:
        run = ReferenceEvaluator(model).run
    else:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 4  # what fails is raised, too
        # optimising takes longer than thousands of poses gain
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        run = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"]).run

    def in_its_type(outputs: Sequence[str], inputs: Mapping[str, Floats]) -> list[Array]:
        found = run(list(outputs), {name: value.astype(dtype) for name, value in inputs.items()})
        return [np.asarray(value, dtype=np.float64) for value in found]

    return in_its_type


def check_written(path: str | os.PathLike[str], rig: JawRig) -> None:
    """Check that a sidecar that was just written gives what its model does.

    Raises:
        RigError: It is too far from the model, or cannot be run.
    """
    error_mm = onnx_error_mm(path, rig, sample_valid(rig, PROBES))
    if not error_mm <= ALLOWED_MM:
        raise RigError(f"is {error_mm:.3f} mm from the model, allowed {ALLOWED_MM} mm.", path=path)


def onnx_error_mm(path: str | os.PathLike[str], rig: JawRig, d: Array, recorded: str | None = None) -> float:
    """Return how far a graph is from the model [mm], as the largest landmark distance over parameters d (n, 3).

    A graph that decodes is compared by its poses. One that encodes gets the model's poses of d, and the poses of the
    parameters it finds are compared with them.

    Args:
        d: Parameters (n, 3) [mm].
        recorded: SHA-256 of the file that the rig records; any other file is refused unread. None disables the check:
            rigs baked before 0.1.0 record none.

    Raises:
        FormatError: Not the file of the rig, not an ONNX file of jawusd, or made from another model.
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


def load_sidecar(path: str | os.PathLike[str], rig: JawRig, recorded: str | None = None) -> onnx.ModelProto:
    """Read a graph that was made from the model of a rig.

    Raises:
        FormatError: As `onnx_error_mm` says.
    """
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
        convert_model_from_external_data(model)  # raises where weights lie in other files, which runtimes would read
    except Exception as error:  # the protobuf and onnx exceptions share no base
        raise FormatError(f"is not a valid ONNX file ({type(error).__name__}).", path=path) from error
    if model.functions or model.graph.sparse_initializer:  # where the check for other files does not look
        raise FormatError("has functions or sparse weights, which graphs of jawusd have not.", path=path)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    if properties.get("format") != FORMAT:
        raise FormatError(f"has the format {properties.get('format')!r}, expected {FORMAT!r}.", path=path)
    if properties.get("rig_hash") != model_hash(rig):
        raise FormatError("was made from another model (rig_hash differs); bake the rig again.", path=path)
    return model
