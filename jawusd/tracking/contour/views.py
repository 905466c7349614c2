"""Masks of a capture at working resolution, as one set of views per frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import CameraSource
from jawusd.formats.finding import Finding
from jawusd.geometry import Camera
from jawusd.media.checks import ARCHES, odd_pictures, survey_masks
from jawusd.media.clip import read_backwards
from jawusd.media.masks import FrameMasks, MaskReader, open_masks
from jawusd.media.working_view import WorkingView

#: Minimum number of cameras if the depth of the teeth is determined only by masks.
FEWEST_CAMERAS = 2
#: Minimum number of masks of an arch in one frame. With one view, depth depends on the size of the outline, which a
#: wrong mask changes.
FEWEST_MASKS = 2

#: Camera whose masks are files, or are in memory.
MaskSource: TypeAlias = CameraSource | FrameMasks
AnySource = TypeVar("AnySource", bound=MaskSource)

_BORDER_PX = 20  # margin of a view around the masks [px]: more than the widest search
# First and largest number of frames that are buffered when reading backwards; 48 take about 20 MB.
_FIRST_CHUNK, _CHUNK = 3, 48


class EdgeSearch(Protocol):
    """Finds the image edges on which contour samples should lie."""

    def search(
        self, samples: Array, count: int, arch: int, drawn: Drawn, limits: tuple[float, float, float]
    ) -> tuple[Array, Array]:
        """Return the distance of each sample to its image edge [px], NaN without an edge, and its weight in 0 .. 1.

        Weights are NaN for samples hidden by the other arch.

        Args:
            samples: contour samples, shape (n, COLUMNS); the first `count` are on silhouettes.
            limits: reach [px], depth tolerance [mm] and minimum cosine, as in `search_edges`.
        """
        ...


@dataclass(frozen=True, eq=False)
class Drawn:
    """Renderings of both arches in an image."""

    own: NDArray[np.uint8]  # labels of the searched arch, rendered alone: CROWN, GUM or 0, shape (h, w)
    other: NDArray[np.uint8]  # labels of the other arch, shape (h, w)
    other_inverse_depth: NDArray[np.float32]  # inverse depth of the other arch [1/mm], 0 = empty, shape (h, w)


@dataclass(frozen=True, eq=False)
class View:
    """The masks of one camera in one frame, undistorted, at working resolution."""

    matrix: Array  # world [mm] to homogeneous px of this image, shape (3, 4)
    eye: Array  # camera centre in world coordinates [mm], shape (3,)
    # masks of the upper and lower arch, uint8, 255 = teeth, shape (2, h, w); zeros without a mask
    masks: NDArray[np.uint8]
    present: Mask  # whether each of the two masks exists, shape (2,)
    # motion of the arches in the world from the reference camera's exposure to this camera's, shape (2, 4, 4)
    T_delay: Array = field(default_factory=lambda: np.tile(np.eye(4), (2, 1, 1)))
    # outward mask bias: at tooth edges [px], at the gum line [px], and along the crown at the gum line [mm]; shape (2,
    # 3)
    habits: Array = field(default_factory=lambda: np.zeros((2, 3)))
    edges: EdgeSearch | None = None  # search for tooth borders by colour, which replaces the masks


class MaskViews:
    """Reads the masks of all cameras by frame number of the reference camera; a context manager."""

    def __init__(
        self,
        sources: Sequence[MaskSource],
        cameras: Mapping[str, Camera],
        offsets: Mapping[str, int],
        centre_world: Array,
        working_px_per_mm: float,
        fewest: int = FEWEST_CAMERAS,
    ) -> None:
        """Open the masks and choose the working resolution.

        Args:
            offsets: time offset of every camera: the reference frame number minus its own frame number.
            centre_world: position of the teeth at the start [mm], shape (3,).
            working_px_per_mm: resolution at the teeth; images are never enlarged.

        Raises:
            TrackingError, CaptureError: as for `masked_sources`.
        """
        self._stack = ExitStack()
        self._masked = masked = masked_sources(sources, cameras, offsets, fewest)
        self._files = [s for s in sources if isinstance(s, CameraSource)]
        self._sizes = {s.name: cameras[s.name].size_px for s in self._files if s.masks}
        self.cameras = tuple(cameras[s.name] for s in masked)  # those with masks that are not all black, in order
        self._offsets = [offsets[s.name] for s in masked]
        self._working, self._readers = [], []
        for source, camera in zip(masked, self.cameras, strict=True):
            working = WorkingView(camera, working_size(camera, centre_world, working_px_per_mm))
            self._working.append(working)
            readers = open_masks(source, camera.size_px, prepare=working.mask)
            self._readers.append([self._stack.enter_context(reader) for reader in readers])
        self.frames = masked_frames(self._offsets, self._readers)  # end exclusive

    def __enter__(self) -> MaskViews:
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def findings(self) -> list[Finding]:
        """Return findings about the masks read so far, and about cameras without masks."""
        out = []
        for file in self._files:
            out += survey_masks(file, self._sizes.get(file.name, (0, 0)))
        for source, pair in zip(self._masked, self._readers, strict=True):
            if isinstance(source, CameraSource):
                for arch, reader in zip(ARCHES, pair, strict=True):
                    out += odd_pictures(source, arch, reader.odd)
        return out

    def at(self, frame: int) -> list[View]:
        """Return the views of one frame of the reference camera; raises CaptureError if a mask cannot be decoded."""
        return [
            _view(working, [reader.read(frame - offset) for reader in pair])
            for working, offset, pair in zip(self._working, self._offsets, self._readers, strict=True)
        ]

    def around(self, frame: int, reach: int) -> list[list[View]]:
        """Return the views of a frame and of up to `reach` frames before and after it, in order.

        Masks are decoded once and in file order, since every jump reopens the files.

        Raises:
            CaptureError: a mask cannot be decoded.
        """
        first, stop = frame - reach, frame + reach + 1
        cameras = []
        for working, offset, pair in zip(self._working, self._offsets, self._readers, strict=True):
            masks = zip(*(reader.read_some(first - offset, stop - offset) for reader in pair), strict=True)
            cameras.append([_view(working, both) for both in masks])
        return [list(views) for views in zip(*cameras, strict=True)]

    def walk(self, first: int, stop: int, step: int = 1) -> Iterator[tuple[int, list[View]]]:
        """Yield the frames of a range with their views; with step -1 in reverse, though masks are read forwards."""

        def read(frames: range) -> Iterator[tuple[int, list[View]]]:
            return ((frame, self.at(frame)) for frame in frames)

        frames = range(first, stop, step)
        yield from read(frames) if step > 0 else read_backwards(frames, read, _FIRST_CHUNK, _CHUNK)


def masked_frames(offsets: Sequence[int], readers: Sequence[Sequence[MaskReader]]) -> tuple[int, int]:
    """Return the first frame in which any camera may have a mask, and one past the last."""
    return min(offsets), max(o + reader.count for o, pair in zip(offsets, readers, strict=True) for reader in pair)


def present_masks(views: Sequence[View]) -> Mask:
    """Return whether each mask exists, shape (2, C)."""
    return np.array([view.present for view in views]).T


def masked_sources(
    sources: Sequence[AnySource],
    cameras: Mapping[str, Camera],
    offsets: Mapping[str, int],
    fewest: int = FEWEST_CAMERAS,
) -> tuple[AnySource, ...]:
    """Return the cameras with masks that are not all black.

    Raises:
        TrackingError: fewer than `fewest` cameras have such masks, or one of these cameras is not calibrated or not
            synchronised.
        CaptureError: masks are missing, corrupt, of the wrong size, or not masks.
    """
    masked = []
    for source in sources:
        if source.masks is None:
            continue
        for table, what in ((cameras, "calibration"), (offsets, "time offset")):
            if source.name not in table:
                raise TrackingError(f"camera {source.name} has no {what}", hint="Calibrate and synchronise first.")
        if not all(reader.is_black for reader in open_masks(source, cameras[source.name].size_px)):
            masked.append(source)
    if len(masked) < fewest:
        without = [
            f"{source.name}: {'no masks' if source.masks is None else 'masks are all black'}"
            for source in sources
            if source not in masked
        ]
        raise TrackingError(
            f"{len(masked)} of {len(sources)} cameras have masks"
            + ("; with one view, the depth of the teeth is unknown" if fewest > 1 else "")
            + (f" ({'; '.join(without)})" if without else ""),
            hint="Provide masks for at least two cameras, about 30 degrees apart or more."
            if fewest > 1
            else "Segment at least one camera.",
        )
    return tuple(masked)


def working_size(camera: Camera, centre_world: Array, px_per_mm: float) -> tuple[int, int]:
    """Return the image size for a resolution at a world point; raises TrackingError if it is behind the camera."""
    depth = float(camera.depth(centre_world))
    if depth <= 0:
        raise TrackingError(
            f"the teeth are {-depth:.0f} mm behind this camera",
            camera=camera.name,
            hint="Check the calibration and the camera names of the picks.",
        )
    recorded = np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / depth
    scale = min(1.0, px_per_mm / recorded)
    return max(1, round(camera.size_px[0] * scale)), max(1, round(camera.size_px[1] * scale))


def _view(working: WorkingView, masks: Sequence[NDArray[np.uint8] | None]) -> View:
    """Return the view of a camera, cropped to its masks."""
    camera = working.camera
    # Masks without a pixel above half coverage have no outline: they are too small at this resolution.
    highest = [None if m is None else m.max(axis=1) for m in masks]
    masks = [m if h is not None and h.max() > 127 else None for m, h in zip(masks, highest, strict=True)]
    present = np.array([m is not None for m in masks])
    if not present.any():
        return View(camera.projection_matrix(), camera.centre_world(), np.zeros((2, 1, 1), np.uint8), present)
    shown = [(m, h) for m, h in zip(masks, highest, strict=True) if m is not None and h is not None]
    rows = np.flatnonzero(np.maximum.reduce([h for _, h in shown]))
    band = slice(rows[0], rows[-1] + 1)
    columns = np.flatnonzero(np.maximum.reduce([m[band].max(axis=0) for m, _ in shown]))
    height, width = shown[0][0].shape
    y0, x0 = max(0, rows[0] - _BORDER_PX), max(0, columns[0] - _BORDER_PX)
    y1, x1 = min(height, rows[-1] + 1 + _BORDER_PX), min(width, columns[-1] + 1 + _BORDER_PX)
    cut = np.zeros((2, y1 - y0, x1 - x0), np.uint8)
    for r, mask in enumerate(masks):
        if mask is not None:
            cut[r] = mask[y0:y1, x0:x1]
    part = camera.cropped(int(x0), int(y0), (int(x1 - x0), int(y1 - y0)))
    return View(part.projection_matrix(), part.centre_world(), cut, present)
