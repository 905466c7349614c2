"""Do masks lie where the picks place the scans? Masks that were exchanged are told at once, without drawing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from jawusd.errors import TrackingError
from jawusd.formats.capture import Bootstrap
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, transform_points
from jawusd.geometry.arrays import Array
from jawusd.tracking.contour.scan import ARCH_NAMES, ARCHES, Scan
from jawusd.tracking.initialization.bootstrap import pose_from_picks

_CLOSE_MM = 1.0  # mask pixels this near to a projected crown point count as covered
_ON = 0.85  # share of a camera's masks on the scans, from which they count as placed rightly
_PROOF = 0.5  # an exchange is believed if it leaves less than this share of what is off the scans as masks are named
_POINTS = 6000

#: Some pixels of the masks of both arches at one instant by camera, shape (N, 2) each; N = 0 without a mask.
Pixels = Mapping[str, tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class _Placed:
    """Hold the crowns as one camera sees them."""

    trees: tuple[cKDTree, cKDTree]  # of the pinhole pixels of both arches' crowns
    reach_px: float

    def share(self, pixels: Array, arch: int) -> float:
        """Return which share of undistorted pixels lies on an arch; NaN without pixels."""
        if not len(pixels):
            return float("nan")
        return float(np.mean(self.trees[arch].query(pixels, distance_upper_bound=self.reach_px)[0] < self.reach_px))


def picked_poses(
    bootstrap: Bootstrap, meshes: Sequence[Mesh], cameras: Mapping[str, Camera]
) -> tuple[Array, list[Finding]]:
    """Return T_world_upper and T_world_lower (2, 4, 4) that the picks give, and the picks that do not fit them.

    Raises:
        TrackingError: see `pose_from_picks`.
    """
    poses, findings = [], []
    for mesh, picks, name in zip(meshes, (bootstrap.upper, bootstrap.lower), ARCH_NAMES, strict=True):
        pose, wrong = pose_from_picks(picks, mesh.vertices, cameras, name)
        poses.append(pose)
        for number in wrong:
            findings.append(
                Finding(
                    "pick_wrong",
                    "warning",
                    f"pick {number} on the {name} teeth does not fit the others and is left out",
                    frame=bootstrap.frame,
                    hint="Check its vertex, pixels and camera names.",
                )
            )
    return np.stack(poses), findings


def exchanged_by_picks(
    bootstrap: Bootstrap, meshes: Sequence[Mesh], cameras: Mapping[str, Camera]
) -> tuple[str, str] | None:
    """Return the two cameras with whose calibrations exchanged all picks agree that contradict one another as given."""
    for a, b in combinations(cameras, 2):
        swapped = {**cameras, a: cameras[b], b: cameras[a]}
        try:
            if not picked_poses(bootstrap, meshes, swapped)[1]:
                return a, b
        except TrackingError:
            continue
    return None


def placed_findings(
    scans: Sequence[Scan], poses: Array, cameras: Mapping[str, Camera], guesses: Sequence[Pixels], frame: int
) -> Iterator[Finding]:
    """Compare the masks at the instant of the picks with the scans there.

    Args:
        scans, poses: the scans and T_world_scan (2, 4, 4).
        cameras: calibrated cameras by name.
        guesses: mask pixels of the instant, once per guess of the time offsets; the best one counts for each camera.
        frame: of the picks, for the findings.
    """
    placed = {name: _placed(scans, poses, camera) for name, camera in cameras.items()}

    def best(camera: str, source: str, arches: tuple[int, int] = (0, 1)) -> float:
        """Return how much of the masks of a source lies on the scans as a camera sees them."""
        shares = []
        for guess in guesses:
            if source not in guess:
                continue
            pixels = [_undistorted(cameras[camera], own) for own in guess[source]]
            found = [placed[camera].share(pixels[arch], arches[arch]) for arch in ARCHES]
            if np.isfinite(found).any():
                shares.append(float(np.nanmean(found)))
        return max(shares, default=float("nan"))

    off = {name: 1.0 - best(name, name) for name in cameras}
    odd = [name for name in off if off[name] > 1.0 - _ON]
    turned = [name for name in odd if 1.0 - best(name, name, (1, 0)) < _PROOF * off[name]]
    for name in turned:
        everywhere = " in every camera" if len(turned) == len(cameras) else ""
        yield _error(
            "masks_arches_exchanged",
            f"the masks of the upper and lower teeth are exchanged{everywhere}: {1 - off[name]:.0%} of them lie on "
            f"their scans as the picks place them, {best(name, name, (1, 0)):.0%} on the other one",
            1.0 - off[name],
            name,
            frame,
            "Exchange masks.upper and masks.lower, or upper_teeth and lower_teeth in [scans] and the picks.",
        )
    left = [name for name in odd if name not in turned]
    for a, b in combinations([name for name in off if name not in turned], 2):
        after = 2.0 - best(a, b) - best(b, a)
        if {a, b} & set(left) and after < _PROOF * (off[a] + off[b]):
            yield _error(
                "masks_cameras_exchanged",
                f"its masks and those of camera {b} are exchanged: {1 - off[a]:.0%} of them lie on the scans as the "
                f"picks place them, {best(a, b):.0%} would with those of camera {b}",
                1.0 - off[a],
                a,
                frame,
                f"Exchange the masks of cameras {a} and {b}.",
            )
            left = [name for name in left if name not in (a, b)]
    for name in left:
        yield Finding(
            "masks_off_picks",
            "warning",
            f"{1 - off[name]:.0%} of its masks lie on the scans as the picks place them, {_ON:.0%} or more are usual",
            1.0 - off[name],
            _ON,
            camera=name,
            frame=frame,
            hint="Check picks, masks, calibration and time offsets of this camera.",
        )


def _error(kind: str, message: str, value: float, camera: str, frame: int, hint: str) -> Finding:
    return Finding(kind, "error", message, value, _ON, camera=camera, frame=frame, hint=hint)


def _undistorted(camera: Camera, pixels: Array) -> Array:
    return camera.undistort_pixels(pixels) if len(pixels) else pixels


def _placed(scans: Sequence[Scan], poses: Array, camera: Camera) -> _Placed:
    trees, depths = [], []
    for scan, pose in zip(scans, poses, strict=True):
        crowns = transform_points(pose, scan.crown_vertices(_POINTS))
        trees.append(cKDTree(camera.project_pinhole(crowns)))
        depths.append(float(camera.depth(crowns.mean(0))))
    return _Placed((trees[0], trees[1]), _CLOSE_MM * float(camera.K[0, 0]) / max(float(np.mean(depths)), 1.0))
