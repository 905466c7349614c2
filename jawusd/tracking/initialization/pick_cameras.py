"""The calibration of one camera by picks: by how much its pictures are shifted or scaled if that is why they miss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from jawusd.formats.capture import Pick
from jawusd.geometry import Camera, rigid_fit, se3_exp, transform_point, triangulate
from jawusd.geometry.arrays import Array

# What may be wrong, standard deviations: shift over the picture's width, relative focal length; and of a click [mm].
_SHIFT, _FOCAL, _CLICK_MM = 0.05, 0.1, 0.3


def shifted(camera: Camera, shift_px: Array) -> Camera:
    """Return a camera whose pictures lie elsewhere by so many pixels, shape (2,)."""
    K = camera.K.copy()
    K[:2, 2] += shift_px
    return replace(camera, K=K)


def zoomed(camera: Camera, factor: float) -> Camera:
    """Return a camera whose focal length is so many times as long."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= factor
    return replace(camera, K=K)


def fitted_camera(
    picks: Sequence[Sequence[Pick]],
    vertices: Sequence[Array],
    cameras: Mapping[str, Camera],
    name: str,
    zooms: bool,
) -> Camera | None:
    """Return a camera with the shift, or the focal length, with which the picks agree best; None if it is in none.

    `picks` and `vertices` are those of the upper and the lower scan; their poses are fitted as well.
    """
    if all(view.camera != name for own in picks for pick in own for view in pick.views):
        return None
    given = cameras[name]
    width = float(given.size_px[0])

    def changed(x: Array) -> Camera:
        return zoomed(given, float(np.exp(x[0] * _FOCAL))) if zooms else shifted(given, x[:2] * _SHIFT * width)

    placed = [_placed(own, points, cameras) for own, points in zip(picks, vertices, strict=True)]
    starts = [start for start in placed if start is not None]
    if len(starts) < len(placed):
        return None
    middles = [np.mean([points[p.vertex] for p in own], axis=0) for own, points in zip(picks, vertices, strict=True)]

    def residuals(x: Array) -> Array:
        """Return misses over a click's, and the change of the camera over its own deviation."""
        table = {**cameras, name: changed(x)}
        out = [x[:2]]
        for k, (own, points, start, middle) in enumerate(zip(picks, vertices, starts, middles, strict=True)):
            T = se3_exp(x[2 + 6 * k : 8 + 6 * k] * np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0]))
            for pick in own:
                point = transform_point(start, middle + transform_point(T, points[pick.vertex] - middle))
                for view in pick.views:
                    camera = table[view.camera]
                    mm_per_px = float(camera.depth(point)) / float(camera.K[0, 0])
                    out.append((camera.project(point) - [view.x, view.y]) * mm_per_px / _CLICK_MM)
        return np.concatenate(out)

    found = least_squares(residuals, np.zeros(14), method="lm", max_nfev=400)
    return changed(found.x)


def _placed(picks: Sequence[Pick], vertices: Array, cameras: Mapping[str, Camera]) -> Array | None:
    """Return T_world_scan (4, 4) by the triangulated picks; None if they lie on a line."""
    places = [
        triangulate(
            np.stack([cameras[view.camera].projection_matrix() for view in pick.views]),
            np.stack([cameras[view.camera].undistort_pixels([view.x, view.y]) for view in pick.views]),
        )
        for pick in picks
    ]
    try:
        return rigid_fit(np.stack([vertices[pick.vertex] for pick in picks]), np.stack(places))
    except ValueError:
        return None
