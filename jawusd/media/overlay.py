"""Draw tracked scans over the footage for visual checks (figs. 10 and 11 of the paper), and scans with their labels.

The background is the footage of a camera, or its masks if there is no footage. Labels of crown, gum and base are shown
as colours, from the occlusal side, front, left and right.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, CaptureError
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.formats.capture import CameraSource
from jawusd.formats.mesh import BASE, GUM, TOOTH, Mesh, crown_face_mask
from jawusd.formats.performance import STATE_COLOURS, SolveState
from jawusd.formats.tracks import LOST, Tracks
from jawusd.geometry import Camera, transform_points
from jawusd.media.footage import FrameReader, open_clip
from jawusd.media.masks import mask_size_px, open_masks
from jawusd.meshes.raster import draw_depth_labels

#: Colour: red, green and blue, 0 to 255.
Colour = tuple[int, int, int]

UPPER_COLOUR: Colour = (255, 170, 0)
LOWER_COLOUR: Colour = (0, 200, 255)
_LINE_PX = 2
CAPTION_PX = 22
#: Gray value of a tile if the camera has no image.
EMPTY_GRAY = 60
_MARGIN = 0.25  # margin around the teeth in a tile, as a fraction of their extent


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A teeth scan at its tracked pose."""

    mesh: Mesh  # the scan [mm]; gum is not drawn, but hides what is behind it
    T_world_scan: Array  # pose of the scan, shape (4, 4); the scan is omitted if NaN
    colour: Colour


def draw_overlay(
    image: NDArray[np.uint8], camera: Camera, scans: Sequence[PlacedScan], *, fill: float = 0.3
) -> NDArray[np.uint8]:
    """Return a copy of an RGB image (h, w, 3) with the visible crowns tinted (opacity `fill`) and outlined.

    Raises:
        ValueError: the image does not have the camera's size.
    """
    if image.shape != (camera.size_px[1], camera.size_px[0], 3) or image.dtype != np.uint8:
        raise ValueError(f"image is {image.dtype} of shape {image.shape}; expected RGB of {camera.size_px} px")
    labels = _visible_crowns(camera, scans)
    out = image.copy()
    kernel = np.ones((2 * _LINE_PX + 1,) * 2, np.uint8)
    for number, scan in enumerate(scans, start=1):
        crown = (labels == number).astype(np.uint8)
        inner = cv2.erode(crown, kernel, borderType=cv2.BORDER_REPLICATE) > 0
        if fill:
            tint = (1 - fill) * image[inner] + fill * np.array(scan.colour)
            out[inner] = np.round(tint).astype(np.uint8)
        out[(crown > 0) & ~inner] = scan.colour
    return out


def arch_colours(tracks: Tracks, row: int) -> tuple[Colour, Colour]:
    """Return the colours of the upper and lower arch for a row of tracks; in a solve, they show the state."""
    if tracks.solved is None:
        return UPPER_COLOUR, LOWER_COLOUR
    whole = SolveState(int(tracks.solved.state[row]))
    seen, unseen = STATE_COLOURS[SolveState.SOLVED], STATE_COLOURS[whole]
    upper, lower = (unseen if status == LOST else seen for status in tracks.status[row])
    return upper, lower


def placed_scans(tracks: Tracks, row: int, meshes: Sequence[Mesh]) -> list[PlacedScan]:
    """Return the upper and the lower scan with their poses in a row of tracks."""
    poses = tracks.T_world_upper[row], tracks.T_world_lower[row]
    return [PlacedScan(*one) for one in zip(meshes, poses, arch_colours(tracks, row), strict=True)]


def tracking_sheet(
    tracks: Tracks,
    frames: Sequence[int],
    cameras: Sequence[Camera],
    backdrops: Mapping[str, Backdrop],
    upper: Mesh,
    lower: Mesh,
    *,
    tile_px: tuple[int, int] = (480, 270),
) -> NDArray[np.uint8]:
    """Return one RGB image of captioned tiles cropped to the teeth, with a row per frame and a column per camera.

    A tile is gray if the camera has no image. Crowns are not tinted if the jaw was lost. Frames are those of the
    reference camera; `backdrops` has the image source of each camera.

    Raises:
        ValueError: a frame is not in tracks.
        CaptureError: a video cannot be decoded.
    """
    row_of = {int(frame): row for row, frame in enumerate(tracks.frames)}
    missing = [frame for frame in frames if frame not in row_of]
    if missing:
        raise ValueError(f"frame {missing[0]} is not in the tracks, which have {len(row_of)} frames")
    tiles = []
    for frame in frames:
        scans = placed_scans(tracks, row_of[frame], (upper, lower))
        for camera in cameras:
            picture = backdrops[camera.name].picture(frame)
            tile = np.full((tile_px[1], tile_px[0], 3), EMPTY_GRAY, np.uint8)
            if picture is not None:
                tile = _cut_to_teeth(draw_overlay(picture, camera, scans), camera, scans, tile_px)
            tiles.append(captioned(tile, f"{camera.name}  frame {frame}"))
    return contact_sheet(tiles, len(cameras))


