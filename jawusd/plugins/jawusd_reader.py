"""Read and evaluate jaw rigs in any Python: one file, no dependencies, not even jawusd.

Copy it next to your script. `model.npz` needs nothing but Python 3.9; USD needs the `pxr` modules that Blender, Maya,
Houdini and Unreal bring along.

    import jawusd_reader
    rig = jawusd_reader.load("actor/actor.usda")
    T = rig.pose(20.0, 3.0, 0.5)             # d1, d2, d3 [mm] -> T_skull_mandible, rows of a 4x4 for column vectors
    translation, wxyz = jawusd_reader.decompose(T)
    rig.margin(20.0, 3.0, 0.5)               # signed distance to the bound [mm], > 0 inside
    rig.ranges(20.0)                         # ((d2 min, d2 max), (d3 min, d3 max)) for sliders
"""

from __future__ import annotations

import ast
import json
import math
import struct
import zipfile
from collections.abc import Callable, Sequence
from typing import Any

Pair = tuple[float, float]
Vector = tuple[float, float, float]
Rows = list[list[float]]
FORMAT_VERSION = 1
SCHEMA = "JawRigAPI"

# array -> attribute; what a rig of either kind has, then the two kinds
_COMMON = {
    "T_anatomical_skull": "jaw:model:tAnatomicalSkull",
    "T_rest": "jaw:model:tRest",
    "incisor": "jaw:model:incisor",
    "landmarks": "jaw:landmarks:positions",
    "slice_d1": "jaw:bounds:sliceD1",
    "slice_directions": "jaw:bounds:sliceDirections",
    "slice_support": "jaw:bounds:sliceSupport",
    "slice_softness_mm": "jaw:bounds:sliceSoftness",
    "slice_margin_mm": "jaw:bounds:sliceMargin",
}
_MODEL = {
    "anchored": ("pathCoefficients", "pathScale", "pathLimits", "glideArch", "glideDrop", "glideSoftness", "glideFade")
    + ("splineScales", "splineCentres", "splineWeights"),
    "additive": tuple(f"curve{i}{part}" for i in (1, 2, 3) for part in ("Knots", "Twists", "Slopes")),
}
_LENGTHS = ("path_scale", "glide_softness", "glide_fade")  # single numbers, named with their unit

# constants of the gauge and of the bound
FADE_SOFTNESS_MM = 1.0
LIMIT_SOFTNESS_MM = 4.0
ARCH_BOW_MM = 10.0
DROP_BEND = 0.15
DROP_SATURATION_MM2 = 16.0
_SEARCH_STEPS = 60
_SERIES_BELOW_RAD2 = 1e-4


class ReaderError(Exception):
    """Report a file that is no jaw rig, or one that this reader is too old for."""


def load(path: str, prim_path: str | None = None) -> Rig:
    """Load a rig.

    Args:
        path: `model.npz`, or any USD file that carries the rig.
        prim_path: which rig, where a stage has several.

    Raises:
        ReaderError: no rig, a newer version, or USD without `pxr`.
    """
    if str(path).endswith(".npz"):
        return _from_npz(str(path))
    try:
        from pxr import Usd
    except ImportError:
        raise ReaderError("reading USD needs the pxr modules; without them, load model.npz") from None
    stage = Usd.Stage.Open(str(path))
    if prim_path is not None:
        return from_prim(stage.GetPrimAtPath(prim_path))
    prims = find_rigs(stage)
    if len(prims) != 1:
        raise ReaderError(f"{path} holds {len(prims)} jaw rigs; name the prim")
    return from_prim(prims[0])


def find_rigs(stage: Any) -> list:
    """Return the prims of a stage that carry a rig, by their raw metadata: no plugin is needed."""
    applied = [(prim, prim.GetMetadata("apiSchemas")) for prim in stage.Traverse()]
    return [prim for prim, names in applied if names is not None and SCHEMA in names.GetAddedOrExplicitItems()]


def from_prim(prim: Any) -> Rig:
    """Read a rig from a USD prim.

    Raises:
        ReaderError: the prim carries no rig, or a newer version.
    """

    def value(name: str) -> Any:
        attribute = prim.GetAttribute(name) if prim else None
        found = attribute.Get() if attribute else None
        if found is None:
            raise ReaderError(f"{name} is not there: no complete jaw rig")
        return found

    _check_version(value("jaw:formatVersion"))
    kind = str(value("jaw:model:kind"))
    arrays = {name: _flat(value(attribute)) for name, attribute in _names_of(kind).items()}
    arrays["d_range"] = [x for i in (1, 2, 3) for x in _flat(value(f"jaw:d{i}:range"))]
    return Rig(kind, arrays)


def from_json(text: str) -> Rig:
    """Build a rig from what `Rig.to_json` gave."""
    stored = json.loads(text)
    return Rig(stored["kind"], stored["arrays"])


