"""Read npz files of plain arrays and a JSON string `meta`; safe against damaged and hostile files."""

from __future__ import annotations

import json
import lzma
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, UnitsError, VersionError
from jawusd.base.inputs import check_input

UNITS = {"length": "mm", "angle": "rad"}
TWIST_ORDER = ["omega", "v"]

NamedArrays = dict[str, Array]  # arrays of any dtype; `take` checks those that are used
JsonObject = dict[str, object]

# Maximum unpacked size of a file, ten times that of the largest array of 20,000 frames; guards against zip bombs.
_MAX_ARRAY_BYTES = 512 << 20
#: Exceptions of zipfile and numpy for damaged members, besides OSError: decoder errors, unsupported compression methods
#: and encryption (RuntimeError), headers that declare too much data (MemoryError) or nest too deeply, and errors of
#: Python's tokenizer, which numpy uses for headers that are not Python literals.
DAMAGED = (
    ValueError, EOFError, LookupError, TypeError, AttributeError, RuntimeError, MemoryError, OverflowError,
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, tokenize.TokenError, SyntaxError,
)  # fmt: skip


def read_npz(path: AnyPath, family: str, version: int) -> tuple[NamedArrays, JsonObject]:
    """Read the arrays and metadata of a jawusd npz file, and check format, version and units.

    `family` is the format's name without version, such as "jawusd-tracks"; `version` is the newest supported one.

    Raises:
        FormatError: the file is not of this family, or is damaged.
        VersionError: the file was written by a newer version.
        UnitsError: the file uses other units or another twist order.
    """
    path = Path(path)
    arrays = read_arrays(path)
    if "meta" not in arrays:
        raise FormatError(f'has no "meta"; a {family} file stores its format and units there.', path=path)
    try:
        meta = json.loads(str(arrays.pop("meta")))
    except (ValueError, RecursionError) as error:
        raise FormatError(f'"meta" is not JSON ({error}).', path=path) from error
    if not isinstance(meta, dict):
        raise FormatError('"meta" must be a JSON object.', path=path)
    check_format(meta.get("format"), family, version, path)
    check_units(meta, path)
    return arrays, meta


def read_arrays(path: AnyPath) -> NamedArrays:
    """Read the arrays of an npz file of any program; nothing is unpickled.

    Raises:
        FormatError: the file is not an npz file, or is damaged.
    """
    path = Path(path)
    check_input(path)
    arrays: NamedArrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            total = sum(member.file_size for member in archive.infolist())
        if total > _MAX_ARRAY_BYTES:
            raise FormatError(f"unpacks to {total / 1e9:.1f} GB; the limit is 0.5 GB.", path=path)
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                arrays[name] = archive[name]
                if not isinstance(arrays[name], np.ndarray):
                    raise FormatError(f'"{name}" is not an array.', path=path)
    except FileNotFoundError as error:
        raise FormatError("there is no such file.", path=path, hint="Check the path.") from error
    except (OSError, *DAMAGED) as error:
        raise FormatError(f"is not a readable npz file ({error!s:.200}).", path=path) from error
    return arrays


def check_format(found: object, family: str, version: int, path: AnyPath) -> int:
    """Check a format label such as ``"jawusd-tracks/1"`` and return its version.

    Raises:
        FormatError: the label names another format, or is missing.
        VersionError: the version is newer than supported.
    """
    if found is None:
        raise FormatError(f'states no format; its format must be "{family}/{version}".', path=path)
    name, _, number = str(found).partition("/")
    if name != family or not (number.isascii() and number.isdigit() and len(number) < 10):
        raise FormatError(f'format is "{found}"; expected "{family}/{version}".', path=path)
    if int(number) > version:
        raise VersionError(
            f'format is "{found}"; this version of jawusd reads formats up to "{family}/{version}".',
            path=path,
            hint="Update jawusd.",
        )
    return int(number)


def check_units(meta: Mapping[str, object], path: AnyPath) -> None:
    """Check the units and the twist order in a file's metadata.

    Raises:
        UnitsError: the units or the twist order are missing, or differ from mm, rad and (omega, v).
    """
    if meta.get("units") != UNITS:
        raise UnitsError(f"units are {meta.get('units')}; they must be {UNITS}.", path=path)
    if meta.get("twist_order") != TWIST_ORDER:
        raise UnitsError(f"twist order is {meta.get('twist_order')}; it must be {TWIST_ORDER}.", path=path)


def upgraded_model(arrays: NamedArrays, path: object) -> NamedArrays:
    """Return the arrays of a model of any version under their current names.

    Version 1 stored the tolerance of measured poses as the minimum margin of a valid pose, "margin_limit_mm".

    Raises:
        FormatError: the minimum margin is not a number.
    """
    known = dict(arrays)
    if "margin_limit_mm" in known:
        known.setdefault("tolerance_mm", np.negative(take(arrays, "margin_limit_mm", (), path), dtype=np.float64))
        del known["margin_limit_mm"]
    return known


def take(arrays: NamedArrays, name: str, shape: tuple[int | None, ...], path: object, *, finite: bool = True) -> Array:
    """Return one of the arrays of `read_npz` after checking its shape and finiteness.

    `shape` has None for any length; `finite` rejects NaN and infinity.

    Raises:
        FormatError: the array is missing, has another shape, or is not finite.
    """
    if name not in arrays:
        raise FormatError(f'has no array "{name}".', path=str(path))
    value = arrays[name]
    if value.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, value.shape, strict=True)):
        wanted = "(" + ", ".join("any" if w is None else str(w) for w in shape) + ")"
        raise FormatError(f'"{name}" has shape {value.shape}; expected {wanted}.', path=str(path))
    if value.dtype.kind not in "fiub":
        raise FormatError(f'"{name}" has type {value.dtype}; expected numbers.', path=str(path))
    if finite and value.dtype.kind == "f" and not np.isfinite(value).all():
        raise FormatError(f'"{name}" has values that are not finite.', path=str(path))
    return value


def fields_of_shapes(record: object, shapes: Mapping[str, tuple[int, ...]], what: str) -> NamedArrays:
    """Return fields of a record as arrays by name, for a file; `shapes` are those that they must have.

    Raises:
        ValueError: a field has another shape; the message calls the record `what`.
    """
    arrays = {name: np.asarray(getattr(record, name)) for name in shapes}
    for name, value in arrays.items():
        if value.shape != shapes[name]:
            raise ValueError(f"{what}.{name} has shape {value.shape}; expected {shapes[name]}")
    return arrays
