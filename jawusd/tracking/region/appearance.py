"""Appearance of the teeth in every camera, learned while tracking, and views that use it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.ndimage import distance_transform_edt

from jawusd.base.arrays import Array
from jawusd.geometry import Camera
from jawusd.media.working_view import shrunk
from jawusd.tracking.contour.rendering import Rendering
from jawusd.tracking.contour.scan import ARCHES, CROWN, GUM, Scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.colours import PATCHES, Areas, CameraColours, colour_bins
from jawusd.tracking.region.view import Counts, RegionView

# Distances that define the training areas of the initial colours [px]: minimum distance inside crowns, minimum and
# maximum distance outside them, and minimum distance of the background from all teeth.
_INSIDE_PX, _OUTSIDE_PX, _RING_PX, _BEYOND_PX = 2.0, 3.0, 30.0, 4.0

#: Learning rates of tooth and background colours [-], in general and in the first frame.
RATES, FIRST_RATES = (0.1, 0.2), (0.5, 0.5)
_GUM_RATE, _MOST_GUM_PX = 0.1, 2.0  # learning rate [-] and maximum [px] of the gum-line offset
#: Correlation length of border errors along the contour [px]: lips and shadows affect whole teeth.
CORRELATION_PX = 110.0
#: Resolution of the images in a search, as a fraction of the usual one [-].
COARSE = 0.5


class Picture(NamedTuple):
    """Part of an undistorted image around the teeth."""

    camera: Camera  # pinhole camera of this part of the image
    rgb: NDArray[np.uint8]  # 8-bit pixels, shape (h, w, 3)

    def coarse(self) -> Picture:
        """Return the image at the resolution of a search."""
        height, width = (max(1, int(COARSE * side)) for side in self.rgb.shape[:2])
        return Picture(self.camera.scaled((width, height)), shrunk(self.rgb, (width, height)))


#: Function that returns the images of a frame, one per camera (None without image), cropped around the teeth at
#: T_world_upper and T_world_lower, shape (2, 4, 4).
Cut = Callable[[Array], Sequence[Picture | None]]


def first_colours(picture: Picture, poses: Array, scans: Sequence[Scan]) -> CameraColours:
    """Learn tooth colours from an image with known poses T_world_upper and T_world_lower, shape (2, 4, 4)."""
    shape = picture.rgb.shape[:2]
    labels = np.zeros((2, *shape), np.uint8)
    for r in ARCHES:
        matrix = picture.camera.projection_matrix() @ poses[r]
        scans[r].draw(matrix, np.zeros(shape, np.float32), labels[r])
    crowns, gum = (labels == CROWN).any(0), (labels == GUM).any(0)
    to_crown, to_any = (distance_transform_edt(~area) for area in (crowns, crowns | gum))
    inside = distance_transform_edt(crowns) > _INSIDE_PX
    outside = to_crown > _OUTSIDE_PX
    near = outside & (to_crown < _RING_PX)
    return CameraColours(colour_bins(picture.rgb), Areas(inside, near, near & gum, to_any > _BEYOND_PX))


class LearnedColours:
    """Colour models of all cameras, and offsets between observed gum lines and those of the scans."""

    def __init__(self, scans: Sequence[Scan], cameras: Sequence[Camera], axes: Array) -> None:
        """Start without learned colours; `axes` is the rotation from scan to left, up and front axes, (3, 3)."""
        self._scans, self._cameras, self.axes = tuple(scans), tuple(cameras), axes
        # The clustering is seeded, so that the same scans give the same patches.
        crowns = [scan.crown_vertices(3000) @ axes.T[:, [0, 2]] for scan in scans]
        self._patches = np.stack([kmeans2(points, PATCHES, seed=1, minit="++")[0] for points in crowns])
        self._colours: list[CameraColours | None] = [None] * len(cameras)
        self._gum_px = np.zeros((2, len(cameras)))

    def copy(self) -> LearnedColours:
        """Return a copy whose colours are learned independently."""
        out = copy(self)
        out._colours, out._gum_px = deepcopy(self._colours), self._gum_px.copy()
        return out

    def begin(self, pictures: Sequence[Picture | None], poses: Array) -> None:
        """Initialise the colours from a frame with poses T_world_upper and T_world_lower, shape (2, 4, 4)."""
        self._colours = [None if p is None else first_colours(p, poses, self._scans) for p in pictures]

    def views(self, pictures: Sequence[Picture | None], before: Array) -> list[View]:
        """Return the views of a frame, given its images and the poses in the frame `before`, shape (2, 4, 4)."""
        out = []
        for c, picture in enumerate(pictures):
            colours = self._colours[c]
            if picture is None or colours is None:
                camera, shape = self._cameras[c], (1, 1)
                edges = None
            else:
                camera, shape = picture.camera, picture.rgb.shape[:2]
                matrix = camera.projection_matrix()
                earlier = np.stack([matrix @ pose for pose in before])
                bins = colour_bins(picture.rgb)
                edges = RegionView(picture.rgb, bins, colours.ratio, self._patches, self.axes, earlier)
            habits = np.zeros((2, 3))
            habits[:, 1] = self._gum_px[:, c]
            empty, present = np.zeros((2, *shape), np.uint8), np.full(2, edges is not None)
            view = View(camera.projection_matrix(), camera.centre_world(), empty, present, habits=habits, edges=edges)
            out.append(view)
        return out

    def coarse_views(self, pictures: Sequence[Picture | None], before: Array) -> list[View]:
        """Return the views of a video frame at the resolution of a search; the arguments are those of `views`."""
        reduced = [None if picture is None else picture.coarse() for picture in pictures]
        return [replace(view, habits=view.habits * [COARSE, COARSE, 1.0]) for view in self.views(reduced, before)]

    def counting(self, views: Sequence[View]) -> list[View]:
        """Return the views with empty counts, which collect the colours on both sides of borders for `learn`."""
        return [
            replace(view, edges=replace(view.edges, counts=Counts.zeros()))
            if isinstance(view.edges, RegionView)
            else view
            for view in views
        ]

    def learn(
        self, views: Sequence[View], pictures: Sequence[Picture | None], poses: Array, rates: tuple[float, float]
    ) -> None:
        """Update the colour models with the colours on both sides of matched borders, and update the gum-line offset.

        The views of the images have the colour counts of one alignment; rates of tooth and background are 0 .. 1.
        """
        for c, view in enumerate(views):
            colours = self._colours[c]
            picture = pictures[c]
            if picture is not None and colours is None:  # this is the first image of the camera
                self._colours[c] = first_colours(picture, poses, self._scans)
            if not isinstance(view.edges, RegionView) or view.edges.counts is None or colours is None:
                continue
            counts = view.edges.counts
            colours.learn(counts.tooth, counts.outside, rates)
            known = np.isfinite(counts.gum_px)
            step = _GUM_RATE * (counts.gum_px[known] - self._gum_px[known, c])
            self._gum_px[known, c] = np.clip(self._gum_px[known, c] + step, -_MOST_GUM_PX, _MOST_GUM_PX)


class InstantViews:
    """Images of one frame: their views, and the rendering shared by all alignments of that frame.

    Attributes:
        views, rendering: views of the images, and the rendering of thinned scans in them.
        counting: the same views for refined alignments, which count the colours beside borders for `learn`.
    """

    def __init__(
        self,
        colours: LearnedColours,
        pictures: Sequence[Picture | None],
        before: Array,
        solvers: tuple[ContourSolver, ContourSolver],
    ) -> None:
        """Prepare the views for solvers with thinned and with coarse scans; see `LearnedColours.views`."""
        self._colours, self._pictures, self._before, (thin, self._coarse) = colours, pictures, before, solvers
        self.views = colours.views(pictures, before)
        self.counting, self.rendering = colours.counting(self.views), thin.rendering(self.views)

    @cached_property
    def coarse(self) -> tuple[Sequence[View], Rendering]:
        """The views and their rendering at the resolution of a search."""
        views = self._colours.coarse_views(self._pictures, self._before)
        return views, self._coarse.rendering(views)

    def learn(self, poses: Array, rates: tuple[float, float]) -> None:
        """Update the colour models from both sides of the borders matched in the refined alignment."""
        self._colours.learn(self.counting, self._pictures, poses, rates)
