"""Convert images of any bit depth to 8-bit display values, which the trackers use.

Colour spaces, by name:

- "display": display-referred; more than 8 bits are rounded. Default for integers.
- "linear": proportional to light, 1 is white. Encoded by the sRGB curve, IEC 61966-2-1; clipped at 1. Default for
  floating point (EXR).
- "cineon": printing density of film scans, 10 bits: 685 is white, 95 is black, 0.002 density per step, gamma 0.6
  (Kodak, "Conversion of 10-bit Log Film Data To 8-bit Linear or Video Data", 1995); then as "linear".
- any other name is a colour space of an OpenColorIO config, converted to its default display and view.
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
    """Return a display-referred image, (h, w) or (h, w, 3) uint8, 0 .. 255.

    Args:
        stored: pixels as stored: integers 0 .. largest, or floating point.
        largest: white of integers, 255, 1023, 4095 or 65535.
        space: its colour space; None is "display" for integers and "linear" for floating point.
        config: OpenColorIO config that defines other names.

    Raises:
        CaptureError: the colour space is unknown.
        MissingDependencyError: it needs OpenColorIO.
    """
    fractions = stored.dtype.kind == "f"
    space = space or ("linear" if fractions else "display")
    if space not in SPACES or config is not None:
        values = np.asarray(stored, np.float32)
        return _by_config(values if fractions else values / np.float32(largest), space, config)
    if stored.dtype == np.float32:
        return _curve(np.asarray(stored, np.float32), space)
    # 16-bit types have 65536 values: a lookup table is fastest.
    codes = stored.view(np.uint16) if stored.dtype == np.float16 else stored
    return _table(stored.dtype.name, largest, space)[codes]


@lru_cache(maxsize=16)
def _table(kind: str, largest: int, space: str) -> NDArray[np.uint8]:
    if kind == "float16":
        return _curve(np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32), space)
    top = 1 << (8 if kind == "uint8" else 16)
    return _curve(np.minimum(np.arange(top, dtype=np.float32) / np.float32(largest), np.float32(1)), space)


def _curve(values: NDArray[np.float32], space: str) -> NDArray[np.uint8]:
    """Return values, with 1 as white, as 8 bits; NaN becomes black."""
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
    """The interface of OpenColorIO that is used here, for type checkers: its package lacks stubs."""

    def applyRGB(self, pixels: NDArray[np.float32]) -> None: ...


@explain_missing_packages("colour")
def _by_config(values: NDArray[np.float32], space: str, config: Path | None) -> NDArray[np.uint8]:
    if config is None:
        raise CaptureError(
            f'the colour space "{space}" is unknown; it must be {", ".join(SPACES)}, or a name in an OpenColorIO '
            "config.",
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
