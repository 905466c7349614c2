"""Check masks before tracking."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.finding import Finding
from jawusd.geometry import Camera, triangulate

#: First and last frame with a mask of the upper and of the lower teeth, in a camera's own numbers; None without any.
Ranges = tuple[tuple[int, int] | None, tuple[int, int] | None]
#: The middle of all teeth pixels of one instant by camera [px], shape (2,).
Middles = Mapping[str, Array]

# Distance of the two rays through the middles of the masks: what shows of the teeth differs between views [mm].
# Valid synthetic persons: 10.4 mm at most of 70, 8.3 mm the next.
_RAYS_MM = 15.0
# Width of what the masks show of both rows at the depth where the rays meet; lips hide much, no mouth shows more [mm].
_SEEN_MM = (10.0, 90.0)


def exchanged_by_frames(
    ranges: Mapping[str, Ranges], offsets: Mapping[str, int], first: int, stop: int
) -> list[tuple[str, str]]:
    """Return pairs of cameras whose masks begin and end with the take only if they are exchanged.

    Args:
        ranges: frames with masks, by camera.
        offsets: reference frame minus own frame number, by camera.
        first, stop: first frame of the take and one past its last, of the reference camera.
    """

    def fits(source: str, camera: str) -> bool:
        shown = [own for own in ranges[source] if own is not None]
        begin, end = min((own[0] for own in shown), default=stop), max((own[1] for own in shown), default=first)
        return begin + offsets[camera] == first and end + offsets[camera] == stop - 1

    wrong = [name for name in ranges if not fits(name, name)]
    return [(a, b) for a, b in combinations(wrong, 2) if fits(a, b) and fits(b, a)]


def middles_findings(cameras: Mapping[str, Camera], middles: Sequence[Sequence[Middles]]) -> Iterator[Finding]:
    """Compare where the cameras see the middle of the teeth.

    Args:
        cameras: calibrated cameras by name.
        middles: of some instants; each as often as there are guesses of the offsets, of which the best one counts.

    A pair of cameras that fits nowhere is named; the camera that is in most of such pairs is accused.
    """
    apart: dict[tuple[str, str], float] = {}
    for pair in combinations(cameras, 2):
        distances = []
        for guesses in middles:
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
        f"its rays through the middle of the teeth pass those of camera {other} at {mm:.0f} mm, up to {_RAYS_MM:g} mm "
        "are possible",
        mm,
        _RAYS_MM,
        camera=worst,
        hint="Check that masks, video and calibration are those of this camera, and the time offsets.",
    )


def seen_findings(cameras: Mapping[str, Camera], pixels: Mapping[str, Array]) -> Iterator[Finding]:
    """Compare the width of what masks show with that of teeth, at the depth that two cameras give.

    Args:
        cameras: calibrated cameras by name.
        pixels: some teeth pixels by camera at one instant, shape (N, 2).
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
            f"the masks show teeth {width:.3g} mm wide by this calibration, {_SEEN_MM[0]:g} to {_SEEN_MM[1]:g} mm are "
            "possible",
            width,
            _SEEN_MM[width > _SEEN_MM[1]],
            hint="Check calibration_unit_mm, the size of the board's squares, and that the masks belong to it.",
        )


def _rays_mm(cameras: Mapping[str, Camera], pair: tuple[str, str], found: Mapping[str, Array]) -> float:
    """Return the distance of the rays through two cameras' middles [mm]."""
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
