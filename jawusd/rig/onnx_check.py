"""Compare an ONNX sidecar with its model, with the onnx package's own reference evaluator."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import onnx
from onnx.reference import ReferenceEvaluator

from jawusd.errors import FormatError, JawusdError
from jawusd.evaluator import JawRig
from jawusd.geometry.arrays import Array
from jawusd.inputs import check_input
from jawusd.rig.arrays import model_hash
from jawusd.rig.onnx_graph import float_type
from jawusd.rig.onnx_sidecar import FORMAT
from jawusd.rig.table import landmark_distance


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
    model = _load(path, rig, recorded)
    try:
        return _error_mm(model, rig, d)
    except JawusdError:
        raise
    except Exception as error:  # damaged graphs raise errors of any type, depending on the operator
        raise FormatError(f"cannot be run ({type(error).__name__}).", path=path) from error


def _error_mm(model: onnx.ModelProto, rig: JawRig, d: Array) -> float:
    dtype = float_type(model)
    run = ReferenceEvaluator(model).run
    if model.graph.input[0].name == "d":
        d = d.astype(dtype)
        exact = rig.pose(d.astype(np.float64))
        (pose,) = run(["pose"], {"d": d})
        found = np.asarray(pose, dtype=np.float64)
    else:
        exact = rig.pose(d).astype(dtype).astype(np.float64)
        (encoded,) = run(["d"], {"pose": exact.astype(dtype)})
        found = rig.pose(np.asarray(encoded))
    return float(landmark_distance(rig, found, exact).max())


def _load(path: str | os.PathLike[str], rig: JawRig, recorded: str | None) -> onnx.ModelProto:
    check_input(path)
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}.", path=path) from error
    if recorded is not None and hashlib.sha256(content).hexdigest() != recorded:
        raise FormatError("is not the file baked with the rig (SHA-256 differs); bake the rig again.", path=path)
    try:
        model = onnx.load_from_string(content)  # as bytes: weights in other files are not looked for
        onnx.checker.check_model(model)
    except Exception as error:  # the protobuf and onnx exceptions share no base
        raise FormatError(f"is not a valid ONNX file ({type(error).__name__}).", path=path) from error
    properties = {entry.key: entry.value for entry in model.metadata_props}
    if properties.get("format") != FORMAT:
        raise FormatError(f"has the format {properties.get('format')!r}, expected {FORMAT!r}.", path=path)
    if properties.get("rig_hash") != model_hash(rig):
        raise FormatError("was made from another model (rig_hash differs); bake the rig again.", path=path)
    return model
