"""Check masks, calibration and time offsets for consistency before tracking.

The mask centre of one camera must lie on the epipolar line of another camera's mask centre. Masks that are swapped
between two cameras start and end at the wrong frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding
from jawusd.geometry import Camera, triangulate

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

    Args:
        ranges: first and last frame with masks, by camera.
        offsets: frame number of the reference camera minus that of the camera at the same time, by camera.
        first, stop: first frame of the take, and one past the last, in frame numbers of the reference camera.
    """

    def fits(source: str, camera: str) -> bool:
        shown = [own for own in ranges[source] if own is not None]
        begin, end = min((own[0] for own in shown), default=stop), max((own[1] for own in shown), default=first)
        return begin + offsets[camera] == first and end + offsets[camera] == stop - 1

    wrong = [name for name in ranges if not fits(name, name)]
    return [(a, b) for a, b in combinations(wrong, 2) if fits(a, b) and fits(b, a)]


def centre_findings(cameras: Mapping[str, Camera], centres: Sequence[Sequence[MaskCentres]]) -> Iterator[Finding]:
    """Yield findings about cameras whose mask centres contradict those of other cameras.

    Args:
        cameras: calibrated cameras by name.
        centres: mask centres in some frames, one entry per candidate time offset; the best candidate is used.

    The camera that is part of the most inconsistent pairs is reported.
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
    yield Finding(
        "cameras_contradict",
        "warning",
        f"its rays through the centre of the teeth miss those of camera {other} by {mm:.0f} mm; a distance "
        f"of at most {_RAYS_MM:g} mm is plausible",
        mm,
        _RAYS_MM,
        camera=worst,
        hint="Check that masks, video and calibration belong to this camera, and check the time offsets.",
    )


def width_findings(cameras: Mapping[str, Camera], pixels: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield findings about masks whose width at the triangulated depth is implausible for teeth.

    Args:
        cameras: calibrated cameras by name.
        pixels: some teeth pixels of one video frame, by camera, shape (N, 2).
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
        yield Finding(
            "teeth_size",
            "warning",
            f"with this calibration, the teeth in the masks are {width:.3g} mm wide; a width of "
            f"{_SEEN_MM[0]:g} to {_SEEN_MM[1]:g} mm is plausible",
            width,
            _SEEN_MM[width > _SEEN_MM[1]],
            hint="Check calibration_unit_mm, the board's square size, and that the masks belong to this calibration.",
        )


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
