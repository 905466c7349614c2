"""Draw all cameras of a take in one image, each cropped to the teeth, with overlaid scans and a status bar below."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.evaluator.verdicts import place
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.formats.performance import STATE_COLOURS, STATE_WORDS, SolveState
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera, transform_points
from jawusd.media.overlay import (
    CAPTION_PX,
    EMPTY_GRAY,
    LOWER_COLOUR,
    UPPER_COLOUR,
    Backdrop,
    Colour,
    PlacedScan,
    captioned,
    contact_sheet,
    draw_overlay,
)

#: Left, top, width and height of a region [px].
Part = tuple[int, int, int, int]

_MOST_IN_ROW = 3
# Maximum numbers of frames, and of vertices per scan, sampled to locate the teeth.
_MOST_FRAMES, _MOST_POINTS = 200, 300
_STRAYS_PERCENT = 1.0  # percentage of frames in which teeth may leave the crop on each side
_ROOM = 0.25  # margin around the teeth, as a fraction of their extent
_LEAST_PX = 32
_SHOW_PARTLY_S = 0.3  # time after which an incomplete image is shown
_WHITE: Colour = (240, 240, 240)
_WIDE_PX = 1200  # width below which each piece of text in a status bar has a line of its own
_LINE_PX, _LEFT_PX, _GAP_PX, _SWATCH_PX = 26, 10, 34, 14
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.55

# Text, colour, and whether a swatch has the colour instead of the text, which is then white.
Piece = tuple[str, Colour, bool]


class CameraWall:
    """Image of all cameras of a take side by side, of `size_px` (width, height)."""

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        backdrops: Mapping[str, Backdrop],
        tracks: Tracks | None,
        scans: Sequence[Mesh],
        tile_px: tuple[int, int],
    ) -> None:
        """Crop the images to the region of the teeth over a take; without tracks, show whole images.

        Args:
            cameras: calibrated cameras; other cameras are shown without scans.
            scans: teeth scans of the tracks, upper and lower [mm].
            tile_px: (width, height) of each camera's image.
        """
        parts = {} if tracks is None else _teeth_parts(cameras, tracks, scans, tile_px[0] / tile_px[1])
        whole = {name: (0, 0, *one.size_px) for name, one in backdrops.items()}
        self._cells = {name: _Cell(parts.get(name, whole[name]), cameras.get(name), tile_px) for name in backdrops}
        self._backdrops = backdrops
        count = len(backdrops)
        self._pool = ThreadPoolExecutor(min(count, os.cpu_count() or 1))
        self._columns = count if count <= _MOST_IN_ROW else math.ceil(math.sqrt(count))
        rows = -(-count // self._columns)
        self.size_px = (self._columns * tile_px[0], rows * (tile_px[1] + CAPTION_PX))

    def draw(
        self,
        frame: int,
        scans: Sequence[PlacedScan],
        *,
        fill: float,
        partly: Callable[[NDArray[np.uint8]], None] | None = None,
    ) -> NDArray[np.uint8]:
        """Return the image of a frame of the reference camera, (h, w, 3) RGB, with scans of opacity `fill`.

        If decoding takes long, `partly` receives incomplete images.

        Raises:
            CaptureError: a camera's image cannot be decoded.
        """
        tiles = {name: self._pool.submit(self._tile, name, frame, scans, fill) for name in self._cells}
        if partly is not None:
            _, missing = wait(tiles.values(), _SHOW_PARTLY_S)
            while missing:
                partly(contact_sheet([self._so_far(name, frame, tile) for name, tile in tiles.items()], self._columns))
                _, missing = wait(missing, return_when=FIRST_COMPLETED)
        return contact_sheet([tile.result() for tile in tiles.values()], self._columns)

    def _so_far(self, name: str, frame: int, tile: Future[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        if tile.done() and tile.exception() is None:
            return tile.result()
        return captioned(self._cells[name].draw(None, (), 0.0), f"{name}   frame {frame}   loading")

    def _tile(self, name: str, frame: int, scans: Sequence[PlacedScan], fill: float) -> NDArray[np.uint8]:
        backdrop = self._backdrops[name]
        image = backdrop.picture(frame)
        words = "no image" if image is None else "" if backdrop.is_footage else "masks, no footage"
        return captioned(self._cells[name].draw(image, scans, fill), f"{name}   frame {frame}   {words}")

    def close(self) -> None:
        """Stop decoding in the background."""
        self._pool.shutdown()
        for backdrop in self._backdrops.values():
            backdrop.close()


class _Cell:
    """Mapping of a region of one camera's images to a tile."""

    def __init__(self, part: Part, camera: Camera | None, tile_px: tuple[int, int]) -> None:
        x, y, width, height = part
        scale = min(tile_px[0] / width, tile_px[1] / height)
        self._size_px = (max(round(width * scale), 1), max(round(height * scale), 1))
        self._window = (slice(y, y + height), slice(x, x + width))
        self._how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        self._tile_px = tile_px
        self._camera = None if camera is None else camera.cropped(x, y, (width, height)).scaled(self._size_px)

    def draw(self, image: NDArray[np.uint8] | None, scans: Sequence[PlacedScan], fill: float) -> NDArray[np.uint8]:
        """Return the tile (h, w, 3) of an image; an empty tile for None."""
        width, height = self._tile_px
        tile = np.full((height, width, 3), EMPTY_GRAY, np.uint8)
        if image is not None:
            small = np.asarray(cv2.resize(image[self._window], self._size_px, interpolation=self._how), np.uint8)
            if scans and self._camera is not None:
                small = draw_overlay(small, self._camera, scans, fill=fill)
            left, top = (width - self._size_px[0]) // 2, (height - self._size_px[1]) // 2
            tile[top : top + self._size_px[1], left : left + self._size_px[0]] = small
        return tile