def contact_sheet(tiles: Sequence[NDArray[np.uint8]], columns: int) -> NDArray[np.uint8]:
    """Arrange images of equal size in rows, the last row padded with black; return RGB uint8.

    Raises:
        ValueError: there are no images, or they differ in size.
    """
    if not tiles or columns < 1 or len({tile.shape for tile in tiles}) != 1:
        raise ValueError(f"images have the shapes {[tile.shape for tile in tiles]}; expected equal sizes")
    height, width, channels = tiles[0].shape
    rows = math.ceil(len(tiles) / columns)
    sheet = np.zeros((rows * height, columns * width, channels), np.uint8)
    for k, tile in enumerate(tiles):
        top, left = k // columns * height, k % columns * width
        sheet[top : top + height, left : left + width] = tile
    return sheet


def save_png(path: AnyPath, image: NDArray[np.uint8]) -> None:
    """Write an RGB image (h, w, 3) as PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    write_bytes_atomic(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return the bytes of an RGB image (h, w, 3) as a JPEG file; quality 0 to 100."""
    return cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _points(camera: Camera, scan: PlacedScan) -> NDArray[np.float32]:
    """Return the distorted pixel and the depth of each vertex; distortion varies little within a triangle."""
    world = transform_points(scan.T_world_scan, scan.mesh.vertices)
    return np.column_stack([camera.project(world), camera.depth(world)]).astype(np.float32)


