"""Picks for short captures: ends of teeth that two cameras see, clicked on with a shaky hand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.synthetic.picks import spread_out

#: Labels (rows, columns), first column and row of that part of the picture, inverse depth (rows, columns) [1/mm].
Drawn = tuple[NDArray[np.uint8], tuple[int, int], NDArray[np.float32]]
#: First label of the teeth of each arch; 14 follow one another.
TEETH_FROM = (1, 41)
#: Vertex of a scan and its pixels: (camera, x, y) of two cameras.
ShortPick = tuple[int, list[tuple[str, float, float]]]

_PICKS = 4
_PICK_NOISE_PX = 1.5


def pick_ends(
    mesh: Mesh,
    row: int,
    pose: Array,
    T_bite_scan: Array,
    cameras: Sequence[Camera],
    seen: Sequence[Drawn],
    rng: np.random.Generator,
) -> list[ShortPick]:
    """Choose four well spread ends of teeth of a scan; none if too few are seen by two cameras.

    Args:
        row: 0 upper, 1 lower.
        pose: T_world_scan, shape (4, 4).
        T_bite_scan: scan to (left, up, front) axes, shape (4, 4).
        seen: who is seen where, per camera.
    """
    world = transform_points(pose, mesh.vertices)
    visible = np.stack([_visible(camera, world, *drawn, row) for camera, drawn in zip(cameras, seen, strict=True)], 1)
    good = np.flatnonzero(visible.sum(1) >= 2)
    if len(good) < _PICKS:
        return []
    # What a person clicks on: the ends of the teeth, towards the other arch.
    height = transform_points(T_bite_scan, mesh.vertices[good])[:, 1] * (1.0 if row else -1.0)
    good = good[height >= np.quantile(height, 0.6)] if len(good) > 200 else good
    out = []
    for vertex in good[np.array(spread_out(world[good], _PICKS))].tolist():
        views = []
        for c in np.flatnonzero(visible[vertex])[:2]:
            clicked = cameras[c].project(world[vertex]) + rng.normal(0.0, _PICK_NOISE_PX, 2)
            x, y = np.clip(clicked, 0.0, np.array(cameras[c].size_px) - 1.0)
            views.append((cameras[c].name, float(x), float(y)))
        out.append((int(vertex), views))
    return out


def pick_lines(jaw: str, pick: ShortPick) -> list[str]:
    """Return a pick as lines of capture.toml."""
    vertex, views = pick
    text = ", ".join(f'{{ camera = "{name}", x = {x:.2f}, y = {y:.2f} }}' for name, x, y in views)
    return [f"[[bootstrap.{jaw}]]", f"vertex = {vertex}", f"views = [{text}]", ""]


def _visible(
    camera: Camera,
    world: Array,
    labels: NDArray[np.uint8],
    window: tuple[int, int],
    depth: NDArray[np.float32],
    row: int,
) -> NDArray[np.bool_]:
    """Tell which points (N, 3) of an arch's crowns a camera sees."""
    at = np.rint(camera.project(world)).astype(int) - window
    inside = np.asarray(((at >= 2) & (at < np.array(labels.shape[::-1]) - 2)).all(1))
    at = np.where(inside[:, None], at, 0)
    near = depth[at[:, 1], at[:, 0]] * camera.depth(world) < 1.0 + 0.4 / 300.0
    first = TEETH_FROM[row]
    own = labels[at[:, 1], at[:, 0]]
    return np.asarray(inside & near & (own >= first) & (own < first + 14))
