"""The calibration of one camera by picks: by how much its pictures are shifted or scaled if that is why they miss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from jawusd.base.arrays import Array
from jawusd.formats.capture import Pick
from jawusd.geometry import Camera, rigid_fit, se3_exp, transform_points, triangulate

# What may be wrong, standard deviations: shift over the picture's width, relative focal length; and of a click [mm].
_SHIFT, _FOCAL, _CLICK_MM = 0.05, 0.1, 0.3
_MOST_ZOOM = np.log(2.0)  # logarithm of a focal length over the given one: what clicks without sense ask for overflows
_STEP = np.array([0.1, 0.1, 0.1, 1.0, 1.0, 1.0])  # of the poses, about what they are off [rad, mm]


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
        if not zooms:
            return shifted(given, x[:2] * _SHIFT * width)
        return zoomed(given, float(np.exp(np.clip(x[0] * _FOCAL, -_MOST_ZOOM, _MOST_ZOOM))))

    placed = [_placed(own, points, cameras) for own, points in zip(picks, vertices, strict=True)]
    starts = [start for start in placed if start is not None]
    if len(starts) < len(placed):
        return None
    sights = [_sights(own, points) for own, points in zip(picks, vertices, strict=True)]

    def residuals(x: Array) -> Array:
        """Return misses over a click's, and the change of the camera over its own deviation."""
        table = {**cameras, name: changed(x)}
        out = [x[:2]]
        for k, (start, seen) in enumerate(zip(starts, sights, strict=True)):
            T = se3_exp(x[2 + 6 * k : 8 + 6 * k] * _STEP)
            about, middle, views = seen
            everything = transform_points(start, middle + transform_points(T, about))
            for camera_name, which, pixels in views:
                camera, placed = table[camera_name], everything[which]
                mm_per_px = camera.depth(placed) / float(camera.K[0, 0])
                out.append(((camera.project(placed) - pixels) * mm_per_px[:, None] / _CLICK_MM).ravel())
        return np.concatenate(out)

    found = least_squares(residuals, np.zeros(14), method="lm", max_nfev=250)
    return changed(found.x)


def _sights(picks: Sequence[Pick], vertices: Array) -> tuple[Array, Array, list[tuple[str, list[int], Array]]]:
    """Return what is picked of a scan.

    Returns:
        the picked points about their middle (P, 3), the middle (3,), and by camera which points it saw, at which
        pixels (N, 2).
    """
    points = np.stack([vertices[pick.vertex] for pick in picks])
    middle = points.mean(axis=0)
    seen: dict[str, list[tuple[int, list[float]]]] = {}
    for k, pick in enumerate(picks):
        for view in pick.views:
            seen.setdefault(view.camera, []).append((k, [view.x, view.y]))
    views = [(name, [k for k, _ in own], np.array([pixel for _, pixel in own])) for name, own in seen.items()]
    return points - middle, middle, views


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
