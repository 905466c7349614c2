"""Read and evaluate jaw rigs in any Python: one file without dependencies, independent of jawusd itself.

`python -m jawusd.plugins FOLDER` writes this file; put it next to your script. To read `model.npz`, it needs only
Python 3.9; to read USD files, it needs the `pxr` modules, which Blender, Maya, Houdini and Unreal include.

    import jawusd_reader
    rig = jawusd_reader.load("actor/actor.usda")
    T = rig.pose(20.0, 3.0, 0.5)             # d1, d2, d3 [mm] -> T_skull_mandible, rows of a 4x4 for column vectors
    translation, wxyz = jawusd_reader.decompose(T)
    rig.margin(20.0, 3.0, 0.5)               # signed distance to the bound [mm], > 0 inside
    rig.is_inside(20.0, 3.0, 0.5)            # True if the margin is 0 or more
    rig.project(20.0, 7.6, 9.2)              # the nearest (d1, d2, d3) inside the bound
    rig.ranges(20.0)                         # ((d2 min, d2 max), (d3 min, d3 max)) for sliders
"""

from __future__ import annotations

import ast
import json
import math
import os
import struct
import sys
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from jawusd.evaluator.formula import ON_BOUND_MM, BoundFormula
from jawusd.evaluator.kinds import D_RANGE_ATTRIBUTES, GLIDE_ARRAYS, MODELS, arrays_of
from jawusd.evaluator.nearest import nearest_in_valley, pulled_in
from jawusd.evaluator.operations import FloatOperations, Rows, rows
from jawusd.geometry.rodrigues import Triple

if TYPE_CHECKING:
    from pxr import Usd

Pair = tuple[float, float]
FORMAT_VERSION = 2
SCHEMA = "JawRigAPI"
PARAMETERS = ("d1", "d2", "d3")
LABELS = ("Opening [mm]", "Laterotrusion [mm], + left", "Protrusion [mm], + forward")

_NOT_NEEDED = ("codes", "polygon_", "residual_limit_mm", "tolerance_mm")
_SEARCH_STEPS = 60
_SLICES = 48  # number of openings from which the search for the nearest valid d starts
_CODES = {
    "f2": "e", "f4": "f", "f8": "d", "b1": "?", "i1": "b", "i2": "h", "i4": "i", "i8": "q",
    "u1": "B", "u2": "H", "u4": "I", "u8": "Q",
}  # fmt: skip
_OPERATIONS = FloatOperations()


class ReaderError(Exception):
    """The file is not a jaw rig, or its version is too new for this reader."""


def load(path: str, prim_path: str | None = None) -> Rig:
    """Load a rig from `model.npz` or any USD file; `prim_path` is the rig's prim, if the stage has several rigs.

    Raises:
        ReaderError: The file contains no rig, its version is too new, or it is USD and `pxr` is missing.
    """
    if str(path).endswith(".npz"):
        return _from_npz(str(path))
    try:
        from pxr import Tf, Usd
    except ImportError:
        raise ReaderError("reading USD needs the pxr modules; load model.npz if they are not available") from None
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ReaderError(f"{path} cannot be opened ({error})") from None
    if prim_path is not None:
        return from_prim(stage.GetPrimAtPath(prim_path))
    prims = find_rigs(stage)
    if len(prims) != 1:
        raise ReaderError(f"{path} contains {len(prims)} jaw rigs; set prim_path to the prim of one rig")
    return from_prim(prims[0])


