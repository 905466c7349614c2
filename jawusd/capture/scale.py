"""Check the board's square size against the teeth, by picked vertices of the scan or by masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.formats.capture import Bootstrap
from jawusd.geometry import Camera, triangulate

_FEWEST_PICKS = 3  # per jaw
_TOLERANCE = 0.03  # picks give the scale to about half a per cent
_SIGMAS = 4.0


@dataclass(frozen=True)
class ScaleCheck:
    """Compare the size of the teeth as the cameras see them with the scan."""

    ratio: float | None  # seen / scanned, None if unknown
    sigma: float | None  # its standard error
    reason: str = ""  # why it is unknown, else ""


def triangulated_picks(
    cameras: list[Camera], bootstrap: Bootstrap | None
) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Return per jaw the picked vertices (n,) and where the cameras see them [mm], shape (n, 3)."""
    known = {camera.name: camera for camera in cameras}
    out = {}
    for jaw in ("upper", "lower"):
        vertices, points = [], []
        for pick in getattr(bootstrap, jaw) if bootstrap else ():
            views = [(known[view.camera], [view.x, view.y]) for view in pick.views if view.camera in known]
            if len({camera.name for camera, _ in views}) >= 2:
                projections = [camera.projection_matrix() for camera, _ in views]
                vertices.append(pick.vertex)
                points.append(triangulate(projections, [camera.undistort_pixels(px) for camera, px in views]))
        if points:
            out[jaw] = np.array(vertices), np.array(points)
    return out


def check_scale(
    cameras: list[Camera], bootstrap: Bootstrap | None, scans: Mapping[str, Array], square_mm: float
) -> ScaleCheck:
    """Compare the spread of the picks in space with that on the scans (Umeyama 1991).

    Args:
        scans: vertices [mm] by "upper" and "lower", shape (n, 3).

    Raises:
        CalibrationError: the teeth come out with another size than the scan's.
    """
    squares, weights, residuals = [], [], []
    for jaw, (vertices, points) in triangulated_picks(cameras, bootstrap).items():
        if len(points) < _FEWEST_PICKS or jaw not in scans or vertices.max() >= len(scans[jaw]):
            continue
        scan = scans[jaw][vertices]
        a, b = scan - scan.mean(0), points - points.mean(0)
        U, S, Vt = np.linalg.svd(b.T @ a)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
        spread = float((a * a).sum())
        weights.append(spread)
        squares.append(float((S * sign).sum()) / spread)
        residuals.append((b - squares[-1] * a @ (Vt.T * sign) @ U.T).ravel())
    if not squares:
        return ScaleCheck(None, None, "there are no picks in two cameras to compare with the scans")
    ratio = float(np.average(squares, weights=weights))
    off = np.concatenate(residuals)
    freedom = max(1, len(off) - 7 * len(squares))
    sigma = float(np.sqrt((off @ off) / freedom / sum(weights)))
    return judged_scale(ratio, sigma, square_mm)


def judged_scale(ratio: float, sigma: float, square_mm: float) -> ScaleCheck:
    """Return a measured size of the teeth (seen / scanned) if it confirms the squares or is too uncertain to tell.

    Raises:
        CalibrationError: the teeth come out with another size than the scan's.
    """
    if abs(ratio - 1) > max(_TOLERANCE, _SIGMAS * sigma):
        raise CalibrationError(
            f"seen with these boards the teeth are {ratio:.3f} times as large as their scan (+-{sigma:.3f}): squares "
            f"of {square_mm:g} mm would have to be {square_mm / ratio:.2f} mm.",
            hint="Measure the printed board and correct [boards] square_mm; or the picks or the scan's unit are wrong.",
        )
    if _SIGMAS * sigma > 3 * _TOLERANCE:
        return ScaleCheck(None, None, f"the picks scatter too much to check it (+-{sigma:.1%})")
    return ScaleCheck(ratio, sigma)
