"""Draw teeth scans with coloured crown, gum and base labels, seen from the occlusal side, front, left and right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.mesh import BASE, GUM, TOOTH, Mesh
from jawusd.media.overlay import captioned, contact_sheet
from jawusd.meshes.raster import draw_depth_labels

#: RGB colours of the labels: gum, crown, crown at a border of interest, base.
COLOURS = np.array([(214, 108, 112), (240, 234, 214), (150, 205, 130), (120, 135, 165)], np.uint8)
_BACKGROUND = (40, 42, 46)
_TILE_PX = (520, 400)
_MARGIN = 0.92  # fraction of the tile size that the scan fills
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
    """Return one RGB image with a row of four views for each scan.

    Args:
        scans: for each scan: "upper" or "lower", the scan, and a label of `formats.mesh` for each vertex.
        T_anatomical_scan: transform from the scan frame to (left, up, front) axes, shape (4, 4).
        captions: one line per scan, written above its row of views.
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
    px_per_mm = _MARGIN * min(width / max(high[0] - low[0], 1.0), height / max(high[1] - low[1], 1.0))
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