def _flat(value: Any) -> list[float]:
    if isinstance(value, (int, float)):
        return [float(value)]
    return [float(x) for x in value]


def _names_of(kind: str) -> dict[str, str]:
    """Return the attribute of every array of a kind: jaw:model:pathScale for path_scale_mm."""
    if kind not in _MODEL:
        raise ReaderError(f"model kind {kind!r} is unknown to this reader")
    names = dict(_COMMON)
    for attribute in _MODEL[kind]:
        name = "".join("_" + letter.lower() if letter.isupper() else letter for letter in attribute)
        names[name + "_mm" if name in _LENGTHS else name] = "jaw:model:" + attribute
    return names


def _check_version(version: int | str) -> None:
    if int(version) > FORMAT_VERSION:
        raise ReaderError(f"format version {version}; this reader knows up to {FORMAT_VERSION}")


def _from_npz(path: str) -> Rig:
    with zipfile.ZipFile(path) as archive:
        raw = {name[:-4]: archive.read(name) for name in archive.namelist()}
    if "meta" not in raw:
        raise ReaderError(f"{path} has no meta: no jaw model")
    meta = json.loads(_npy(raw["meta"]))
    family, _, version = str(meta.get("format")).partition("/")
    if family != "jawusd-model":
        raise ReaderError(f"{path} is of format {meta.get('format')}, expected jawusd-model")
    _check_version(version)
    wanted = list(_names_of(meta.get("kind"))) + ["d_range"]
    for name in wanted:
        if name not in raw:
            raise ReaderError(f"{path} has no array {name}")
    return Rig(meta["kind"], {name: _npy(raw[name]) for name in wanted})


def _npy(data: bytes) -> Any:
    """Return the values of a .npy file, row by row; a string for a string (numpy/lib/format.py)."""
    long_header = data[6] > 1
    start = 12 if long_header else 10
    (length,) = struct.unpack("<I" if long_header else "<H", data[8:start])
    header = ast.literal_eval(data[start : start + length].decode("latin1"))
    body, descr = data[start + length :], header["descr"]
    if descr[1] == "U":
        return body.decode("utf-32-le").rstrip("\0")
    code = {"f8": "d", "f4": "f", "i8": "q", "i4": "i"}.get(descr[1:])
    if code is None or descr[0] not in "<|" or header["fortran_order"]:
        raise ReaderError(f"arrays like {header} are not read")
    return [float(x) for x in struct.unpack(f"<{len(body) // int(descr[2:])}{code}", body)]


