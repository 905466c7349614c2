"""Attributes of a rig prim: model arrays, key times, and upgrades of older format versions.

To add a format version:

1. Increment `layout.FORMAT_VERSION`.
2. Add the upgrade from the previous version to `UPGRADES`. It derives the new attributes from the old ones.
3. Write golden rigs of the new version with `tests/golden/make_golden_rig.py`; keep the old ones for tests.
4. Do the same in `plugins/jawusd_reader.py`.

Upgrades happen in memory; files are never rewritten. To write a rig of the current version, run `jawusd bake`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
from pxr import Sdf, Usd

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import FormatError, VersionError
from jawusd.evaluator import JawRig
from jawusd.evaluator.kinds import D_RANGE_ATTRIBUTES, present_arrays
from jawusd.rig import layers
from jawusd.rig.layers import set_attribute
from jawusd.rig.layout import FORMAT_VERSION

if TYPE_CHECKING:
    from pxr import Ts  # missing in OpenUSD 24.11


_TYPES = Sdf.ValueTypeNames

#: Maximum number of elements in an array: the number of face corners of the largest accepted mesh.
MAX_VALUES = 30_000_000


def write_arrays(prim: Sdf.PrimSpec, rig: JawRig, prefixes: tuple[str, ...]) -> None:
    """Write the model arrays whose attribute names start with one of the prefixes."""
    for name, spec in present_arrays(rig.kind, lambda name, _: name in rig.arrays).items():
        if spec.attribute is None or not spec.attribute.startswith(prefixes):
            continue
        value = rig.arrays[name]
        if spec.integer:
            set_attribute(prim, spec.attribute, _TYPES.IntArray, layers.int_array(value))
        elif spec.shape:
            set_attribute(prim, spec.attribute, _TYPES.DoubleArray, layers.double_array(value))
        else:
            set_attribute(prim, spec.attribute, _TYPES.Double, float(value))


def read_arrays(prim: Usd.Prim, kind: str) -> dict[str, Array]:
    """Return all model arrays of a rig prim by name; raises FormatError for missing, wrong or too short ones."""
    arrays: dict[str, Array] = {}
    lengths: dict[str, int] = {}
    authored = present_arrays(kind, lambda _, spec: prim.GetAttribute(spec.attribute or "").HasAuthoredValue())
    for name, spec in authored.items():
        if spec.attribute is None:
            ranges = [read_value(prim, attribute) for attribute in D_RANGE_ATTRIBUTES]
            arrays[name] = np.array(ranges, dtype=np.float64)
            continue
        value = np.array(read_value(prim, spec.attribute))
        if value.dtype.kind not in "fiu" or value.ndim > 1:
            raise FormatError(f"{spec.attribute} is not a flat array of numbers.")
        shape = [lengths.get(n, -1) if isinstance(n, str) else n for n in spec.shape]
        try:
            arrays[name] = value.astype(np.float64).reshape(shape)
        except ValueError as error:
            expected = "(" + ", ".join(str(n) for n in spec.shape) + ")"
            raise FormatError(f"{spec.attribute} has {value.size} numbers, expected shape {expected}.") from error
        lengths.update((n, found) for n, found in zip(spec.shape, arrays[name].shape) if isinstance(n, str))
    return arrays


def read_value(prim: Usd.Prim, name: str) -> object:
    """Return the default value of an attribute; raises FormatError if there is none, or too many numbers."""
    attribute = prim.GetAttribute(name)
    value = value_of(attribute) if attribute else None
    if value is None:
        raise FormatError(f"{prim.GetPath()} has no value for {name}; the jaw rig is incomplete.")
    return value


def value_of(attribute: Usd.Attribute, time: Usd.TimeCode | None = None) -> object:
    """Return the value of an attribute at a time, by default its default; raises FormatError for over `MAX_VALUES`."""
    value = attribute.Get(Usd.TimeCode.Default() if time is None else time)
    if hasattr(value, "__len__") and len(value) > MAX_VALUES:
        raise FormatError(f"{attribute.GetPath()} has {len(value)} values, more than the limit of {MAX_VALUES}.")
    return value


#: Maximum number of frames of a motion that is read or written, enough for an hour at 60 frames per second.
MAX_FRAMES = 220_000


def key_times(attribute: Usd.Attribute) -> list[float]:
    """Return the times of an attribute's samples; for a spline, its knots and the whole frames between them."""
    spline = _spline_of(attribute)
    if spline is None:
        return list(attribute.GetTimeSamples())
    return _with_frames(np.array(sorted(spline.GetKnots()))).tolist()


