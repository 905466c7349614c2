"""Where a solve from pictures begins: at picks, or by search in rows of teeth that were found by colour alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import TrackingError
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Bootstrap, CameraSource
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera
from jawusd.tracking.config import Mapper, TrackingConfig
from jawusd.tracking.contour.scan import ARCH_NAMES, Scan
from jawusd.tracking.contour.solver import ContourSolver
from jawusd.tracking.contour.views import masked_sources
from jawusd.tracking.initialization.bootstrap import pose_from_picks
from jawusd.tracking.initialization.footage import Footage
from jawusd.tracking.initialization.scan_checks import check_occlusion
from jawusd.tracking.initialization.start_search import StartSearch
from jawusd.tracking.performance.coordinates import Coordinates, Pose
from jawusd.tracking.performance.single_start import SingleStart


class RowStart:
    """Find both arches on a frame of two cameras or more.

    Rough masks do, since borders of colours show then how well poses fit.

    Attributes:
        axes: scan frame to (left, up, front) axes, shape (4, 4).
        findings: what is doubtful about the scans.
    """

    def __init__(
        self,
        meshes: tuple[Mesh, Mesh],
        scans: tuple[Scan, Scan],
        T_anatomical_skull: list[list[float]] | None,
        map_: Mapper = map,
    ) -> None:
        """Prepare.

        Args:
            meshes, scans: upper and lower teeth in one frame, in occlusion [mm]; the same, prepared.
            T_anatomical_skull: scan frame to (left, up, front) axes, shape (4, 4), None if it is not known.
            map_: runs orientations.

        Raises:
            TrackingError: the scans cannot be in occlusion.
        """
        self._meshes, self._map = meshes, map_
        self.solver = ContourSolver(scans, TrackingConfig())
        self.axes, self.findings = check_occlusion(scans, T_anatomical_skull)

    @cached_property
    def _search(self) -> StartSearch:
        return StartSearch(self._meshes, self.solver, self.axes, self._map)

    def picked(self, bootstrap: Bootstrap, cameras: Mapping[str, Camera]) -> Array:
        """Return the poses that picks show, in two cameras or more: T_world_upper and T_world_lower, shape (2, 4, 4).

        Raises:
            TrackingError: the picks cannot be.
        """
        table = zip(self._meshes, ARCH_NAMES, (bootstrap.upper, bootstrap.lower), strict=True)
        return np.stack([pose_from_picks(picks, mesh.vertices, cameras, name)[0] for mesh, name, picks in table])

    def at(
        self, sources: Sequence[CameraSource], cameras: Mapping[str, Camera], offsets: Mapping[str, int], frame: int
    ) -> Array | None:
        """Return the likeliest poses on a frame by rough masks, shape (2, 4, 4), None if there are none.

        Args:
            sources: cameras with masks of that frame, two or more.
            cameras, offsets: by camera name; reference frame minus own frame number.
            frame: of the reference camera.
        """
        masked = masked_sources(sources, cameras, offsets, 2)
        try:
            return self._search.at(Footage(masked, cameras, offsets, (frame, frame + 1), 2), frame).poses
        except TrackingError:
            return None


class PictureStart:
    """Find head and jaw of a person whose rig is known on a frame of one camera or more.

    Attributes:
        findings: what is doubtful about the scans.
    """

    def __init__(
        self,
        meshes: tuple[Mesh, Mesh],
        scans: tuple[Scan, Scan],
        jaw: JawRig,
        T_anatomical_skull: list[list[float]] | None,
        map_: Mapper = map,
    ) -> None:
        """Prepare; see `RowStart`.

        Raises:
            TrackingError: the scans cannot be in occlusion.
        """
        self._meshes, self._jaw, self._map = meshes, jaw, map_
        self._rows = RowStart(meshes, scans, T_anatomical_skull, map_)
        self._coordinates = Coordinates(jaw, scans)
        self.findings = self._rows.findings

    @cached_property
    def _single(self) -> SingleStart:
        return SingleStart(self._meshes, self._rows.solver, self._jaw, self._rows.axes, self._map)

    def picked(self, bootstrap: Bootstrap, cameras: Mapping[str, Camera]) -> Pose:
        """Return the pose that picks show, in two cameras or more.

        Raises:
            TrackingError: the picks cannot be.
        """
        return self._coordinates.pose_of(self._rows.picked(bootstrap, cameras))

    def at(
        self, sources: Sequence[CameraSource], cameras: Mapping[str, Camera], offsets: Mapping[str, int], frame: int
    ) -> Pose | None:
        """Return the likeliest pose on a frame by rough masks of one camera or more, None if there is none.

        Args:
            sources: cameras with masks of that frame.
            cameras, offsets: by camera name; reference frame minus own frame number.
            frame: of the reference camera.
        """
        if len(sources) > 1:
            poses = self._rows.at(sources, cameras, offsets, frame)
            return None if poses is None else self._coordinates.pose_of(poses)
        masked = masked_sources(sources, cameras, offsets, 1)
        found = self._single.at(Footage(masked, cameras, offsets, (frame, frame + 1), 1), frame)
        return None if found is None else found.pose
