"""The model's named arrays as USD attributes: hash, write, read. The evaluator checks what they hold."""

from __future__ import annotations

import numpy as np
from pxr import Sdf, Usd

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError
from jawusd.evaluator import JawRig
from jawusd.evaluator.schema import D_RANGE_ATTRIBUTES, OPTIONAL, ArraySpec, arrays_of
from jawusd.rig import _gf
from jawusd.rig.layers import set_attribute

_TYPES = Sdf.ValueTypeNames

#: Numbers or points in one array of a stage that are read: corners of as many triangles as mesh files may have.
MOST_VALUES = 30_000_000


def model_hash(rig: JawRig) -> str:
    """Return the SHA-256 of a rig's arrays, see `JawRig.model_hash`."""
    return rig.model_hash


def write_arrays(prim: Sdf.PrimSpec, rig: JawRig, prefixes: tuple[str, ...]) -> None:
    """Write the model arrays whose attribute names start with one of the prefixes."""
    optional = {name: spec for group in OPTIONAL.values() for name, spec in group.items() if name in rig.arrays}
    for name, spec in {**arrays_of(rig.kind), **optional}.items():
        if spec.attribute is None or not spec.attribute.startswith(prefixes):
            continue
        value = rig.arrays[name]
        if spec.integer:
            set_attribute(prim, spec.attribute, _TYPES.IntArray, _gf.int_array(value))
        elif spec.shape:
            set_attribute(prim, spec.attribute, _TYPES.DoubleArray, _gf.double_array(value))
        else:
            set_attribute(prim, spec.attribute, _TYPES.Double, float(value))


def read_arrays(prim: Usd.Prim, kind: str, where: object) -> dict[str, Array]:
    """Return all model arrays of a rig prim, by the names models give them.

    Raises:
        FormatError: An attribute is missing, is no array of numbers, or its length fits no shape.
    """
    arrays: dict[str, Array] = {}
    lengths: dict[str, int] = {}
    for name, spec in {**arrays_of(kind), **_optional_of(prim)}.items():
        if spec.attribute is None:
            ranges = [read_value(prim, attribute, where) for attribute in D_RANGE_ATTRIBUTES]
            arrays[name] = np.array(ranges, dtype=np.float64)
            continue
        value = np.array(read_value(prim, spec.attribute, where))
        if value.dtype.kind not in "fiu" or value.ndim > 1:
            raise FormatError(f"{spec.attribute} holds no flat array of numbers.", path=str(where))
        shape = [lengths.get(n, -1) if isinstance(n, str) else n for n in spec.shape]
        try:
            arrays[name] = value.astype(np.float64).reshape(shape)
        except ValueError as error:
            expected = "(" + ", ".join(str(n) for n in spec.shape) + ")"
            message = f"{spec.attribute} holds {value.size} numbers, expected shape {expected}."
            raise FormatError(message, path=str(where)) from error
        lengths.update((n, found) for n, found in zip(spec.shape, arrays[name].shape) if isinstance(n, str))
    return arrays


def _optional_of(prim: Usd.Prim) -> dict[str, ArraySpec]:
    """Return the arrays that not every rig has and this one does."""
    found: dict[str, ArraySpec] = {}
    for first, group in OPTIONAL.items():
        if prim.GetAttribute(group[first].attribute or "").HasAuthoredValue():
            found |= group
    return found


def read_value(prim: Usd.Prim, name: str, where: object) -> object:
    """Return the default value of an attribute.

    Raises:
        FormatError: It has none, or too many numbers.
    """
    attribute = prim.GetAttribute(name)
    value = value_of(attribute, where) if attribute else None
    if value is None:
        raise FormatError(f"{prim.GetPath()} has no value for {name}; this is not a complete jaw rig.", path=str(where))
    return value


def value_of(attribute: Usd.Attribute, where: object, time: Usd.TimeCode | None = None) -> object:
    """Return the value of an attribute, its default or that at a time; None if there is none.

    Raises:
        FormatError: It is an array of more than `MOST_VALUES`.
    """
    value = attribute.Get(Usd.TimeCode.Default() if time is None else time)
    if hasattr(value, "__len__") and len(value) > MOST_VALUES:
        found = f"{attribute.GetPath()} holds {len(value)} values, at most {MOST_VALUES} are read."
        raise FormatError(found, path=str(where))
    return value
