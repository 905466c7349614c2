"""Start of tracking by colour: from picks, or by a search in rough masks of the arches, which are found by colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera
from jawusd.media.masks import FrameMasks
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.scan import ARCH_NAMES, Scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import FEWEST_CAMERAS, masked_sources
from jawusd.tracking.initialization.bootstrap import pose_from_picks
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start_search import StartSearch
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.single_start import SingleStart


class ArchStart:
    """Search for both arches in one video frame of two or more cameras.

    Rough masks are sufficient, since the fit of the poses is verified with colour borders.

    Attributes:
        axes: scan frame to (left, up, front) axes, shape (4, 4).
        findings: findings about the scans.
    """

    def __init__(
        self,
        meshes: tuple[Mesh, Mesh],
        scans: tuple[Scan, Scan],
        T_anatomical_skull: list[list[float]] | None,
        map_: Mapper = map,
    ) -> None:
        """Prepare the search.

        Args:
            meshes, scans: upper and lower teeth in one coordinate frame, in occlusion [mm], before and after
                `prepare_scan`.
            T_anatomical_skull: scan frame to (left, up, front) axes, shape (4, 4); None if unknown.
            map_: map function that may process orientations in parallel.

        Raises:
            TrackingError: the scans are not in occlusion.
        """
        self._meshes, self._map = meshes, map_
        self.solver = ContourSolver(scans, TrackingConfig())
        self.axes, self.findings = check_occlusion(scans, T_anatomical_skull)

    @cached_property
    def _search(self) -> StartSearch:
        return StartSearch(self._meshes, self.solver, self.axes, self._map)

    def picked(self, bootstrap: Bootstrap, cameras: Mapping[str, Camera]) -> Array:
        """Return the poses from picks in two or more cameras: T_world_upper and T_world_lower, shape (2, 4, 4).

        Raises:
            TrackingError: the picks are inconsistent.
        """
        table = zip(self._meshes, ARCH_NAMES, (bootstrap.upper, bootstrap.lower), strict=True)
        return np.stack([pose_from_picks(picks, mesh.vertices, cameras, name)[0] for mesh, name, picks in table])

    def at(
        self, masks: Sequence[FrameMasks], cameras: Mapping[str, Camera], offsets: Mapping[str, int], frame: int
    ) -> Array | None:
        """Return the most likely poses in a frame with rough masks, shape (2, 4, 4); None if there are none.

        Args:
            masks: masks of that frame; with one camera, the result is None.
            cameras, offsets: calibrations and time offsets by camera name; an offset is the reference frame number
                minus the camera's own.
            frame: frame number of the reference camera.
        """
        if len(masks) < FEWEST_CAMERAS:
            return None
        masked = masked_sources(masks, cameras, offsets)
        try:
            return self._search.at(Footage(masked, cameras, offsets, (frame, frame + 1), 2), frame).poses
        except TrackingError:
            return None


class PictureStart:
    """Search for head and jaw of a subject with a known rig in one video frame of one or more cameras.

    Attributes:
        findings: findings about the scans.
    """

    def __init__(
        self,
        meshes: tuple[Mesh, Mesh],
        scans: tuple[Scan, Scan],
        jaw: JawRig,
        T_anatomical_skull: list[list[float]] | None,
        map_: Mapper = map,
    ) -> None:
        """Prepare the search; arguments as for `ArchStart`.

        Raises:
            TrackingError: the scans are not in occlusion.
        """
        self._meshes, self._jaw, self._map = meshes, jaw, map_
        self._rows = ArchStart(meshes, scans, T_anatomical_skull, map_)
        self._coordinates = Coordinates(jaw, scans)
        self.findings = self._rows.findings

    @cached_property
    def _single(self) -> SingleStart:
        return SingleStart(self._meshes, self._rows.solver, self._jaw, self._rows.axes, self._map)

    def picked(self, bootstrap: Bootstrap, cameras: Mapping[str, Camera]) -> Pose:
        """Return the pose from picks in two or more cameras.

        Raises:
            TrackingError: the picks are inconsistent.
        """
        return self._coordinates.pose_of(self._rows.picked(bootstrap, cameras))

    def at(
        self, masks: Sequence[FrameMasks], cameras: Mapping[str, Camera], offsets: Mapping[str, int], frame: int
    ) -> Pose | None:
        """Return the most likely pose in a frame with rough masks of one or more cameras, or None.

        Args:
            masks: masks of that frame, of one or more cameras.
            cameras, offsets: calibrations and time offsets by camera name; an offset is the reference frame number
                minus the camera's own.
            frame: frame number of the reference camera.
        """
        if len(masks) > 1:
            poses = self._rows.at(masks, cameras, offsets, frame)
            return None if poses is None else self._coordinates.pose_of(poses)
        masked = masked_sources(masks, cameras, offsets, 1)
        found = self._single.at(Footage(masked, cameras, offsets, (frame, frame + 1), 1), frame)
        return None if found is None else found.pose
