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
    """Return the largest landmark distance [mm] between the graph's poses and the model's, over d (n, 3).

    Raises:
        FormatError: not an ONNX file of jawusd, or made from another model.
    """
    try:
        model = onnx.load(os.fspath(path))
        onnx.checker.check_model(model)
    except Exception as error:  # the protobuf and onnx exceptions share no base
        raise FormatError(f"is not a valid ONNX file ({type(error).__name__}).", path=path) from error
    properties = {entry.key: entry.value for entry in model.metadata_props}
    if properties.get("format") != FORMAT:
        raise FormatError(f"format is {properties.get('format')!r}, expected {FORMAT!r}.", path=path)
    if properties.get("rig_hash") != model_hash(rig):
        raise FormatError("was made from another model (rig_hash differs); bake the rig again.", path=path)
    dtype = float_type(model)
    d = d.astype(dtype)
    (pose,) = ReferenceEvaluator(model).run(["pose"], {"d": d})
    difference = pose.astype(np.float64) - rig.pose(d.astype(np.float64))
    return float(np.linalg.norm(transform_points(difference, rig.arrays["landmarks"][None]), axis=-1).max())
