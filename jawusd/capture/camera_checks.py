"""Check whether calibration, masks and time offsets are plausible and consistent, before tracking.

The mask centre of one camera must lie on the epipolar line of another camera's mask centre. Masks that are swapped
between two cameras start and end at the wrong frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding, Severity
from jawusd.geometry import Camera, triangulate

# Plausible range of the ratio of focal length to image width; fields of view from 100 down to 3 degrees.
_FOCAL_WIDTHS = (0.4, 20.0)
_SQUARE = 0.03  # maximum relative difference between fx and fy; current cameras have square pixels
_CENTRE_SHARE = 0.15  # maximum offset of the principal point from the image centre, relative to the image width
_LEAST_BASELINE_MM, _MOST_BASELINE_MM = 10.0, 5000.0
_LEAST_ANGLE_DEG = 3.0  # minimum angle between two viewing directions; smaller angles determine depth poorly
_NEAREST_MM, _FARTHEST_MM = 40.0, 5000.0


def camera_findings(cameras: Sequence[Camera], path: str) -> Iterator[Finding]:
    """Yield findings about calibrated cameras, with lengths in mm; `path` is the calibration file."""
    for camera in cameras:
        yield from _lens_findings(camera, path)
    if len(cameras) < 2:
        return
    pairs = list(combinations(cameras, 2))
    baselines = [float(np.linalg.norm(a.centre_world() - b.centre_world())) for a, b in pairs]
    for (a, b), baseline in zip(pairs, baselines, strict=True):
        if not _LEAST_BASELINE_MM <= baseline <= _MOST_BASELINE_MM:
            kind = "cameras_together" if baseline < _LEAST_BASELINE_MM else "cameras_far_apart"
            severity: Severity = "error" if max(baselines) < _LEAST_BASELINE_MM else "warning"
            message = f"this camera is {baseline:.4g} mm away from camera {a.name}; the usual range is "
            message += f"{_LEAST_BASELINE_MM:g} to {_MOST_BASELINE_MM:g} mm."
            message += " Is the calibration in metres?" if severity == "error" else ""
            hint = "Set calibration_unit_mm to the length unit of the file, or calibrate again."
            yield Finding(kind, severity, message, baseline, _LEAST_BASELINE_MM, path=path, camera=b.name, hint=hint)
    if max(baselines) >= _LEAST_BASELINE_MM:
        yield from _aim_findings(cameras, path)


def _lens_findings(camera: Camera, path: str) -> Iterator[Finding]:
    def warning(kind: str, message: str, value: float, limit: float) -> Finding:
        hint = "Check the calibration of this camera."
        return Finding(kind, "warning", message, value, limit, path=path, camera=camera.name, hint=hint)

    width, height = camera.size_px
    focal = float(camera.K[0, 0] / width)
    if not _FOCAL_WIDTHS[0] <= focal <= _FOCAL_WIDTHS[1]:
        low, high = _FOCAL_WIDTHS
        message = f"its focal length is {focal:.3g} image widths; the usual range is {low:g} to {high:g}"
        yield warning("focal_length", message, focal, high if focal > high else low)
    uneven = float(abs(camera.K[1, 1] / camera.K[0, 0] - 1.0))
    if uneven > _SQUARE:
        message = f"its focal lengths fx and fy differ by {uneven:.1%}; a difference of at most {_SQUARE:.0%} is usual"
        yield warning("pixels_not_square", message, uneven, _SQUARE)
    middle = np.array([width - 1, height - 1]) / 2
    off = float(np.abs(camera.K[:2, 2] - middle).max() / width)
    if off > _CENTRE_SHARE:
        message = f"its principal point is {off:.0%} of the image width off the centre; an offset of at most "
        yield warning("principal_point", message + f"{_CENTRE_SHARE:.0%} is usual", off, _CENTRE_SHARE)
    if (worst := _fold(camera)) is not None:
        message = f"its distortion folds over at {worst:.0%} of the way to the corner: it is not invertible there"
        yield warning("distortion_folds", message, worst, 1.0)


def _fold(camera: Camera) -> float | None:
    """Return the radius where distortion folds over, relative to that of the image corner; None if it does not."""
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], np.float64)
    centre = camera.K[:2, 2]
    share = np.linspace(0.0, 1.0, 101)[:, None]
    folds = []
    for corner in corners:
        # Barrel distortion increases the undistorted radius of the corner, hence the factor 1.5.
        seen = camera.distort_pixels(centre + 1.5 * share * (corner - centre))
        reach = np.linalg.norm(seen - centre, axis=1)
        turned = np.flatnonzero(np.diff(reach) < 0)
        if len(turned) and reach[turned[0]] < np.linalg.norm(corner - centre):
            folds.append(reach[turned[0]] / np.linalg.norm(corner - centre))
    return float(min(folds)) if folds else None


def _aim_findings(cameras: Sequence[Camera], path: str) -> Iterator[Finding]:
    """Yield findings about cameras that do not point at the common target of all cameras."""
    target = common_target(cameras)
    for camera in cameras:
        depth = float(camera.depth(target))
        if not _NEAREST_MM <= depth <= _FARTHEST_MM:
            message = f"the common target of the cameras is {depth:.0f} mm in front of this camera; the usual range is "
            message += f"{_NEAREST_MM:g} to {_FARTHEST_MM:g} mm"
            hint = "Check the pose of this camera in the calibration, and calibration_unit_mm."
            yield Finding(
                "camera_aim", "warning", message, depth, _NEAREST_MM, path=path, camera=camera.name, hint=hint
            )
    views = [(target - camera.centre_world()) / np.linalg.norm(target - camera.centre_world()) for camera in cameras]
    angles = [float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0)))) for a, b in combinations(views, 2)]
    if max(angles) < _LEAST_ANGLE_DEG:
        message = f"all viewing directions lie within {max(angles):.1f} degrees; expected at least "
        message += f"{_LEAST_ANGLE_DEG:g} degrees"
        hint = "Check the calibration, or place the cameras farther apart."
        yield Finding("views_alike", "warning", message, max(angles), _LEAST_ANGLE_DEG, path=path, hint=hint)


def common_target(cameras: Sequence[Camera]) -> Array:
    """Return the point that is closest to the optical axes of all cameras [mm], shape (3,)."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        axis = camera.T_cam_world[2, :3]
        across = np.eye(3) - np.outer(axis, axis)
        A += across
        b += across @ camera.centre_world()
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])


