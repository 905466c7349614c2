"""Read a rig from ``model.npz``, format jawusd-model/1, with numpy alone."""

from __future__ import annotations

import json
import lzma
import os
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import EvaluatorError, FormatError, UnitsError, VersionError
from jawusd.evaluator.rig import JawRig

FAMILY, VERSION = "jawusd-model", 1
UNITS = {"length": "mm", "angle": "rad"}
TWIST_ORDER = ["omega", "v"]

# what zipfile and numpy raise for damaged members, beside OSError
_DAMAGED = (
    ValueError, EOFError, LookupError, TypeError, AttributeError, RuntimeError, MemoryError, OverflowError,
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error,
)  # fmt: skip
# far above any model (about 100 kB); guards against archives that unpack to fill the memory
_MOST_BYTES = 256 << 20


def load(path: str | os.PathLike[str]) -> JawRig:
    """Read a rig from a jaw model file.

    Args:
        path: A ``model.npz`` as `jawusd fit` writes it.

    Raises:
        FormatError: not such a file, damaged, or arrays missing, of wrong shape or not finite.
        VersionError: written by a newer jawusd.
        UnitsError: lengths, angles or twists in another convention.
    """
    path = Path(path)
    arrays = _read_arrays(path)
    meta = _read_meta(arrays, path)
    try:
        return JawRig(arrays, meta)
    except EvaluatorError as error:
        raise FormatError(error.message, path=path, hint="Fit the model again, or get an undamaged copy.") from error


def _read_arrays(path: Path) -> dict[str, NDArray]:
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _MOST_BYTES:
            allowed = f"at most {_MOST_BYTES / 1e6:.0f} MB are read."
            raise FormatError(f"unpacks to {size / 1e6:.0f} MB; {allowed}", path=path)
        with np.load(path, allow_pickle=False) as archive:
            return {name: np.asarray(archive[name]) for name in archive.files}
    except FileNotFoundError as error:
        raise FormatError("there is no such file.", path=path) from error
    except (OSError, *_DAMAGED) as error:
        raise FormatError(f"is not a readable npz file ({error!s:.200}).", path=path) from error


def _read_meta(arrays: dict[str, NDArray], path: Path) -> dict[str, Any]:
    try:
        meta = json.loads(str(arrays.pop("meta")))
    except KeyError as error:
        raise FormatError('has no "meta"; a jaw model carries its format and units there.', path=path) from error
    except (ValueError, RecursionError) as error:
        raise FormatError(f'"meta" is not JSON ({error}).', path=path) from error
    if not isinstance(meta, dict):
        raise FormatError('"meta" must be a JSON object.', path=path)
    family, _, number = str(meta.get("format")).partition("/")
    if family != FAMILY or not (number.isascii() and number.isdecimal() and len(number) < 10):
        raise FormatError(f'format is "{meta.get("format")}", expected "{FAMILY}/{VERSION}".', path=path)
    if int(number) > VERSION:
        raise VersionError(
            f'format is "{meta["format"]}", this jawusd reads up to "{FAMILY}/{VERSION}".',
            path=path,
            hint="Update jawusd.",
        )
    if meta.get("units") != UNITS:
        raise UnitsError(f"units are {meta.get('units')}, allowed are {UNITS}.", path=path)
    if meta.get("twist_order") != TWIST_ORDER:
        raise UnitsError(f"twist order is {meta.get('twist_order')}, allowed is {TWIST_ORDER}.", path=path)
    return meta