@lru_cache(maxsize=8)
def _parted_faces(mesh: Mesh) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the gum faces and crown faces of a scan; cached, since videos need them for every frame."""
    crown = crown_face_mask(mesh)
    return mesh.faces[~crown], mesh.faces[crown]


def _visible_crowns(camera: Camera, scans: Sequence[PlacedScan]) -> NDArray[np.uint8]:
    width, height = camera.size_px
    inverse_depth, labels = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    for number, scan in enumerate(scans, start=1):
        if not np.isfinite(scan.T_world_scan).all():
            continue
        points = _points(camera, scan)
        gum, crowns = _parted_faces(scan.mesh)
        for faces, label in ((gum, 0), (crowns, number)):
            draw_depth_labels(points, faces, 0, 0, False, inverse_depth, labels, label)
    return labels


def _cut_to_teeth(
    image: NDArray[np.uint8], camera: Camera, scans: Sequence[PlacedScan], tile_px: tuple[int, int]
) -> NDArray[np.uint8]:
    """Crop an image around the scans and scale it to a tile, keeping the aspect ratio."""
    seen = [_points(camera, scan)[:, :2] for scan in scans if np.isfinite(scan.T_world_scan).all()]
    whole = np.array([[0, 0], camera.size_px], float)
    low, high = whole if not seen else (np.min(np.vstack(seen), axis=0), np.max(np.vstack(seen), axis=0))
    centre = (low + high) / 2
    scale = float(np.min(np.array(tile_px) / np.maximum((high - low) * (1 + 2 * _MARGIN), 1)))
    to_tile = np.array([[scale, 0, tile_px[0] / 2 - scale * centre[0]], [0, scale, tile_px[1] / 2 - scale * centre[1]]])
    shrinks = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.warpAffine(image, to_tile, tile_px, flags=shrinks), np.uint8)


def captioned(tile: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """Return an RGB tile (h, w, 3) with a caption."""
    out = np.vstack([np.zeros((CAPTION_PX, tile.shape[1], 3), np.uint8), tile])
    cv2.putText(out, text, (6, CAPTION_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return out


#: Gray values of upper teeth, lower teeth and background in masks.
_UPPER, _LOWER, _NEITHER = 150, 105, 25


class Backdrop:
    """Background images of one camera, by frame number of the reference camera; thread-safe.

    Attributes:
        size_px: (width, height) of the images.
        count: one past the last frame number of the camera itself.
        is_footage: whether the images are footage instead of masks.
    """

    def __init__(self, source: CameraSource, offset: int) -> None:
        """Open the footage or masks; their frame k is simultaneous with frame k + offset of the reference camera.

        Raises:
            CaptureError: the camera has neither a video nor masks, or they cannot be decoded.
        """
        self._offset = offset
        self._lock = threading.Lock()
        self.is_footage = source.clip is not None
        if source.clip is not None:
            self._reader = FrameReader(open_clip(source.clip))
            self.size_px, self.count = self._reader.video.size_px, self._reader.video.timeline.count
        elif source.masks is not None:
            self.size_px = mask_size_px(source.masks.upper)
            self._masks = open_masks(source, self.size_px)
            self.count = max(masks.count for masks in self._masks)
        else:
            raise CaptureError(
                "has neither a video nor masks to draw over.",
                camera=source.name,
                hint="Add one of them in the capture file.",
            )

    def picture(self, frame: int) -> NDArray[np.uint8] | None:
        """Return the image at a frame of the reference camera, (h, w, 3) RGB, read-only, or None.

        Raises:
            CaptureError: the image cannot be decoded.
        """
        own = frame - self._offset
        if self.is_footage:
            number = self._reader.video.timeline.picture(own)
            return None if number is None else self._reader.picture(number)
        with self._lock:
            found = [masks.read(own) for masks in self._masks]
        width, height = self.size_px
        out = np.full((height, width), _NEITHER, np.uint8)
        for mask, gray in zip(found, (_UPPER, _LOWER), strict=True):
            if mask is not None:
                out[mask > 127] = gray
        return np.repeat(out[:, :, None], 3, axis=2)

    def close(self) -> None:
        """Stop decoding in the background."""
        if not self.is_footage:
            for masks in self._masks:
                masks.close()


#: RGB colours of the labels: gum, crown, crown at a border of interest, base.
COLOURS = np.array([(214, 108, 112), (240, 234, 214), (150, 205, 130), (120, 135, 165)], np.uint8)
_BACKGROUND = (40, 42, 46)
_TILE_PX = (520, 400)
_FILLED = 0.92  # fraction of the tile size that the scan fills
_FAR_MM = 1000.0  # camera distance, large enough for nearly orthographic views
_LEAST_LIGHT = 0.35
# Camera axes of each view: matrices whose rows are right, up and towards the camera, in (left, up, front) axes of the
# subject. The occlusal side of the upper arch is seen from below, that of the lower arch from above, with the front
# teeth at the top.
_SIDES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "left": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "right": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
_BITING = {"upper": ((-1, 0, 0), (0, 0, 1), (0, -1, 0)), "lower": ((1, 0, 0), (0, 0, 1), (0, 1, 0))}


def label_sheet(
    scans: Sequence[tuple[str, Mesh, NDArray[np.uint8]]],
    T_anatomical_scan: Array,
    captions: Sequence[str],
) -> NDArray[np.uint8]:
    """Return one RGB image with a captioned row of four views for each scan.

    Args:
        scans: for each scan: "upper" or "lower", the scan, and a label of `formats.mesh` for each vertex.
        T_anatomical_scan: transform from the scan frame to (left, up, front) axes, shape (4, 4).
    """
    tiles = []
    for (arch, mesh, labels), caption in zip(scans, captions, strict=True):
        points = mesh.vertices @ T_anatomical_scan[:3, :3].T
        sides = {"biting side": _BITING[arch], **_SIDES}
        for number, (name, axes) in enumerate(sides.items()):
            tile = _view(points @ np.array(axes, np.float64).T, mesh.faces, labels)
            tiles.append(captioned(tile, caption if number == 0 else f"{arch}: {name}"))
    return contact_sheet(tiles, len(_SIDES) + 1)


def _view(points: Array, faces: NDArray[np.int32], labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Draw a surface with points (V, 3) [mm] in view axes (right, up, towards the camera); return an RGB tile."""
    width, height = _TILE_PX
    low, high = points.min(axis=0), points.max(axis=0)
    px_per_mm = _FILLED * min(width / max(high[0] - low[0], 1.0), height / max(high[1] - low[1], 1.0))
    middle = (low + high) / 2
    placed = np.column_stack(
        [
            width / 2 + px_per_mm * (points[:, 0] - middle[0]),
            height / 2 - px_per_mm * (points[:, 1] - middle[1]),
            _FAR_MM - (points[:, 2] - middle[2]),
        ]
    ).astype(np.float32)
    inverse_depth, seen = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    of_face = face_labels(labels, faces)
    for label in range(BASE + 1):
        draw_depth_labels(placed, faces[of_face == label], 0, 0, False, inverse_depth, seen, label)
    image = np.empty((height, width, 3), np.uint8)
    image[:] = _BACKGROUND
    drawn = inverse_depth > 0
    depth = np.where(drawn, 1.0 / np.where(drawn, inverse_depth, 1.0), _FAR_MM) * px_per_mm
    down, right = np.gradient(depth)
    light = 1.0 / np.sqrt(1.0 + down**2 + right**2)  # light from the camera
    light = _LEAST_LIGHT + (1 - _LEAST_LIGHT) * light
    image[drawn] = (COLOURS[seen[drawn]] * light[drawn][:, None]).astype(np.uint8)
    return image


def face_labels(labels: NDArray[np.uint8], faces: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return the label of each face, shape (F,): crown if at least two corners are crown, otherwise gum or base."""
    corner = labels[faces]
    tooth = (corner == TOOTH) | (corner > TOOTH) & (corner < BASE)
    rest = np.where((corner == BASE).sum(axis=1) >= 2, BASE, GUM)
    interest = np.where((corner > TOOTH).sum(axis=1) >= 2, TOOTH + 1, TOOTH)
    return np.where(tooth.sum(axis=1) >= 2, interest, rest).astype(np.uint8)
