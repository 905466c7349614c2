"""The model's named arrays as USD attributes: hash, write, read. The evaluator checks what they hold."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd

from jawusd.errors import FormatError
from jawusd.evaluator import JawRig
from jawusd.rig import _gf
from jawusd.rig.layers import set_attribute
from jawusd.rig.layout import ARRAYS, PARAMETERS, ArraySpec

_TYPES = Sdf.ValueTypeNames


def specs_of(kind: str) -> dict[str, ArraySpec]:
    """Return where the arrays of a model kind lie."""
    return {name: spec for name, spec in ARRAYS.items() if spec.kind in (None, kind)}


def model_hash(rig: JawRig) -> str:
    """Return the SHA-256 of a rig's arrays: names, shapes and little-endian float64 values, in order of name."""
    digest = hashlib.sha256()
    for name, value in sorted(rig.arrays.items()):
        digest.update(f"{name}{list(value.shape)}".encode())
        digest.update(np.ascontiguousarray(value, dtype="<f8").tobytes())
    return digest.hexdigest()


def write_arrays(prim: Sdf.PrimSpec, rig: JawRig, prefixes: tuple[str, ...]) -> None:
    """Write the model arrays whose attribute names start with one of the prefixes."""
    for name, spec in specs_of(rig.meta["kind"]).items():
        if not spec.attribute.startswith(prefixes):
            continue
        value = rig.arrays[name]
        if spec.integer:
            set_attribute(prim, spec.attribute, _TYPES.IntArray, _gf.int_array(value))
        elif spec.shape:
            set_attribute(prim, spec.attribute, _TYPES.DoubleArray, _gf.double_array(value))
        else:
            set_attribute(prim, spec.attribute, _TYPES.Double, float(value))


def read_arrays(prim: Usd.Prim, kind: str, where: object) -> dict[str, NDArray]:
    """Read all model arrays of a rig prim, by attribute name.

    Returns:
        The arrays, by the names models give them.

    Raises:
        FormatError: an attribute is missing, is no array of numbers, or its length fits no shape.
    """
    arrays: dict[str, NDArray] = {}
    for name, spec in specs_of(kind).items():
        value = np.array(read_value(prim, spec.attribute, where))
        if value.dtype.kind not in "fiu" or value.ndim > 1:
            raise FormatError(f"{spec.attribute} holds no flat array of numbers.", path=str(where))
        try:
            arrays[name] = value.astype(np.float64).reshape(_full_shape(spec, arrays))
        except ValueError as error:
            shape = "(" + ", ".join(str(n) for n in spec.shape) + ")"
            message = f"{spec.attribute} holds {value.size} numbers, expected shape {shape}."
            raise FormatError(message, path=str(where)) from error
    arrays["d_range"] = np.array([read_value(prim, f"{d}:range", where) for d in PARAMETERS], dtype=np.float64)
    return arrays


def read_value(prim: Usd.Prim, name: str, where: object) -> object:
    """Return the default value of an attribute.

    Raises:
        FormatError: it has none.
    """
    attribute = prim.GetAttribute(name)
    value = attribute.Get() if attribute else None
    if value is None:
        raise FormatError(f"{prim.GetPath()} has no value for {name}; this is not a complete jaw rig.", path=str(where))
    return value


def _full_shape(spec: ArraySpec, known: dict[str, NDArray]) -> tuple[int, ...]:
    """Return the shape of a flat array, its one open length as -1."""
    if spec.shape == ("slices", "directions"):
        return (len(known["slice_d1"]), len(known["slice_directions"]))
    return tuple(-1 if isinstance(n, str) else n for n in spec.shape)