def find_rigs(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return the rig prims in a stage, found by their raw metadata, which does not require the schema plugin."""
    applied = [(prim, prim.GetMetadata("apiSchemas")) for prim in stage.Traverse()]
    return [prim for prim, names in applied if names is not None and SCHEMA in names.GetAddedOrExplicitItems()]


def find_blender_pxr(resource_path: Callable[[str], str]) -> None:
    """Make Blender's own pxr importable if Blender runs as a Python module, given `bpy.utils.resource_path`."""
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    for kind in ("LOCAL", "SYSTEM"):
        base = resource_path(kind)
        folder = os.path.join(base, "python", "lib", version, "site-packages")
        if base and os.path.isdir(os.path.join(folder, "pxr")) and folder not in sys.path:
            sys.path.append(folder)


def from_prim(prim: Usd.Prim) -> Rig:
    """Read a rig from a USD prim.

    Raises:
        ReaderError: The prim is not a rig, or its version is too new.
    """

    def value(name: str) -> float | Sequence[float] | str:
        attribute = prim.GetAttribute(name) if prim else None
        found = attribute.Get() if attribute else None
        if found is None:
            raise ReaderError(f"the jaw rig is incomplete: {name} is missing")
        return found

    _check_version(value("jaw:formatVersion"))
    kind = str(value("jaw:model:kind"))
    first = prim.GetAttribute(str(GLIDE_ARRAYS["glide_d2"].attribute))
    attributes = _attributes_of(kind, bool(first) and first.HasAuthoredValue())
    return Rig(kind, {name: [x for key in keys for x in _flat(value(key))] for name, keys in attributes.items()})


def _flat(value: float | Sequence[float] | str) -> list[float]:
    return [float(value)] if isinstance(value, (int, float)) else [float(x) for x in value]


def _attributes_of(kind: str, gliding: bool) -> dict[str, tuple[str, ...]]:
    """Return the names of the attributes that poses and margins need; ``gliding`` models also have a glide table."""
    if kind not in MODELS:
        raise ReaderError(f"model kind {kind!r} is not supported by this reader")
    every = {**arrays_of(kind), **(GLIDE_ARRAYS if gliding else {})}
    specs = {name: spec for name, spec in every.items() if not name.startswith(_NOT_NEEDED)}
    return {name: (spec.attribute,) if spec.attribute else D_RANGE_ATTRIBUTES for name, spec in specs.items()}


def _check_version(version: object) -> None:
    if int(str(version)) > FORMAT_VERSION:
        raise ReaderError(f"the format version is {version}; this reader supports versions up to {FORMAT_VERSION}")


def _from_npz(path: str) -> Rig:
    try:
        with zipfile.ZipFile(path) as archive:
            raw = {name[:-4]: archive.read(name) for name in archive.namelist() if name.endswith(".npy")}
        if "meta" not in raw:
            raise ReaderError(f"{path} has no meta, so it is not a jaw model")
        (text,) = _npy("meta", raw["meta"])
        meta = json.loads(str(text))
    except (zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, ValueError) as error:
        raise ReaderError(f"{path} is damaged or is not a jaw model ({error})") from None
    family, _, version = str(meta.get("format")).partition("/")
    if family != "jawusd-model":
        raise ReaderError(f"{path} has format {meta.get('format')}; expected jawusd-model")
    _check_version(version)
    arrays = {}
    for name in _attributes_of(meta.get("kind"), "glide_d2" in raw):
        if name not in raw:
            raise ReaderError(f"{path} has no array {name}")
        arrays[name] = [float(x) for x in _npy(name, raw[name])]
    return Rig(meta["kind"], arrays)


def _npy(name: str, data: bytes) -> Sequence[float | str]:
    """Return the values of a .npy file (versions 1 to 3, any memory layout; numpy/lib/format.py) in row-major order."""
    try:
        if data[:6] != b"\x93NUMPY":
            raise ValueError("it has no .npy header")
        long_header = data[6] > 1
        start = 12 if long_header else 10
        (length,) = struct.unpack("<I" if long_header else "<H", data[8:start])
        header = ast.literal_eval(data[start : start + length].decode("utf-8" if data[6] > 2 else "latin1"))
        descr, shape, body = header["descr"], header["shape"], data[start + length :]
        order = ">" if descr[0] == ">" else "<"
        if descr[1] == "U":
            return [body[: 4 * int(descr[2:])].decode("utf-32-be" if order == ">" else "utf-32-le").rstrip("\0")]
        if descr[1:] not in _CODES:
            raise ValueError(f"type {descr} is not supported")
        values = struct.unpack(f"{order}{math.prod(shape)}{_CODES[descr[1:]]}", body)
    except (ValueError, SyntaxError, LookupError, TypeError, struct.error) as error:
        raise ReaderError(f"array {name} cannot be read ({error})") from None
    return _by_rows(values, shape) if header["fortran_order"] else values


def _by_rows(values: Sequence[float], shape: Sequence[int]) -> Sequence[float]:
    """Reorder the values of an array from column-major to row-major order."""
    places, step = [0], 1
    for count in shape:
        places, step = [place + i * step for place in places for i in range(count)], step * count
    return [values[place] for place in places]


class Rig:
    """The jaw of one subject.

    Attributes:
        arrays: The model's arrays by name, each a flat list in row-major order.
        d_range: ((min, max), (min, max), (min, max)) of d1, d2, d3 [mm].
        formula: Evaluator of the model's motion in the anatomical frame.
        matrices: T_skull_anatomical, and T_anatomical_mandible in the closed bite, as lists of rows.
    """

    def __init__(self, kind: str, arrays: dict[str, list[float]]) -> None:
        self.kind = kind
        self.arrays = arrays
        limits = arrays["d_range"]
        self.d_range = tuple((limits[i], limits[i + 1]) for i in (0, 2, 4))
        A = rows(arrays["T_anatomical_skull"], 4)
        self.matrices = (_rigid_inverse(A), _product(A, rows(arrays["T_rest"], 4)))
        self.formula, self._bound = MODELS[kind](arrays), BoundFormula(arrays)
        first_mm, last_mm, softness_mm, offset_mm = self._bound.numbers
        beyond = offset_mm - softness_mm  # approximate extent of the rounded ends of the bound
        self._spacing_mm = (last_mm - first_mm + 2.0 * beyond) / _SLICES
        self._openings = [first_mm - beyond + (i + 0.5) * self._spacing_mm for i in range(_SLICES)]

    def pose(self, d1: float, d2: float, d3: float) -> Rows:
        """Return T_skull_mandible [mm] at jaw parameters [mm], as four rows of a matrix for column vectors."""
        motion = self.formula.motion((d1, d2, d3), self.formula.tables, _OPERATIONS)
        M = [[*turn, shift] for turn, shift in zip(motion.turn, motion.t)] + [[0.0, 0.0, 0.0, 1.0]]
        for i in range(3):
            M[i][i] += 1.0
        return _product(_product(self.matrices[0], M), self.matrices[1])

    def margin(self, d1: float, d2: float, d3: float) -> float:
        """Return the signed distance from jaw parameters to the bound [mm], positive inside."""
        return self._bound.margin((d1, d2, d3), self._bound.tables, _OPERATIONS)

    def is_inside(self, d1: float, d2: float, d3: float) -> bool:
        """Return whether jaw parameters [mm] are inside the bound: margin >= 0, up to rounding of 1e-6 mm."""
        return self.margin(d1, d2, d3) >= -ON_BOUND_MM

    def project(self, d1: float, d2: float, d3: float) -> Triple[float]:
        """Return the nearest jaw parameters [mm] inside the bound: d itself if it is inside, NaN if d is not finite.

        A local search starts from every opening that may lead to a nearer point than the nearest found so far.

        Raises:
            ReaderError: The bound is empty.
        """
        d = (d1, d2, d3)
        if not all(map(math.isfinite, d)):
            return (math.nan, math.nan, math.nan)
        if self.margin(*d) >= 0.0:
            return d
        best, least = None, math.inf
        for opening in sorted(self._openings, key=lambda opening: abs(opening - d1)):
            if abs(opening - d1) - self._spacing_mm >= least:
                break
            start, at = pulled_in(self._bound, (opening, d2, d3), opening=0.0)
            if at.distance > 0:
                start, at = pulled_in(self._bound, (opening, *self._bound.middle(opening)))
            if at.distance <= 0:
                found = nearest_in_valley(self._bound, d, start)
                if (distance := math.dist(found, d)) < least:
                    best, least = found, distance
        if best is None:
            raise ReaderError("the bound of this rig allows no jaw parameters")
        return best

    def ranges(self, d1: float, d2: float = 0.0, d3: float = 0.0) -> tuple[Pair, Pair]:
        """Return the valid (min, max) of d2 at this d3, and of d3 at this d2 [mm]; (nan, nan) if no value is valid.

        The bound ends a few tenths of a millimetre before the limits of d1; beyond its end, the last valid opening is
        used.
        """
        d1 = self._nearest_opening(d1, d2, d3)
        along_d2 = _chord(lambda x: self.margin(d1, x, d3), *self.d_range[1])
        return along_d2, _chord(lambda x: self.margin(d1, d2, x), *self.d_range[2])

    def _nearest_opening(self, d1: float, d2: float, d3: float) -> float:
        inside = min(max(d1, self._bound.numbers.first_mm), self._bound.numbers.last_mm)
        beyond = inside != d1 and self.d_range[0][0] <= d1 <= self.d_range[0][1]
        if not beyond or self.margin(d1, d2, d3) >= 0.0 or self.margin(inside, d2, d3) < 0.0:
            return d1
        return _zero(lambda x: self.margin(x, d2, d3), inside, d1)


def _zero(margin: Callable[[float], float], inside: float, outside: float) -> float:
    """Return where a margin becomes negative between two values, by bisection."""
    for _ in range(_SEARCH_STEPS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if margin(middle) >= 0.0 else (inside, middle)
    return inside


def _chord(margin: Callable[[float], float], low: float, high: float) -> Pair:
    """Return the two zeros of a concave margin: find its maximum by ternary search, then bisect on both sides."""
    a, b = 2.0 * low - high, 2.0 * high - low
    for _ in range(_SEARCH_STEPS):
        p, q = a + (b - a) / 3.0, b - (b - a) / 3.0
        a, b = (p, b) if margin(p) < margin(q) else (a, q)
    if not margin(a) >= 0.0:
        return (math.nan, math.nan)
    return _zero(margin, a, 2.0 * low - high), _zero(margin, a, 2.0 * high - low)


def _product(A: Rows, B: Rows) -> Rows:
    return [[sum(A[i][k] * B[k][j] for k in range(4)) for j in range(4)] for i in range(4)]


def _rigid_inverse(A: Rows) -> Rows:
    R = [[A[j][i] for j in range(3)] for i in range(3)]
    t = [-sum(R[i][k] * A[k][3] for k in range(3)) for i in range(3)]
    return [R[i] + [t[i]] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def decompose(T: Rows) -> tuple[Triple[float], tuple[float, float, float, float]]:
    """Return the translation (x, y, z) and the unit quaternion (w, x, y, z), w >= 0, of a rigid 4 x 4 matrix."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z) = T[0], T[1], T[2]
    candidates = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    # The quaternion candidate with the largest component is the most accurate.
    q = candidates[max(range(4), key=lambda k: candidates[k][k])]
    length = math.copysign(math.sqrt(sum(v * v for v in q)), q[0] if q[0] != 0 else 1.0)
    return (x, y, z), (q[0] / length, q[1] / length, q[2] / length, q[3] / length)