#: First and last frame number with masks in a camera, for upper and lower teeth; None if there are no masks.
Ranges = tuple[tuple[int, int] | None, tuple[int, int] | None]
#: Centre [px] of the teeth pixels of one video frame, shape (2,), by camera.
MaskCentres = Mapping[str, Array]

# Maximum distance [mm] between the rays through the mask centres of two cameras. The rays do not meet exactly, since
# the visible part of the teeth differs between views; in 70 valid synthetic captures the distance was at most 10.4 mm.
_RAYS_MM = 15.0
# Plausible range of the width [mm] of the masked teeth at the triangulated depth; lips may hide many teeth.
_SEEN_MM = (10.0, 90.0)


def swapped_cameras(
    ranges: Mapping[str, Ranges], offsets: Mapping[str, int], first: int, stop: int
) -> list[tuple[str, str]]:
    """Return pairs of cameras whose masks start and end with the take only if they are swapped.

    Offsets by camera are frame numbers of the reference camera, in which the take is given, minus those of the camera.
    """

    def fits(source: str, camera: str) -> bool:
        shown = [own for own in ranges[source] if own is not None]
        begin, end = min((own[0] for own in shown), default=stop), max((own[1] for own in shown), default=first)
        return begin + offsets[camera] == first and end + offsets[camera] == stop - 1

    wrong = [name for name in ranges if not fits(name, name)]
    return [(a, b) for a, b in combinations(wrong, 2) if fits(a, b) and fits(b, a)]