def _teeth_parts(
    cameras: Mapping[str, Camera], tracks: Tracks, meshes: Sequence[Mesh], aspect: float
) -> dict[str, Part]:
    """Return the image region of the teeth over a take by camera, if possible with an aspect of width over height."""
    rows = np.unique(np.linspace(0, len(tracks.frames) - 1, _MOST_FRAMES).round().astype(int))
    moved = []
    for mesh, poses in zip(meshes, (tracks.T_world_upper, tracks.T_world_lower), strict=True):
        crowns = np.unique(mesh.faces[crown_face_mask(mesh)])
        some = mesh.vertices[crowns[:: max(1, len(crowns) // _MOST_POINTS)]]
        moved.append(transform_points(poses[rows], some))
    world = np.concatenate(moved, axis=1)
    return {name: _part_around(camera, world, aspect) for name, camera in cameras.items()}


def _part_around(camera: Camera, world: Array, aspect: float) -> Part:
    """Return the image region of points (F, n, 3) [mm], NaN if unknown, over all frames, without outliers."""
    size = np.array(camera.size_px)
    pixels = camera.project(world)
    pixels[camera.depth(world) <= 0] = np.nan
    known = pixels[np.any(np.isfinite(pixels[..., 0]), axis=1)]
    if not len(known):
        return (0, 0, int(size[0]), int(size[1]))
    low = np.percentile(np.nanmin(known, axis=1), _STRAYS_PERCENT, axis=0)
    high = np.percentile(np.nanmax(known, axis=1), 100 - _STRAYS_PERCENT, axis=0)
    extent = np.maximum((high - low) * (1 + 2 * _ROOM), _LEAST_PX)
    extent = np.maximum(extent, [extent[1] * aspect, extent[0] / aspect])
    extent = np.minimum(np.ceil(extent), size).astype(int)
    first = np.clip(np.round((low + high - extent) / 2), 0, size - extent).astype(int)
    return int(first[0]), int(first[1]), int(extent[0]), int(extent[1])


class StatusBar:
    """Status bar of one take: frame and time, solved parameters, and a colour legend."""

    def __init__(self, tracks: Tracks, fps: float, width_px: int) -> None:
        """Prepare the colour legend; time 0 is at frame 0."""
        self._tracks, self._fps, self._width_px = tracks, fps, width_px
        if tracks.solved is None:
            self._legend: list[Piece] = [("upper teeth", UPPER_COLOUR, True), ("lower teeth", LOWER_COLOUR, True)]
        else:
            self._legend = [(STATE_WORDS[state], colour, True) for state, colour in STATE_COLOURS.items()]

    def draw(self, row: int) -> NDArray[np.uint8]:
        """Return the status bar for a row of the tracks, (h, w, 3) RGB; h is the same for all rows."""
        lines: list[list[Piece]] = [self._said(row), self._legend]
        if self._width_px < _WIDE_PX:
            lines = [[piece] for line in lines for piece in line]
        bar = np.zeros((_LINE_PX * len(lines) + _LEFT_PX, self._width_px, 3), np.uint8)
        for number, line in enumerate(lines, start=1):
            _write(bar, line, _LINE_PX * number - 4)
        return bar

    def _said(self, row: int) -> list[Piece]:
        frame = int(self._tracks.frames[row])
        said: list[Piece] = [(f"frame {frame}   {frame / self._fps:.3f} s", _WHITE, False)]
        solved = self._tracks.solved
        if solved is not None:
            state = SolveState(int(solved.state[row]))
            pairs = zip(("d1", "d2", "d3"), solved.d[row], solved.sigma_mm[row], strict=True)
            values = "   ".join(f"{name} {value:.2f} +-{sigma:.2f}" for name, value, sigma in pairs)
            margin = float(solved.margin_mm[row])
            where = place(margin, float(self._tracks.meta.get("tolerance_mm", 0.0)))
            said.append((str(state), STATE_COLOURS[state], False))
            said.append((f"{values} mm (1 sigma)", _WHITE, False))
            said.append((f"bound: {where}, margin {margin:.2f} mm", _WHITE, False))
        return said


def _write(bar: NDArray[np.uint8], line: Sequence[Piece], baseline: int) -> None:
    at = _LEFT_PX
    for text, colour, patch in line:
        if patch:
            cv2.rectangle(bar, (at, baseline - _SWATCH_PX + 2), (at + _SWATCH_PX, baseline + 2), colour, -1)
            at += _SWATCH_PX + 8
        ink = _WHITE if patch else colour
        cv2.putText(bar, text, (at, baseline), _FONT, _SIZE, ink, 1, cv2.LINE_AA)
        at += cv2.getTextSize(text, _FONT, _SIZE, 1)[0][0] + _GAP_PX
