"""Landmarks of a jaw without scans: JSON, format jawusd-landmarks/1.

    {"format": "jawusd-landmarks/1", "units": "mm",
     "landmarks": {"incisor": [x, y, z], "molar_left": [...], "molar_right": [...],
                   "condyle_left": [...], "condyle_right": [...]},
     "T_anatomical_skull": [[...], [...], [...], [...]]}

The five points are on the mandible, in one coordinate frame, with the teeth in occlusion. The transform to the
anatomical frame is optional.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, UnitsError, errors_name_file
from jawusd.base.npz import check_format
from jawusd.formats.text import read_json
from jawusd.geometry import LANDMARKS, rigidity_defect

FAMILY, VERSION = "jawusd-landmarks", 1
_RIGID_TOLERANCE = 1e-6
_MAX_BYTES = 1 << 20


@dataclass(frozen=True, eq=False)
class LandmarkFile:
    """Content of a landmarks file."""

    landmarks: Array  # positions [mm] in the order of `geometry.LANDMARKS`, shape (5, 3)
    # Transform from the file's coordinates to the anatomical frame, shape (4, 4), or None.
    T_anatomical_skull: Array | None


@errors_name_file
def load_landmarks(path: AnyPath) -> LandmarkFile:
    """Read landmarks.

    Raises:
        FormatError: the file is not a landmarks file; the message names the wrong key.
        VersionError: the file was written for a newer version.
        UnitsError: lengths are not in mm.
    """
    data = read_json(Path(path), _MAX_BYTES)
    if not isinstance(data, dict):
        raise FormatError("must be a JSON object.")
    check_format(data.get("format"), FAMILY, VERSION, path)
    if data.get("units") != "mm":
        raise UnitsError(f'units are "{data.get("units")}"; they must be "mm".')
    unknown = sorted(set(data) - {"format", "units", "landmarks", "T_anatomical_skull"})
    if unknown:
        raise FormatError(f'unknown key "{unknown[0]}"; allowed keys: format, units, landmarks, T_anatomical_skull.')
    named = data.get("landmarks")
    if not isinstance(named, dict) or set(named) != set(LANDMARKS):
        raise FormatError(f'"landmarks" must name exactly {", ".join(LANDMARKS)}.')
    landmarks = np.stack([_numbers(named[name], (3,), f'landmark "{name}"') for name in LANDMARKS])
    T = data.get("T_anatomical_skull")
    if T is not None:
        T = _numbers(T, (4, 4), '"T_anatomical_skull"')
        if rigidity_defect(T) > _RIGID_TOLERANCE:
            raise FormatError('"T_anatomical_skull" must be a rigid 4 x 4 matrix.')
    return LandmarkFile(landmarks, T)


def _numbers(value: object, shape: tuple[int, ...], name: str) -> Array:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{name} is not an array of numbers.") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise FormatError(f"{name} must consist of finite numbers, with shape {shape}; found shape {array.shape}.")
    return array