class Rig:
    """One person's jaw.

    Attributes:
        kind: "anchored" or "additive".
        arrays: the model's numbers by name, each a flat list, row by row.
        d_range: ((min, max), (min, max), (min, max)) of d1, d2, d3 [mm].
        matrices: T_skull_anatomical, and T_anatomical_mandible of the closed bite, rows; the motion stands between.
    """

    def __init__(self, kind: str, arrays: dict[str, list[float]]) -> None:
        """Take the numbers of a model, as `from_prim` and `from_json` do."""
        self.kind = kind
        self.arrays = arrays
        limits = arrays["d_range"]
        self.d_range = tuple((limits[i], limits[i + 1]) for i in (0, 2, 4))
        A = _rows(arrays["T_anatomical_skull"], 4)
        # what stands left and right of the motion: T_skull_anatomical, and T_anatomical_mandible of the closed bite
        self.matrices = (_rigid_inverse(A), _product(A, _rows(arrays["T_rest"], 4)))
        self._motion = _Anchored(arrays) if kind == "anchored" else _Additive(arrays)
        knots = arrays["slice_d1"]
        supports = _rows(arrays["slice_support"], len(arrays["slice_directions"]) // 2)
        self._supports = _Hermite(knots, supports, _catmull_rom(knots, supports))
        self._directions = _rows(arrays["slice_directions"], 2)

    def to_json(self) -> str:
        """Return the rig as text, to be stored inside a scene; `from_json` reads it."""
        return json.dumps({"kind": self.kind, "arrays": self.arrays})

    def pose(self, d1: float, d2: float, d3: float) -> Rows:
        """Return T_skull_mandible [mm] of jaw parameters [mm]: four rows, for column vectors."""
        return _product(_product(self.matrices[0], self._motion.at(d1, d2, d3)), self.matrices[1])

    def margin(self, d1: float, d2: float, d3: float) -> float:
        """Return the signed distance to the bound [mm], positive inside."""
        soft = self.arrays["slice_softness_mm"][0]
        v = [n[0] * d2 + n[1] * d3 - h for n, h in zip(self._directions, self._supports.at(d1))]
        v += [self.arrays["slice_d1"][0] - d1, d1 - self.arrays["slice_d1"][-1]]
        peak = max(v)
        total = sum(math.exp((x - peak) / soft) for x in v)
        return self.arrays["slice_margin_mm"][0] - peak - soft * math.log(total)

    def ranges(self, d1: float, d2: float = 0.0, d3: float = 0.0) -> tuple[Pair, Pair]:
        """Return the valid (min, max) of d2 through d3, and of d3 through d2, at d1 [mm]; (nan, nan) where none is."""
        along_d2 = _chord(lambda x: self.margin(d1, x, d3), *self.d_range[1])
        return along_d2, _chord(lambda x: self.margin(d1, d2, x), *self.d_range[2])


def _chord(margin: Callable[[float], float], low: float, high: float) -> Pair:
    """Return where a concave margin crosses zero: its top by ternary search, then bisection to either side."""
    a, b = 2.0 * low - high, 2.0 * high - low
    for _ in range(_SEARCH_STEPS):
        p, q = a + (b - a) / 3.0, b - (b - a) / 3.0
        a, b = (p, b) if margin(p) < margin(q) else (a, q)
    if not margin(a) >= 0.0:
        return (math.nan, math.nan)
    ends = []
    for outside in (2.0 * low - high, 2.0 * high - low):
        inside = a
        for _ in range(_SEARCH_STEPS):
            middle = 0.5 * (inside + outside)
            inside, outside = (middle, outside) if margin(middle) >= 0.0 else (inside, middle)
        ends.append(inside)
    return ends[0], ends[1]


class _Anchored:
    """omega = f(u), t = u + p - R p: the rotation follows from where the lower incisal point is."""

    def __init__(self, arrays: dict[str, list[float]]) -> None:
        self._a = arrays
        self._scale = arrays["path_scale_mm"][0]
        self._path_rows = _rows(arrays["path_coefficients"], 5)
        self._centres = _rows(arrays["spline_centres"], 3)
        self._weights = _rows(arrays["spline_weights"], 3)
        self._offset = self._spline((0.0, 0.0, 0.0))

    def at(self, d1: float, d2: float, d3: float) -> Rows:
        """Return the motion away from the closed bite, anatomical frame: four rows."""
        u = self._displacement(d1, d2, d3)
        gx, gz = self._path(-u[1])
        q = [x / s for x, s in zip((-u[1], u[0] - gx, u[2] - gz), self._a["spline_scales"])]
        omega = [x - o for x, o in zip(self._spline(q), self._offset)]
        p, turned = self._a["incisor"], _rotate(omega, self._a["incisor"], 0)
        return _matrix(omega, [u[i] + p[i] - turned[i] for i in range(3)])

    def _spline(self, q: Sequence[float]) -> list[float]:
        out = [sum(q[j] * self._weights[len(self._centres) + j][i] for j in range(3)) for i in range(3)]
        for (x, y, z), w in zip(self._centres, self._weights):
            square = (q[0] - x) ** 2 + (q[1] - y) ** 2 + (q[2] - z) ** 2
            cube = square * math.sqrt(square)
            for i in range(3):
                out[i] += cube * w[i]
        return out

    def _path(self, opening: float) -> list[float]:
        low, high = self._a["path_limits"]
        inside = min(max(opening, low), high)
        s = inside / self._scale
        out = []
        for c in self._path_rows:
            slope = sum((k + 1) * c[k] * s**k for k in range(5)) / self._scale
            out.append(sum(c[k] * s ** (k + 1) for k in range(5)) + slope * (opening - inside))
        return out

    def _displacement(self, d1: float, d2: float, d3: float) -> Vector:
        e = self._a["glide_softness_mm"][0]
        low, high = self._a["path_limits"]
        gx, gz = self._path(d1)
        s = low + _soft_ramp(d1 - low, LIMIT_SOFTNESS_MM) - _soft_ramp(d1 - high, LIMIT_SOFTNESS_MM)
        s /= self._scale
        side, front = math.sqrt(d2 * d2 + e * e) - e, _soft_ramp(d3, e)
        c, w = self._a["glide_arch"], self._a["glide_drop"]
        rho = side * (c[0] + s * (c[1] + s * c[2])) + d2 * (c[3] + s * c[4])
        rho += d2 * d2 / ARCH_BOW_MM * (c[5] + s * c[6])
        drop = w[0] * side + w[1] * front + w[2] * _bent(side) + w[3] * _bent(front)
        share = _soft_ramp(d1, FADE_SOFTNESS_MM) / self._a["glide_fade_mm"][0]
        return (gx + d2, -(d1 + drop * math.exp(-share * share)), gz + rho + d3)


class _Additive:
    """log M = Phi1(d1) + Phi2(d2) + Phi3(d3)."""

    def __init__(self, arrays: dict[str, list[float]]) -> None:
        self._curves = []
        for i in (1, 2, 3):
            twists, slopes = (_rows(arrays[f"curve{i}_{part}"], 6) for part in ("twists", "slopes"))
            self._curves.append(_Hermite(arrays[f"curve{i}_knots"], twists, slopes))

    def at(self, d1: float, d2: float, d3: float) -> Rows:
        """Return the motion away from the closed bite, anatomical frame: four rows."""
        parts = [curve.at(x) for curve, x in zip(self._curves, (d1, d2, d3))]
        twist = [sum(column) for column in zip(*parts)]
        return _matrix(twist[:3], _rotate(twist[:3], twist[3:], 1))


class _Hermite:
    """A C1 cubic Hermite curve that goes on straight outside its knots."""

    def __init__(self, knots: list[float], values: Rows, slopes: Rows) -> None:
        self._knots, self._values, self._slopes = knots, values, slopes

    def at(self, x: float) -> list[float]:
        """Return the values at x, a list."""
        knots = self._knots
        if x <= knots[0] or x >= knots[-1]:
            end = 0 if x <= knots[0] else -1
            return [y + m * (x - knots[end]) for y, m in zip(self._values[end], self._slopes[end])]
        i = max(k for k in range(len(knots) - 1) if knots[k] <= x)
        h = knots[i + 1] - knots[i]
        t = (x - knots[i]) / h
        a, b = 1.0 + t * t * (2.0 * t - 3.0), t * t * (3.0 - 2.0 * t)
        c, d = h * t * (1.0 - t) ** 2, h * t * t * (t - 1.0)
        rows = zip(self._values[i], self._values[i + 1], self._slopes[i], self._slopes[i + 1])
        return [a * y0 + b * y1 + c * m0 + d * m1 for y0, y1, m0, m1 in rows]


def _catmull_rom(knots: list[float], values: Rows) -> Rows:
    slopes = [[0.0] * len(values[0]) for _ in knots]
    for i in range(1, len(knots) - 1):
        step = knots[i + 1] - knots[i - 1]
        slopes[i] = [(ahead - behind) / step for ahead, behind in zip(values[i + 1], values[i - 1])]
    return slopes


def _soft_ramp(x: float, e: float) -> float:
    return 0.5 * (x + math.sqrt(x * x + e * e) - e)


def _bent(x: float) -> float:
    return DROP_BEND * x * x / math.sqrt(1.0 + x * x / DROP_SATURATION_MM2)


def _rotate(omega: Sequence[float], v: Sequence[float], shift: int) -> list[float]:
    """Return exp(omega) v for shift 0, and the left Jacobian of SO(3) times v for shift 1."""
    square = sum(x * x for x in omega)
    if square < _SERIES_BELOW_RAD2:
        a, b, c = (
            (1.0 / math.factorial(k)) * (1.0 - square / ((k + 1) * (k + 2)) * (1.0 - square / ((k + 3) * (k + 4))))
            for k in (1, 2, 3)
        )
    else:
        t = math.sqrt(square)
        a, b, c = math.sin(t) / t, 2.0 * (math.sin(0.5 * t) / t) ** 2, (t - math.sin(t)) / (t * square)
    first, second = (a, b) if shift == 0 else (b, c)
    once = _cross(omega, v)
    twice = _cross(omega, once)
    return [v[i] + first * once[i] + second * twice[i] for i in range(3)]


def _matrix(omega: Sequence[float], t: Sequence[float]) -> Rows:
    columns = [_rotate(omega, axis, 0) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    return [[columns[0][i], columns[1][i], columns[2][i], t[i]] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def _cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _rows(flat: Sequence[float], width: int) -> Rows:
    return [list(flat[i : i + width]) for i in range(0, len(flat), width)]


def _product(A: Rows, B: Rows) -> Rows:
    return [[sum(A[i][k] * B[k][j] for k in range(4)) for j in range(4)] for i in range(4)]


def _rigid_inverse(A: Rows) -> Rows:
    R = [[A[j][i] for j in range(3)] for i in range(3)]
    t = [-sum(R[i][k] * A[k][3] for k in range(3)) for i in range(3)]
    return [R[i] + [t[i]] for i in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def decompose(T: Rows) -> tuple[Vector, tuple[float, float, float, float]]:
    """Return the translation (x, y, z) and the unit quaternion (w, x, y, z), w >= 0, of a rigid 4x4."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z) = T[0], T[1], T[2]
    candidates = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    # the row with the largest diagonal loses no digits
    q = candidates[max(range(4), key=lambda k: candidates[k][k])]
    length = math.copysign(math.sqrt(sum(v * v for v in q)), q[0] if q[0] != 0 else 1.0)
    return (x, y, z), tuple(v / length for v in q)
