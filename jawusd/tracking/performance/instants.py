"""The pictures of a take, read once and kept small."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from jawusd.tracking.contour.views import View

_FAST = 1  # zlib level: masks shrink to a fiftieth at once


class Views(Protocol):
    """Show the teeth in all cameras at instants of the reference camera, as `MaskViews` does."""

    def at(self, frame: int) -> list[View]:
        """Return one picture per camera."""
        ...


@dataclass(frozen=True, eq=False)
class _Kept:
    """Hold a view with its masks packed."""

    view: View
    shape: tuple[int, ...]
    masks: bytes

    @classmethod
    def of(cls, view: View) -> _Kept:
        packed = zlib.compress(np.ascontiguousarray(view.masks).data, _FAST)
        return cls(replace(view, masks=np.zeros((2, 0, 0), np.uint8)), view.masks.shape, packed)

    def unpacked(self) -> View:
        masks = np.frombuffer(zlib.decompress(self.masks), np.uint8).reshape(self.shape)
        return replace(self.view, masks=masks)


class KeptViews:
    """Read every instant once: decoding and undistorting cost more than aligning, and a take is gone over often."""

    def __init__(self, source: Views) -> None:
        self._source = source
        self._kept: dict[int, Sequence[_Kept]] = {}

    def at(self, frame: int) -> list[View]:
        """Return one picture per camera."""
        if frame not in self._kept:
            views = self._source.at(frame)
            self._kept[frame] = [_Kept.of(view) for view in views]
            return views
        return [kept.unpacked() for kept in self._kept[frame]]
