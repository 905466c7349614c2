"""Start of tracking by colour: from picks, or by a search in rough masks of the arches, which are found by colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Bootstrap
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera
from jawusd.media.masks import FrameMasks
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.scan import Scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import FEWEST_CAMERAS, masked_sources
from jawusd.tracking.initialization.bootstrap import poses_from_picks
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
        """Prepare the search; raises TrackingError if the scans are not in occlusion.

        Args:
            meshes, scans: upper and lower teeth in one coordinate frame [mm], before and after `prepare_scan`.
            T_anatomical_skull: scan frame to (left, up, front) axes, shape (4, 4); None if unknown.
            map_: map function that may process orientations in parallel.
        """
        self._meshes, self._map = meshes, map_
        self.solver = ContourSolver(scans, TrackingConfig())
        self.axes, self.findings = check_occlusion(scans, T_anatomical_skull)

    @cached_property
    def _search(self) -> StartSearch:
        return StartSearch(self._meshes, self.solver, self.axes, self._map)

    def single(self, jaw: JawRig) -> SingleStart:
        """Return a search with the subject's rig in the frames of one camera."""
        return SingleStart(self._meshes, self.solver, jaw, self.axes, self._map)

    def picked(self, bootstrap: Bootstrap, cameras: Mapping[str, Camera]) -> Array:
        """Return T_world_upper and T_world_lower, shape (2, 4, 4), from picks in two or more cameras.

        Raises TrackingError if the picks are inconsistent.
        """
        return poses_from_picks(bootstrap, [mesh.vertices for mesh in self._meshes], cameras)

    def at(
        self, masks: Sequence[FrameMasks], cameras: Mapping[str, Camera], offsets: Mapping[str, int], frame: int
    ) -> Array | None:
        """Return the most likely poses in a frame with rough masks, shape (2, 4, 4); None if there are none.

        `masks` are those of that frame; with one camera, the result is None. `offsets` are as in `Footage`.
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

    def __init__(self, arches: ArchStart, jaw: JawRig) -> None:
        """Extend a search for both arches by the subject's rig."""
        self._arches, self._jaw, self.findings = arches, jaw, arches.findings
        self._coordinates = Coordinates(jaw, arches.solver.scans)

    @cached_property
    def _single(self) -> SingleStart:
        return self._arches.single(self._jaw)

    def picked(self, bootstrap: Bootstrap, cameras: Mapping[str, Camera]) -> Pose:
        """Return the pose from picks in two or more cameras; see `ArchStart.picked`."""
        return self._coordinates.pose_of(self._arches.picked(bootstrap, cameras))

    def at(
        self, masks: Sequence[FrameMasks], cameras: Mapping[str, Camera], offsets: Mapping[str, int], frame: int
    ) -> Pose | None:
        """Return the most likely pose in a frame with rough masks of one or more cameras, or None; see `ArchStart`."""
        if len(masks) > 1:
            poses = self._arches.at(masks, cameras, offsets, frame)
            return None if poses is None else self._coordinates.pose_of(poses)
        masked = masked_sources(masks, cameras, offsets, 1)
        found = self._single.at(Footage(masked, cameras, offsets, (frame, frame + 1), 1), frame)
        return None if found is None else found.pose
