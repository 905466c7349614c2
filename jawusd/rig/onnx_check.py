"""Compare an ONNX sidecar with its model, with the onnx package's own reference evaluator."""

from __future__ import annotations

import os

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator

from jawusd.errors import FormatError
from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import transform_points
from jawusd.rig.arrays import model_hash
from jawusd.rig.onnx_graph import float_type
from jawusd.rig.onnx_sidecar import FORMAT


def onnx_error_mm(path: str | os.PathLike[str], rig: JawRig, d: NDArray[np.float64]) -> float:
    """Return how far a graph is from the model [mm], as the largest landmark distance over parameters d (n, 3).

    A graph that decodes is compared by its poses. One that encodes gets the model's poses of d, and the poses of the
    parameters it finds are compared with them.

    Raises:
        FormatError: not an ONNX file of jawusd, or made from another model.
    """
    model = _load(path, rig)
    dtype = float_type(model)
    run = ReferenceEvaluator(model).run
    if model.graph.input[0].name == "d":
        d = d.astype(dtype)
        exact = rig.pose(d.astype(np.float64))
        (found,) = run(["pose"], {"d": d})
    else:
        exact = rig.pose(d).astype(dtype).astype(np.float64)
        (encoded,) = run(["d"], {"pose": exact.astype(dtype)})
        found = rig.pose(encoded)
    moved = transform_points(found.astype(np.float64) - exact, rig.arrays["landmarks"][None])
    return float(np.linalg.norm(moved, axis=-1).max())


def _load(path: str | os.PathLike[str], rig: JawRig) -> onnx.ModelProto:
    try:
        model = onnx.load(os.fspath(path))
        onnx.checker.check_model(model)
    except Exception as error:  # the protobuf and onnx exceptions share no base
        raise FormatError(f"is not a valid ONNX file ({type(error).__name__}).", path=path) from error
    properties = {entry.key: entry.value for entry in model.metadata_props}
    if properties.get("format") != FORMAT:
        raise FormatError(f"has the format {properties.get('format')!r}, expected {FORMAT!r}.", path=path)
    if properties.get("rig_hash") != model_hash(rig):
        raise FormatError("was made from another model (rig_hash differs); bake the rig again.", path=path)
    return model
