"""A rig that evaluates poses, twists, margins and encoding with onnxruntime, in single precision."""

from __future__ import annotations

from functools import cached_property, partial
from pathlib import Path

import numpy as np

from jawusd.base.errors import AnyPath, FormatError, MissingDependencyError

try:
    import onnxruntime  # noqa: F401
except ModuleNotFoundError as error:
    raise MissingDependencyError("running ONNX files needs onnxruntime.", hint="pip install 'jawusd[build]'") from error

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.batching import usable_rows
from jawusd.evaluator.bounds import SliceHull
from jawusd.evaluator.encoding import Encoder
from jawusd.evaluator.kernels import NumpyKernels
from jawusd.evaluator.rig import load
from jawusd.rig.onnx_sidecar import Run, check_made_from, load_sidecar, read_sidecar, rig_in, runner
from jawusd.rig.read import load_rig

_NEAR_MM = 1e-3  # absolute margin below which the sign is uncertain in single precision, and is computed in double


def load_onnx(path: AnyPath, prim: str | None = None) -> JawRig:
    """Load the rig of an ONNX file, to be evaluated with the graphs in ONNX files.

    `X.onnx` decodes and contains the rig; `X_encode.onnx` in the same folder, if it exists, encodes. Files of older
    versions contain no rig: `X.usda`, with `prim` as for `load_rig`, or `model.npz` in the folder then provides it.

    Raises:
        FormatError: The file is no decoder of jawusd, was made from another model, or there is no rig for it.
    """
    path = Path(path)
    decode = read_sidecar(path)
    if [entry.name for entry in decode.graph.input] != ["d"]:
        raise FormatError('is an encoder; expected the decoder, which has the input "d".', path=path)
    rig = rig_in(decode, path) or _rig_beside(path, prim)
    check_made_from(decode, rig, path)
    encoder = path.with_name(f"{path.stem}_encode.onnx")
    encode = load_sidecar(encoder, rig).SerializeToString() if encoder.is_file() else None
    found = JawRig(rig.arrays, rig.meta, kernels=partial(OnnxKernels, decode.SerializeToString(), encode))
    try:
        found.pose(np.zeros(3))
    except Exception as error:  # damaged graphs raise errors of any type, depending on the operator
        raise FormatError(f"cannot be run ({type(error).__name__}).", path=path) from error
    return found


def _rig_beside(path: Path, prim: str | None) -> JawRig:
    """Return the rig in the folder of an ONNX file that contains none."""
    actor, model = path.with_suffix(".usda"), path.with_name("model.npz")
    if not actor.is_file() and not model.is_file():
        raise FormatError(
            f"contains no rig, and neither {actor.name} nor {model.name} is next to it.",
            path=path,
            hint="Load it from the folder of its rig, or bake the rig again: newer ONNX files contain it.",
        )
    return load_rig(actor, prim) if actor.is_file() else load(model)


class OnnxKernels(NumpyKernels):
    """Kernels that use ONNX graphs for poses, twists, margins and the nearest pose, and numpy for the rest."""

    def __init__(self, decode: bytes, encode: bytes | None, encoder: Encoder, bound: SliceHull) -> None:
        super().__init__(encoder, bound)
        self._files = decode, encode

    def pose(self, d1: float, d2: float, d3: float) -> Array:
        """Return T_skull_mandible (4, 4) of one d [mm]."""
        return self.poses(np.array([(d1, d2, d3)]))[0]

    def margin(self, d1: float, d2: float, d3: float) -> float:
        """Return the margin [mm] of one d [mm]."""
        return float(self.margins(np.array([(d1, d2, d3)]))[0])

    def poses(self, d: Array) -> Array:
        """Return the poses T_skull_mandible (n, 4, 4) of d (n, 3) [mm]."""
        return self._decoded("pose", d)

    def twists(self, d: Array) -> Array:
        """Return the twists (n, 6) log(pose(d) rest^-1), skull frame, of d (n, 3) [mm]."""
        return self._decoded("twist", d)

    def margins(self, d: Array) -> Array:
        """Return the margins (n,) [mm] of d (n, 3) [mm]."""
        margins = self._decoded("margin", d)
        near = np.abs(margins) < _NEAR_MM
        margins[near] = super().margins(d[near])
        return margins

    def nearest(self, T: Array) -> tuple[Array, Array]:
        """Return the d (n, 3) [mm] of the poses nearest to T (n, 4, 4), and the residuals (n,) [mm]."""
        if self._encode is None:
            return super().nearest(T)
        d, residual_mm = self._encode(["d", "residual"], {"pose": T})
        return d, residual_mm

    def _decoded(self, output: str, d: Array) -> Array:
        return self._decode([output], {"d": usable_rows(d)})[0]

    @cached_property
    def _decode(self) -> Run:
        return runner(self._files[0])

    @cached_property
    def _encode(self) -> Run | None:
        return None if self._files[1] is None else runner(self._files[1])
