"""Convert images of any bit depth to 8-bit display values, which the trackers use.

Names of colour spaces:

- "display": display-referred values; more than 8 bits are rounded. This is the default for integers.
- "linear": values proportional to light, where 1 is white. They are clipped at 1 and encoded by the sRGB curve
  (IEC 61966-2-1). This is the default for floating point (EXR).
- "cineon": printing density of film scans with 10 bits: 685 is white, 95 is black, 0.002 density per step, gamma 0.6
  (Kodak, "Conversion of 10-bit Log Film Data To 8-bit Linear or Video Data", 1995). The result is treated as "linear".
- Any other name is a colour space of an OpenColorIO config, converted to the config's default display and view.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError, explain_missing_packages

Stored = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float16] | NDArray[np.float32]

SPACES = ("display", "linear", "cineon")
_WHITE, _BLACK, _DENSITY, _GAMMA, _STEPS = 685.0, 95.0, 0.002, 0.6, 1023.0


def to_display(stored: Stored, largest: int, space: str | None, config: Path | None) -> NDArray[np.uint8]:
    """Convert an image to a display-referred one, (h, w) or (h, w, 3) uint8, 0 to 255.

    Args:
        stored: pixels as stored in the file: integers 0 to `largest`, or floating point.
        largest: integer value of white: 255, 1023, 4095 or 65535.
        space: colour space of the pixels; None for "display" (integers) or "linear" (floating point).
        config: OpenColorIO config that defines other colour spaces.

    Raises:
        CaptureError: the colour space is unknown.
        MissingDependencyError: the colour space needs OpenColorIO, which is not installed.
    """
    fractions = stored.dtype.kind == "f"
    space = space or ("linear" if fractions else "display")
    if space not in SPACES or config is not None:
        values = np.asarray(stored, np.float32)
        return _by_config(values if fractions else values / np.float32(largest), space, config)
    if stored.dtype == np.float32:
        return _curve(np.asarray(stored, np.float32), space)
    # 16-bit types have only 65536 values, so a lookup table is the fastest method.
    codes = stored.view(np.uint16) if stored.dtype == np.float16 else stored
    return _table(stored.dtype.name, largest, space)[codes]


@lru_cache(maxsize=16)
def _table(kind: str, largest: int, space: str) -> NDArray[np.uint8]:
    if kind == "float16":
        return _curve(np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32), space)
    top = 1 << (8 if kind == "uint8" else 16)
    return _curve(np.minimum(np.arange(top, dtype=np.float32) / np.float32(largest), np.float32(1)), space)


def _curve(values: NDArray[np.float32], space: str) -> NDArray[np.uint8]:
    """Convert values, where 1 is white, to 8 bits; NaN becomes black."""
    with np.errstate(over="ignore", invalid="ignore"):
        light = np.nan_to_num(values.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
        if space == "cineon":
            black = 10 ** ((_BLACK - _WHITE) * _DENSITY / _GAMMA)
            density = (np.minimum(light, 1.0) * _STEPS - _WHITE) * _DENSITY / _GAMMA
            light = (10**density - black) / (1 - black)
        light = np.clip(light, 0.0, 1.0)
        if space != "display":
            light = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * light), np.uint8)


class _Processor(Protocol):
    """Part of OpenColorIO's interface, declared for type checkers because its package has no stubs."""

    def applyRGB(self, pixels: NDArray[np.float32]) -> None: ...


@explain_missing_packages("colour")
def _by_config(values: NDArray[np.float32], space: str, config: Path | None) -> NDArray[np.uint8]:
    if config is None:
        raise CaptureError(
            f'the colour space "{space}" is unknown; expected {", ".join(SPACES)}, or a name in an OpenColorIO config.',
            hint='Set the config at the top of capture.toml: colour_config = "config.ocio".',
        )
    shown = np.ascontiguousarray(np.broadcast_to(values[..., None], (*values.shape, 3)) if values.ndim == 2 else values)
    shown = shown.astype(np.float32)
    _processor(config, space).applyRGB(shown)
    image = np.asarray(np.rint(255 * np.clip(np.nan_to_num(shown), 0, 1)), np.uint8)
    return image[..., 1] if values.ndim == 2 else image


@lru_cache(maxsize=16)
def _processor(config: Path, space: str) -> _Processor:
    import PyOpenColorIO as ocio

    try:
        known = ocio.Config.CreateFromFile(str(config))
        display = known.getDefaultDisplay()
        transform = ocio.DisplayViewTransform(space, display, known.getDefaultView(display))
        processor: _Processor = known.getProcessor(transform).getDefaultCPUProcessor()
        return processor
    except ocio.Exception as error:
        raise CaptureError(f'OpenColorIO cannot convert the colour space "{space}" ({error}).', path=config) from error
