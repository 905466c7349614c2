"""Initial poses from picked vertices: triangulation, consensus of rigid fits, refinement of the reprojection error."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, islice
from math import comb

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.formats.capture import Bootstrap, Pick
from jawusd.geometry import (
    Camera,
    mandible_metric,
    orthonormalise,
    rigid_fit,
    transform_point,
    transform_points,
    triangulate,
)
from jawusd.tracking.contour.equations import motion_about
from jawusd.tracking.contour.scan import ARCH_NAMES

#: Minimum number of picks on an arch.
FEWEST_PICKS = 3
#: Distance between projected vertex and picked pixel above which a pick is rejected [mm at the teeth]: three times the
#: error of a careless click (5 px where a pixel is 0.07 mm).
TOLERANCE_MM = 1.1
#: Hint for scans of a wrong size.
SIZE_HINT = "Check the scans' unit and scaling, and the square size of the calibration board."
_CLICK_MM = TOLERANCE_MM / 3  # standard deviation of a careless click along each axis [mm]
_GAP_MM = 0.8  # maximum distance between the lines of sight of a careless pick [mm]
_SIZE_SHARE = 0.03  # minimum relative error of the scan size that explains a misfit [-]: careless clicks cause 0.01
_MOST_TRIPLES = 500  # maximum number of pick triples tried: more do not improve the consensus


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A pick prepared for fitting: the scan point and its undistorted pixel in each view."""

    number: int
    point: Array
    matrices: Array
    pixels: Array


