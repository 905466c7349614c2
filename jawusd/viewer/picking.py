"""The picks of one visitor, and the layout of the image and scans in which they are set.

The layout frame has x to the right, y down and z away from the camera, in mm. The image lies in z = 0, centred on the
origin, and is scaled so that its teeth are about as large as the scans.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array
from jawusd.formats.capture import Bootstrap, Pick, PickView
from jawusd.formats.mesh import Mesh
from jawusd.geometry import make_transform, so3_exp, transform_point, transform_points
from jawusd.geometry.points import meet_triangles
from jawusd.geometry.se3 import se3_inverse
from jawusd.viewer.viewed import Region

ARCHES = ("upper", "lower")
_FEWEST, _FEWEST_VIEWS = 3, 2  # minimum number of picks per arch, and of views per pick
FOV_RAD = 0.35
#: Rotation of the scans about the subject's vertical and transverse axis [deg], by the side that faces the viewer.
SIDES = {"front": (0.0, 0.0), "left": (-60.0, 0.0), "right": (60.0, 0.0), "biting side": (0.0, 65.0)}
_TEETH_MM = 60.0  # width of the region around the teeth in the layout
_GAP_MM = 5.0
_EDGE = 1e-9  # tolerance of barycentric coordinates, so that rays cannot pass between adjacent faces
_MARGIN = 1.05


@dataclass
class PickDraft:
    """A possibly incomplete pick: a vertex of an arch's scan, and its pixel (x, y) in each camera."""

    arch: str
    vertex: int
    views: dict[str, tuple[float, float]] = field(default_factory=dict)


class PickBook:
    """The picks of one frame, in the order they were made.

    `frame` is the frame of the reference camera to which all pixels belong, None before the first pixel. The next click
    sets a pixel of the pick with the index `selected`, None without picks.
    """

    def __init__(self, given: Bootstrap | None = None) -> None:
        self.picks: list[PickDraft] = []
        self.frame: int | None = None
        self.selected: int | None = None
        if given is not None:
            self.frame = given.frame
            for arch in ARCHES:
                for pick in getattr(given, arch):
                    self.picks.append(PickDraft(arch, pick.vertex, {v.camera: (v.x, v.y) for v in pick.views}))

    def name(self, number: int) -> str:
        """Return the name of a pick: U1, U2, ... (upper arch) or L1, L2, ... (lower arch), numbered as in tracking."""
        arch = self.picks[number].arch
        return f"{arch[0].upper()}{sum(pick.arch == arch for pick in self.picks[: number + 1])}"

    def add(self, arch: str, vertex: int) -> None:
        """Select the pick at a vertex, adding it if necessary."""
        same = [k for k, pick in enumerate(self.picks) if (pick.arch, pick.vertex) == (arch, vertex)]
        if not same:
            self.picks.append(PickDraft(arch, vertex))
        self.selected = same[0] if same else len(self.picks) - 1

    def see(self, camera: str, frame: int, pixel: tuple[float, float]) -> None:
        """Set the selected pick's pixel (x, y) in a camera, and select the next pick without a pixel in that camera.

        Raises ValueError if no pick is selected, or if the other picks belong to another frame.
        """
        if self.selected is None:
            raise ValueError("no pick is selected: click a vertex of a scan first, or select a pick in the list")
        others = any(pick.views for k, pick in enumerate(self.picks) if k != self.selected)
        if self.frame is not None and frame != self.frame and others:
            raise ValueError(
                f'the picks belong to frame {self.frame}, not {frame}: press "show their frame", or remove all'
            )
        pick = self.picks[self.selected]
        if frame != self.frame:
            pick.views.clear()
        self.frame = frame
        pick.views[camera] = pixel
        rest = [*range(self.selected + 1, len(self.picks)), *range(self.selected)]
        self.selected = next((k for k in rest if camera not in self.picks[k].views), self.selected)

    def select_incomplete(self, camera: str) -> None:
        """Select the first pick without a pixel in a camera, if any."""
        self.selected = next((k for k, pick in enumerate(self.picks) if camera not in pick.views), self.selected)

    def remove_pixel(self, camera: str) -> None:
        """Remove the selected pick's pixel in a camera."""
        if self.selected is not None:
            self.picks[self.selected].views.pop(camera, None)

    def remove(self) -> None:
        """Delete the selected pick."""
        if self.selected is None:
            return
        del self.picks[self.selected]
        self.selected = min(self.selected, len(self.picks) - 1) if self.picks else None
        if not any(pick.views for pick in self.picks):
            self.frame = None

    def clear(self) -> None:
        """Delete all picks."""
        self.picks, self.frame, self.selected = [], None, None

    def missing(self) -> str:
        """Return what must be added before the picks can be written; "" if they are complete."""
        for arch in ARCHES:
            whole = sum(len(pick.views) >= _FEWEST_VIEWS for pick in self.picks if pick.arch == arch)
            if whole < _FEWEST:
                return f"{arch} teeth: {whole} picks are set in {_FEWEST_VIEWS} cameras; at least {_FEWEST} are needed"
        for number, pick in enumerate(self.picks):
            if len(pick.views) < _FEWEST_VIEWS:
                return f"{self.name(number)} has pixels in {len(pick.views)} cameras; {_FEWEST_VIEWS} are needed"
        return ""

    def bootstrap(self) -> Bootstrap:
        """Return the picks in the form of the capture file; raises ValueError if they are incomplete."""
        lacking = self.missing()
        if lacking or self.frame is None:
            raise ValueError(f"the picks are incomplete: {lacking}")
        upper, lower = (tuple(_finished(pick) for pick in self.picks if pick.arch == arch) for arch in ARCHES)
        return Bootstrap(frame=self.frame, upper=upper, lower=lower)