def _with_frames(keys: Array) -> Array:
    """Return increasing times with the whole frames between them, unless these are too many."""
    first, last = np.ceil(keys.min(initial=np.inf)), np.floor(keys.max(initial=-np.inf))
    return np.union1d(keys, np.arange(first, last + 1)) if 0 <= last - first < MAX_FRAMES else keys


def values_at(attribute: Usd.Attribute, times: Iterable[float]) -> list[float | None]:
    """Return the values of an attribute at times; splines are evaluated here, because OpenUSD 25.02 only reads them."""
    spline = _spline_of(attribute)
    return [attribute.Get(time) if spline is None else spline.Eval(time) for time in times]


def _spline_of(attribute: Usd.Attribute) -> Ts.Spline | None:
    """Return the spline of an attribute; None if it has none, or if time samples or a default value are stronger."""
    if not hasattr(attribute, "HasSpline") or not attribute.HasSpline():  # OpenUSD 24.11 has no splines
        return None
    for spec in attribute.GetPropertyStack():
        strongest = next((name for name in ("timeSamples", "spline", "default") if spec.HasInfo(name)), None)
        if strongest:
            return attribute.GetSpline() if strongest == "spline" else None
    return None


def key_and_frame_times(attributes: Iterable[Usd.Attribute]) -> tuple[Array, Mask]:
    """Return the times (n,) of samples of several attributes and whole frames between them, and a mask of samples."""
    keys = np.unique(np.concatenate([np.zeros(0), *(key_times(attribute) for attribute in attributes)]))
    times = _with_frames(keys)
    return times, np.isin(times, keys)


def time_codes(times: Array) -> list[Usd.TimeCode]:
    """Return times as time codes; without times, return the default time code."""
    return [Usd.TimeCode(time) for time in times.tolist()] or [Usd.TimeCode.Default()]


def _upgrade_1_to_2(prim: Usd.Prim) -> None:
    """Derive the tolerance of measured poses; format version 1 stored the smallest valid margin instead."""
    limit = read_value(prim, "jaw:thresholds:margin")
    if not isinstance(limit, float):
        raise FormatError(f"jaw:thresholds:margin is {limit!r}; expected a number.")
    tolerance = prim.CreateAttribute("jaw:thresholds:tolerance", Sdf.ValueTypeNames.Double)
    tolerance.Set(-limit)


UPGRADES: dict[int, Callable[[Usd.Prim], None]] = {1: _upgrade_1_to_2}


def upgrade_rig(prim: Usd.Prim) -> None:
    """Check the format version of a rig prim, and upgrade an older one in the session layer of the stage, in memory.

    Raises:
        FormatError: The version is not a positive integer.
        VersionError: The rig's format is newer than this version of jawusd supports.
    """
    version = read_value(prim, "jaw:formatVersion")
    if not isinstance(version, int) or version < 1:
        raise FormatError(f"jaw:formatVersion is {version!r}; expected a positive integer.")
    if version > FORMAT_VERSION:
        raise VersionError(
            f"the rig has format version {version}; this version of jawusd reads versions up to {FORMAT_VERSION}.",
            hint="Update jawusd.",
        )
    stage = prim.GetStage()
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for step in range(version, FORMAT_VERSION):
            UPGRADES[step](prim)
            prim.GetAttribute("jaw:formatVersion").Set(step + 1)


def was_upgraded(prim: Usd.Prim) -> bool:
    """Return whether `upgrade_rig` changed a rig prim, so that the hashes in its files no longer match its values."""
    path = prim.GetPath().AppendProperty("jaw:formatVersion")
    return prim.GetStage().GetSessionLayer().GetAttributeAtPath(path) is not None