def centre_findings(cameras: Mapping[str, Camera], centres: Sequence[Sequence[MaskCentres]]) -> Iterator[Finding]:
    """Yield a finding about the camera whose mask centres contradict those of the most other cameras.

    `centres` has the mask centres in some frames, one entry per candidate time offset; the best candidate is used.
    """
    apart: dict[tuple[str, str], float] = {}
    for pair in combinations(cameras, 2):
        distances = []
        for guesses in centres:
            seen = [found for found in guesses if all(name in found for name in pair)]
            distances += [min(_rays_mm(cameras, pair, found) for found in seen)] if seen else []
        if distances:
            apart[pair] = float(np.median(distances))
    wrong = {pair: mm for pair, mm in apart.items() if mm > _RAYS_MM}
    if not wrong:
        return
    blame = {name: sum(name in pair for pair in wrong) for name in cameras}
    worst = max(blame, key=lambda name: (blame[name], sum(mm for pair, mm in wrong.items() if name in pair)))
    pair, mm = max(((p, mm) for p, mm in wrong.items() if worst in p), key=lambda item: item[1])
    other = pair[0] if pair[1] == worst else pair[1]
    message = f"its rays through the centre of the teeth miss those of camera {other} by {mm:.0f} mm; a distance "
    message += f"of at most {_RAYS_MM:g} mm is plausible"
    hint = "Check that masks, video and calibration belong to this camera, and check the time offsets."
    yield Finding("cameras_contradict", "warning", message, mm, _RAYS_MM, camera=worst, hint=hint)


def width_findings(cameras: Mapping[str, Camera], pixels: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield findings about masks whose width at the triangulated depth is implausible for teeth.

    `pixels` (N, 2) has some teeth pixels of one video frame by camera.
    """
    seen = {name: camera for name, camera in cameras.items() if len(pixels.get(name, ()))}
    if len(seen) < 2:
        return
    place = triangulate(
        np.stack([camera.projection_matrix() for camera in seen.values()]),
        np.stack([camera.undistort_pixels(pixels[name].mean(0)) for name, camera in seen.items()]),
    )
    widths = []
    for name, camera in seen.items():
        low, high = np.percentile(pixels[name], [1, 99], axis=0)
        widths.append(float(np.linalg.norm(high - low) * camera.depth(place) / camera.K[0, 0]))
    width = float(np.median(widths))
    if not _SEEN_MM[0] <= width <= _SEEN_MM[1]:
        message = f"with this calibration, the teeth in the masks are {width:.3g} mm wide; a width of "
        message += f"{_SEEN_MM[0]:g} to {_SEEN_MM[1]:g} mm is plausible"
        hint = "Check calibration_unit_mm, the board's square size, and that the masks belong to this calibration."
        yield Finding("teeth_size", "warning", message, width, _SEEN_MM[width > _SEEN_MM[1]], hint=hint)


def _rays_mm(cameras: Mapping[str, Camera], pair: tuple[str, str], found: Mapping[str, Array]) -> float:
    """Return the distance between the rays through two cameras' mask centres [mm]."""
    starts, rays = [], []
    for name in pair:
        camera = cameras[name]
        ray = (
            np.linalg.solve(camera.K, np.append(camera.undistort_pixels(found[name]), 1.0)) @ camera.T_cam_world[:3, :3]
        )
        starts.append(camera.centre_world())
        rays.append(ray / np.linalg.norm(ray))
    normal = np.cross(rays[0], rays[1])
    length = float(np.linalg.norm(normal))
    between = starts[1] - starts[0]
    if length < 1e-6:
        return float(np.linalg.norm(np.cross(between, rays[0])))
    return float(abs(between @ normal) / length)