def _finished(pick: PickDraft) -> Pick:
    views = tuple(PickView(camera=name, x=round(x, 2), y=round(y, 2)) for name, (x, y) in pick.views.items())
    return Pick(vertex=pick.vertex, views=views)


@dataclass(frozen=True)
class PickingLayout:
    """Layout of the scans and an image of a given size [px], a region of which is in view."""

    size_px: tuple[int, int]
    region: Region

    @property
    def px_per_mm(self) -> float:
        """Return the number of image pixels per mm of the layout."""
        return max(self.region[2] - self.region[0], 1.0) / _TEETH_MM

    def place(self, pixel: ArrayLike) -> Array:
        """Return the positions of pixels (..., 2) in the layout [mm], shape (..., 3)."""
        middle = (np.array(self.size_px) - 1) / 2
        flat = (np.asarray(pixel, dtype=np.float64) - middle) / self.px_per_mm
        return np.concatenate([flat, np.zeros((*flat.shape[:-1], 1))], axis=-1)

    def pixel(self, origin: ArrayLike, direction: ArrayLike) -> tuple[float, float] | None:
        """Return the pixel where a ray, origin and direction (3,), hits the image; None outside it."""
        o, d = np.asarray(origin, dtype=np.float64), np.asarray(direction, dtype=np.float64)
        if abs(d[2]) < 1e-9 or -o[2] / d[2] <= 0:
            return None
        x, y = (o - d * (o[2] / d[2]))[:2] * self.px_per_mm + (np.array(self.size_px) - 1) / 2
        width, height = self.size_px
        return (float(x), float(y)) if -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5 else None

    def scan_poses(self, scans: Mapping[str, Mesh], T_anatomical_skull: Array, side: str) -> dict[str, Array]:
        """Return T_layout_scan (4, 4) by arch: in front of the image, below the region, `side` facing the viewer."""
        top = float(self.place([self.region[0], self.region[3]])[1]) + _GAP_MM
        middle = float(self.place([(self.region[0] + self.region[2]) / 2, 0.0])[0])
        found = {}
        for arch in ARCHES:
            yaw, pitch = np.radians(SIDES[side])
            pitch = pitch if arch == "lower" else -pitch
            R = np.diag([1.0, -1.0, -1.0]) @ so3_exp([0.0, yaw, 0.0]) @ so3_exp([pitch, 0.0, 0.0])
            facing = make_transform(R, np.zeros(3)) @ T_anatomical_skull
            placed = transform_points(facing, scans[arch].vertices)
            low, high = placed.min(axis=0), placed.max(axis=0)
            move = np.array([middle - (low[0] + high[0]) / 2, top - low[1], -high[2] - _GAP_MM])
            found[arch] = make_transform(np.eye(3), move) @ facing
            top += float(high[1] - low[1]) + _GAP_MM
        return found

    def corners(self) -> Array:
        """Return two opposite corners of the region in the layout [mm], shape (2, 3)."""
        return self.place(np.reshape(self.region, (2, 2)))


def fit_view(points: ArrayLike, away: ArrayLike, up: ArrayLike, aspect: float) -> tuple[Array, Array]:
    """Return the nearest camera position (3,) from which all points (n, 3) are visible, and its target (3,).

    `away` (3,) points from the target to the camera, `up` (3,) is the approximate up direction on the screen, and
    `aspect` its width over its height.
    """
    p = np.asarray(points, dtype=np.float64)
    back = np.asarray(away, dtype=np.float64) / np.linalg.norm(away)
    right = np.cross(np.asarray(up, dtype=np.float64), back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(back, right), back])
    q = p @ axes.T
    middle = (q.min(axis=0) + q.max(axis=0)) / 2
    reach = np.abs(q - middle)[:, :2] * _MARGIN / np.tan(FOV_RAD / 2) / [aspect, 1.0]
    distance = float((reach.max(axis=1) + q[:, 2] - middle[2]).max())
    target = middle @ axes
    return target + distance * back, target


def region_around(points_px: ArrayLike, size_px: tuple[int, int]) -> Region:
    """Return the part of an image around points (n, 2) [px], padded and clipped to the image."""
    points = np.asarray(points_px, dtype=np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    pad = np.maximum(0.18 * (high - low), 0.03 * size_px[0])
    low = np.clip(low - pad, 0, np.array(size_px) - 2)
    high = np.clip(high + pad, low + 1, np.array(size_px) - 1)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def hit_vertex(mesh: Mesh, T_world_scan: Array, origin: ArrayLike, direction: ArrayLike) -> tuple[int, float] | None:
    """Return the vertex nearest to where a world ray hits a posed scan, and its distance [mm]; None without a hit."""
    inverse = se3_inverse(T_world_scan)
    o = transform_point(inverse, np.asarray(origin, dtype=np.float64))
    d = inverse[:3, :3] @ np.asarray(direction, dtype=np.float64)
    d = d / np.linalg.norm(d)
    u, v, along = meet_triangles(o, d, mesh.vertices[mesh.faces])
    met = np.flatnonzero((u >= -_EDGE) & (v >= -_EDGE) & (u + v <= 1 + _EDGE) & (along > 0))
    if not len(met):
        return None
    face = met[along[met].argmin()]
    corners = mesh.faces[face]
    distance = float(along[face])
    nearest = np.linalg.norm(mesh.vertices[corners] - (o + distance * d), axis=1).argmin()
    return int(corners[nearest]), distance