def pose_from_picks(
    picks: Sequence[Pick], vertices: Array, cameras: Mapping[str, Camera], arch: str
) -> tuple[Array, list[int]]:
    """Return T_world_scan (4, 4) from the picks, and the numbers, from 1, of rejected picks.

    `vertices` are those of the scan file [mm], shape (V, 3); `arch` is the arch's name for messages.

    Raises:
        TrackingError: too few picks, an invalid pick, or picks that contradict one another.
    """
    if len(picks) < FEWEST_PICKS:
        raise TrackingError(
            f"bootstrap: {len(picks)} picks on the {arch} teeth; at least {FEWEST_PICKS} are needed",
            hint="Pick more vertices, spread over the arch, each in at least two cameras.",
        )
    sightings = _sightings(picks, vertices, cameras, arch)
    points, places = _triangulated(sightings)
    best, best_cost = None, np.inf
    step = max(1, comb(len(picks), FEWEST_PICKS) // _MOST_TRIPLES)
    for triple in islice(combinations(range(len(picks)), FEWEST_PICKS), 0, None, step):
        k = list(triple)
        try:
            pose = rigid_fit(points[k], places[k])
        except ValueError:
            continue  # these three picks are collinear and do not determine a rotation
        cost = sum(min(_miss_mm(s, pose), TOLERANCE_MM) ** 2 for s in sightings)
        if cost < best_cost:
            best, best_cost = pose, cost
    if best is None:
        raise TrackingError(
            f"bootstrap: the picks on the {arch} teeth lie on a line",
            hint="Pick vertices on the front teeth and on both sides.",
        )
    for _ in range(3):
        good = [s for s in sightings if _miss_mm(s, best) < TOLERANCE_MM]
        if len(good) < FEWEST_PICKS:
            if (size := _other_size(sightings)) is not None:
                raise TrackingError(
                    f"bootstrap: the picks on the {arch} teeth contradict one another, but agree with a scan "
                    f"{than(1 / size - 1)}: the scale of the scans or of the calibration is wrong",
                    hint=SIZE_HINT,
                )
            if (cause := _wrong_sight(picks, vertices, cameras, arch)) is not None:
                raise TrackingError(
                    f"bootstrap: the picks on the {arch} teeth contradict one another: {cause}",
                    hint="Check the calibration and the picks' camera names, and that all views show the same frame.",
                )
            misses = ", ".join(f"pick {s.number}: {_miss_mm(s, best):.1f} mm" for s in sightings)
            raise TrackingError(
                f"bootstrap: the picks on the {arch} teeth contradict one another "
                f"({misses}; up to {TOLERANCE_MM} mm is allowed)",
                hint="Check the vertices, pixels and camera names of the picks, and that views show the same frame.",
            )
        best = _refined(good, best)
    return best, [s.number for s in sightings if s not in good]


def poses_from_picks(bootstrap: Bootstrap, vertices: Sequence[Array], cameras: Mapping[str, Camera]) -> Array:
    """Return T_world_upper and T_world_lower from the picks on both arches, shape (2, 4, 4); see `pose_from_picks`."""
    given = zip((bootstrap.upper, bootstrap.lower), vertices, ARCH_NAMES, strict=True)
    return np.stack([pose_from_picks(picks, points, cameras, arch)[0] for picks, points, arch in given])


def _other_size(sightings: Sequence[_Sighting]) -> float | None:
    """Return the factor by which the scan is too large if that explains the misfit of the picks, otherwise None."""
    points, places = _triangulated(sightings)
    spread, seen = (float(np.std(x - x.mean(0))) for x in (points, places))
    size = spread / max(seen, 1e-9)
    if len(sightings) <= FEWEST_PICKS or abs(size - 1.0) < _SIZE_SHARE:
        return None
    pose = rigid_fit(points / size, places)
    fits = all(_miss_mm(replace(s, point=s.point / size), pose) < TOLERANCE_MM for s in sightings)
    return size if fits else None


def _wrong_sight(picks: Sequence[Pick], vertices: Array, cameras: Mapping[str, Camera], arch: str) -> str | None:
    """Describe swapped cameras or lines of sight that do not meet, if they explain the misfit of the picks, or None."""
    for a, b in combinations(cameras, 2):
        seen = _sightings(exchanged(picks, a, b), vertices, cameras, arch)
        pose = rigid_fit(*_triangulated(seen))
        if all(_miss_mm(s, pose) < TOLERANCE_MM for s in seen):
            return f"cameras {a} and {b} are exchanged, in the picks or in the calibration"
    # Lines of sight of neighbouring cameras may meet even if different points at the same height were picked.
    seen = _sightings(picks, vertices, cameras, arch)
    places = _triangulated(seen)[1]
    gaps = [_miss_mm(replace(s, point=place), np.eye(4)) for s, place in zip(seen, places, strict=True)]
    if float(np.median(gaps)) < _GAP_MM:
        return None
    return (
        f"the lines of sight of their views miss one another by up to {max(gaps):.1f} mm (usual: {_GAP_MM:g} mm): "
        "a calibration or camera name is wrong, or the views show different frames"
    )


def with_cameras(picks: Sequence[Pick], renamed: Callable[[list[str]], list[str]]) -> list[Pick]:
    """Return picks with the cameras of their views renamed."""
    out = []
    for pick in picks:
        names = renamed([view.camera for view in pick.views])
        views = [v.model_copy(update={"camera": name}) for v, name in zip(pick.views, names, strict=True)]
        out.append(pick.model_copy(update={"views": tuple(views)}))
    return out


def exchanged(picks: Sequence[Pick], a: str, b: str) -> list[Pick]:
    """Return picks with two cameras exchanged in their views."""
    other = {a: b, b: a}
    return with_cameras(picks, lambda names: [other.get(name, name) for name in names])


def than(share: float) -> str:
    """Format a relative difference of sizes as "2.0% larger" or "2.0% smaller"."""
    return f"{abs(share):.1%} {'larger' if share > 0 else 'smaller'}"


def picked_sigma_mm(
    picks: Sequence[Pick], vertices: Array, cameras: Mapping[str, Camera], pose: Array, probes: Array
) -> float:
    """Return the rms position uncertainty of the crowns at T_world_scan (4, 4) [mm], assuming careless clicks.

    `probes` are points spread over the crowns, scan coordinates [mm], shape (N, 3).
    """
    H = np.zeros((6, 6))
    for s in _sightings(picks, vertices, cameras):
        _, _, slope = _residuals_px(s, pose)
        px_per_mm = np.linalg.norm(slope, axis=(1, 2)) / np.sqrt(2)
        slope = (slope / (px_per_mm * _CLICK_MM)[:, None, None]).reshape(-1, 3)
        p = transform_point(pose, s.point)
        J = np.hstack([np.cross(p, slope), slope])
        H += J.T @ J
    M = mandible_metric(transform_points(pose, probes))
    return float(np.sqrt(np.trace(M @ np.linalg.pinv(H, hermitian=True))))


def picks_miss_mm(picks: Sequence[Pick], vertices: Array, cameras: Mapping[str, Camera], pose: Array) -> Array:
    """Return the error of each pick at T_world_scan (4, 4), measured at the vertex [mm], shape (P,)."""
    return np.array([_miss_mm(s, pose) for s in _sightings(picks, vertices, cameras)])


def picked_size(picks: Sequence[Sequence[Pick]], vertices: Sequence[Array], cameras: Mapping[str, Camera]) -> float:
    """Return the size ratio of both scans to triangulated picks [-]; raises TrackingError for an invalid pick."""
    product, square = 0.0, 0.0
    for own, points in zip(picks, vertices, strict=True):
        given, places = _triangulated(_sightings(own, points, cameras))
        given = given - given.mean(0)
        try:
            turned = given @ rigid_fit(given, places)[:3, :3].T
        except ValueError:
            continue  # collinear picks do not determine a rotation
        product += float((turned * (places - places.mean(0))).sum())
        square += float((turned**2).sum())
    return square / max(product, 1e-9)


def placed(picks: Sequence[Pick], vertices: Array, cameras: Mapping[str, Camera]) -> Array | None:
    """Return T_world_scan (4, 4) from the triangulated picks; None if the picks lie on a line."""
    try:
        return rigid_fit(*_triangulated(_sightings(picks, vertices, cameras)))
    except ValueError:
        return None


def _sightings(
    picks: Sequence[Pick], vertices: Array, cameras: Mapping[str, Camera], arch: str = "picked"
) -> list[_Sighting]:
    return [_sighting(k, pick, vertices, cameras, arch) for k, pick in enumerate(picks, start=1)]


def _triangulated(sightings: Sequence[_Sighting]) -> tuple[Array, Array]:
    """Return the picked points in scan coordinates, and triangulated in the world [mm], shape (P, 3) each."""
    places = [triangulate(s.matrices, s.pixels) for s in sightings]
    return np.stack([s.point for s in sightings]), np.stack(places)


def _sighting(number: int, pick: Pick, vertices: Array, cameras: Mapping[str, Camera], arch: str) -> _Sighting:
    where = f"bootstrap: pick {number} on the {arch} teeth"
    if pick.vertex >= len(vertices):
        raise TrackingError(
            f"{where} refers to vertex {pick.vertex}, but the scan has vertices 0 to {len(vertices) - 1}"
        )
    names = [view.camera for view in pick.views]
    if len(set(names)) < 2:
        raise TrackingError(
            f"{where} has a pixel in camera {names[0]} only; its depth is unknown",
            hint="Add a pixel in a second camera.",
        )
    matrices, pixels = [], []
    for view in pick.views:
        if view.camera not in cameras:
            raise TrackingError(f"{where} refers to camera {view.camera}, which is not calibrated")
        camera = cameras[view.camera]
        width, height = camera.size_px
        if not (-0.5 <= view.x <= width - 0.5 and -0.5 <= view.y <= height - 0.5):
            raise TrackingError(
                f"{where} lies at ({view.x:g}, {view.y:g}) px in {view.camera}, outside its {width} x {height} image"
            )
        matrices.append(camera.projection_matrix())
        pixels.append(camera.undistort_pixels([view.x, view.y]))
    return _Sighting(number, vertices[pick.vertex], np.stack(matrices), np.stack(pixels))


def _residuals_px(s: _Sighting, pose: Array) -> tuple[Array, Array, Array]:
    """Return reprojection errors (C, 2), depths (C,), and error derivatives with respect to the point (C, 2, 3)."""
    h = s.matrices @ np.append(transform_point(pose, s.point), 1.0)
    projected = h[:, :2] / h[:, 2:]
    slope = (s.matrices[:, :2, :3] - projected[:, :, None] * s.matrices[:, 2:, :3]) / h[:, 2, None, None]
    return projected - s.pixels, h[:, 2], slope


def _miss_mm(s: _Sighting, pose: Array) -> float:
    """Return the largest reprojection error of a pick over its views, measured at the vertex [mm]."""
    residual, depth, slope = _residuals_px(s, pose)
    if (depth <= 0).any():
        return np.inf
    px_per_mm = np.linalg.norm(slope, axis=(1, 2)) / np.sqrt(2)
    return float((np.linalg.norm(residual, axis=1) / px_per_mm).max())


def _refined(sightings: Sequence[_Sighting], pose: Array) -> Array:
    """Minimise the reprojection error of the picks by Gauss-Newton, starting from a nearby pose."""
    for _ in range(10):
        H, g = np.zeros((6, 6)), np.zeros(6)
        centre = transform_point(pose, np.mean([s.point for s in sightings], axis=0))
        for s in sightings:
            residual, _, slope = _residuals_px(s, pose)
            p = transform_point(pose, s.point) - centre
            slope = slope.reshape(-1, 3)
            J = np.hstack([np.cross(p, slope), slope])
            H += J.T @ J
            g -= J.T @ residual.ravel()
        twist = np.asarray(np.linalg.solve(H, g), np.float64)
        pose = orthonormalise(motion_about(centre, twist) @ pose)
    return pose
