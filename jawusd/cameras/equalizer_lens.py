"""Read lenses of 3DEqualizer from text files and Nuke nodes, and convert them to OpenCV's coefficients.

A text file (File, Export, Lens) has these lines: name; film back width and height [cm], focal length [cm], film aspect,
lens centre offset x and y [cm], pixel aspect; 0, 1 or DISTORTION_...; the model; for each parameter its name, value,
number of curve keys, and one line per key; <end_of_file>. `LD_...` nodes (File, Export, Nuke LD_3DE4 Lens Distortion
Node) have the same data as knobs.

The models (Science-D-Visions, "The Standard Models for Lens Distortion in 3DE4", and its Lens Distortion Plugin Kit)
map distorted to undistorted points, relative to the lens centre, y up, in units of half the film back diagonal. OpenCV
maps in the other direction: its coefficients are fitted to the model over the image, and lenses with residuals above
0.05 px are rejected. Only "OpenCV Radial Degree 6, Decentered Degree 2" uses OpenCV's own coefficients.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError, FormatError, errors_name_file
from jawusd.cameras.nuke_script import NukeNode, steady_values
from jawusd.formats.text import read_text
from jawusd.geometry.camera import opencv_lens

Size = tuple[int, int]

_MOST_BYTES = 4 << 20
_CLASSIC, _RADIAL = "3DE Classic LD Model", "3DE4 Radial - Standard, Degree 4"
_BROWN, _OPENCV = "3DE4 Brown-Conrady, Degree 6/2", "OpenCV Radial Degree 6, Decentered Degree 2"
# Parameters of each distortion model, with their default values; Nuke omits parameters that have the default value.
_NAMES = {
    _CLASSIC: ("Distortion", "Anamorphic Squeeze", "Curvature X", "Curvature Y", "Quartic Distortion"),
    _RADIAL: (
        *("Distortion - Degree 2", "U - Degree 2", "V - Degree 2"),
        *("Quartic Distortion - Degree 4", "U - Degree 4", "V - Degree 4"),
        *("Phi - Cylindric Direction", "B - Cylindric Bending"),
    ),
    _BROWN: ("C2", "C4", "C6", "T1", "T2"),
    _OPENCV: (
        *("Radial Distortion - Degree 2 - k1", "Radial Distortion - Degree 4 - k2"),
        *("Decentering Y - Degree 2 - p1", "Decentering X - Degree 2 - p2", "Radial Distortion - Degree 6 - k3"),
    ),
}
_PARAMETERS = {model: dict.fromkeys(names, 0.0) for model, names in _NAMES.items()}
_PARAMETERS[_CLASSIC]["Anamorphic Squeeze"] = 1.0
_STATIC = ("0", "DISTORTION_STATIC")
_FOV = {"xa": 0.0, "xb": 1.0, "ya": 0.0, "yb": 1.0}
_LARGEST_ERROR_PX = 0.05
_MM_PER_CM = 10.0
# Number of fitted points per side of the image, and margin around the image as a fraction of its side.
_GRID, _BEYOND = 33, 0.03


@dataclass(frozen=True)
class Lens:
    """A lens and its distortion model."""

    name: str
    path: Path
    filmback_mm: tuple[float, float] | None
    offset_mm: tuple[float, float]  # position of the lens centre relative to the film back centre, x right, y up
    model: str
    values: Mapping[str, float]


@dataclass(frozen=True)
class FoundLens:
    """A lens found in a file, and the function that reads it."""

    name: str
    path: Path
    read: Callable[[], Lens]


def find_lenses(folder: Path, scripts: Mapping[Path, list[NukeNode]]) -> list[FoundLens]:
    """Return the lens models found in Nuke scripts (node lists keyed by file) and in the text files of a folder."""
    out = []
    for script, nodes in scripts.items():
        for node in nodes:
            if node.kind.startswith("LD_"):
                name = re.sub(r"^LD_3DE4_", "", node.name)
                out.append(FoundLens(name, script, partial(_node_lens, script, node, name)))
    for path in sorted(folder.glob("*.txt")):
        lines = _lens_lines(path)
        if lines is not None:
            out.append(FoundLens(lines[0], path, partial(_text_lens, path, lines)))
    return out


@errors_name_file
def _node_lens(path: Path, node: NukeNode, name: str) -> Lens:
    """Return the lens of a Nuke LD node; its class names the distortion model, its knobs the parameters."""
    models = {_nuke_name(model): model for model in _PARAMETERS}
    model = models.get(node.kind.removeprefix("LD").lstrip("_"))
    if model is None:
        raise _unread(node.kind)

    def value(knob: str, default: float) -> float:
        return float(steady_values(node, knob, (default,))[0])

    for side, whole in _FOV.items():
        if abs(value(f"field_of_view_{side}_unit", whole) - whole) > 1e-6:
            raise CalibrationError(
                f"lens {node.name} has a field of view smaller or larger than the image (field_of_view_{side}_unit); "
                "expected xa = 0, xb = 1, ya = 0, yb = 1.",
                hint="Set the camera's field of view to the whole image in 3DEqualizer.",
            )

    def pair_mm(first: str, second: str) -> tuple[float, float]:
        return _MM_PER_CM * value(first, 0), _MM_PER_CM * value(second, 0)

    sides = "tde4_filmback_width_cm", "tde4_filmback_height_cm"
    back = pair_mm(*sides) if node.knobs.keys() >= {*sides} else None
    offset = pair_mm("tde4_lens_center_offset_x_cm", "tde4_lens_center_offset_y_cm")
    values = {key: value(_nuke_name(key), default) for key, default in _PARAMETERS[model].items()}
    return Lens(name, path, back, offset, model, values)


def _nuke_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", name.strip())


@errors_name_file
def _lens_lines(path: Path) -> list[str] | None:
    """Return the lines of a lens file; None for other text files; refuse a lens file with an invalid beginning."""
    try:
        lines = [line.strip() for line in read_text(path, _MOST_BYTES).splitlines()]
    except FormatError:
        return None
    try:
        numbers = [float(word) for word in lines[1].split()]
        if len(numbers) == 7 and lines[3] and lines[2].startswith(("0", "1", "DISTORTION_")):
            return lines
    except (ValueError, IndexError):
        pass
    if "<end_of_file>" in lines:
        raise CalibrationError(
            "is a lens file, but does not begin with four lines: name, seven numbers, type of distortion, and model.",
            hint="Export the lens again, or remove the file.",
        )
    return None


@errors_name_file
def _text_lens(path: Path, lines: list[str]) -> Lens:
    width, height, _, _, x, y, _ = (float(word) for word in lines[1].split())
    mode, model = lines[2], lines[3]
    if model not in _PARAMETERS:
        raise _unread(model)
    if mode not in _STATIC:
        raise CalibrationError(
            f'lens {lines[0]} has the type of distortion "{mode}"; expected a static lens ({" or ".join(_STATIC)}).',
            hint="Make the lens static in 3DEqualizer and export it again.",
        )
    values = dict(_PARAMETERS[model])
    at = 4
    try:
        while at < len(lines) and lines[at] not in ("", "<end_of_file>"):
            values[lines[at]] = float(lines[at + 1])
            at += 3 + int(lines[at + 2])
    except (ValueError, IndexError) as error:
        raise CalibrationError(
            f'line {at + 1}: "{lines[at]:.60}" must be followed by its value, the number of curve keys, and the keys.'
        ) from error
    unknown = sorted(set(values) - set(_PARAMETERS[model]))
    if unknown or not np.isfinite(list(values.values())).all():
        raise CalibrationError(
            f'{model} has no parameter "{unknown[0]}"; its parameters are {", ".join(_PARAMETERS[model])}.'
            if unknown
            else "has a value that is not finite."
        )
    back = (_MM_PER_CM * width, _MM_PER_CM * height)
    return Lens(lines[0], path, back, (_MM_PER_CM * x, _MM_PER_CM * y), model, values)


def _unread(model: str) -> CalibrationError:
    return CalibrationError(
        f'has the distortion model "{model}"; it must be one of {", ".join(_PARAMETERS)}.',
        hint="Calibrate with one of them, or undistort the footage and remove the lens file.",
    )


def opencv_of(
    lens: Lens, K: Array, size: Size, back_mm: tuple[float, float], focal_mm: float
) -> tuple[Array, Array, Array]:
    """Return K (3, 3), OpenCV's coefficients, and a rotation vector (3,) [rad], applied to points before projection.

    `K` (3, 3) [px] is the camera's pinhole matrix; `size` [px] and `back_mm` are widths and heights of its image and
    film back.

    Raises:
        CalibrationError: OpenCV's coefficients approximate the lens with a residual above 0.05 px.
    """
    values = list(lens.values.values())
    if values == list(_PARAMETERS[lens.model].values()):
        return K, np.zeros(0), np.zeros(3)
    if lens.model == _OPENCV:
        return K, np.array(values), np.zeros(3)
    axes = [np.linspace(-0.5 - _BEYOND * side, (1 + _BEYOND) * side - 0.5, _GRID) for side in size]
    recorded = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    half_mm = float(np.hypot(*back_mm)) / 2
    from_centre = (recorded - K[:2, 2]) / np.diag(K)[:2] * focal_mm / half_mm
    x, y = _undistorted(lens.model, values, from_centre[:, 0], -from_centre[:, 1])
    ideal = np.column_stack([x, -y]) * half_mm / focal_mm
    fitted, distortion, turn, off = opencv_lens(K, recorded, ideal)
    if off > _LARGEST_ERROR_PX:
        raise CalibrationError(
            f'lens {lens.name} ("{lens.model}") cannot be approximated by OpenCV\'s coefficients (error {off:.2f} px; '
            f"at most {_LARGEST_ERROR_PX:g} px is allowed).",
            path=lens.path,
            hint="Solve without decentering and bending, or undistort the footage in 3DEqualizer or Nuke and remove "
            "the lens file.",
        )
    return fitted, distortion, turn


def _undistorted(model: str, values: list[float], x: Array, y: Array) -> tuple[Array, Array]:
    """Undistort points relative to the lens centre, y up, in units of half the film back diagonal (see the module)."""
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    if model == _CLASSIC:
        k, squeeze, bend_x, bend_y, quartic = values
        wide = 1 + k * xx + (k + bend_x) * yy + quartic * r2**2
        high = 1 + (k + bend_y) * xx + k * yy + quartic * r2**2
        return x * (1 + (wide - 1) / squeeze), y * high
    if model == _BROWN:
        c2, c4, c6, u, v = values
        radial, phi, bending = 1 + r2 * (c2 + r2 * (c4 + r2 * c6)), 0.0, 0.0
        off = (np.full_like(r2, u), np.full_like(r2, v))
    else:
        c2, u2, v2, c4, u4, v4, phi, bending = values
        radial, off = 1 + r2 * (c2 + r2 * c4), (u2 + u4 * r2, v2 + v4 * r2)
    out_x, out_y = (
        x * radial + off[0] * (r2 + 2 * xx) + 2 * off[1] * xy,
        y * radial + off[1] * (r2 + 2 * yy) + 2 * off[0] * xy,
    )
    c, s, q = np.cos(np.deg2rad(phi)), np.sin(np.deg2rad(phi)), np.sqrt(1 + bending)
    along, across, mixed = c * c * q + s * s / q, c * c / q + s * s * q, (q - 1 / q) * c * s
    return along * out_x + mixed * out_y, mixed * out_x + across * out_y
