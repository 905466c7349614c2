"""The images of one video frame with their colour models, and alignments of head and jaw with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array, Mask
from jawusd.tracking.contour.quality import fitting_share
from jawusd.tracking.contour.scan import CROWN
from jawusd.tracking.contour.solver import Matched
from jawusd.tracking.contour.views import present_masks
from jawusd.tracking.performance.attempts import FrameFit
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.performance.instant import Aligned, Expected, InstantSolver
from jawusd.tracking.performance.views import growth_of
from jawusd.tracking.region.appearance import LearnedColours, Picture
from jawusd.tracking.region.search import BORDER_PX3, LAST_GATES_PX, fraction_in_sight


class InstantImages:
    """Images of one frame and the rendering shared by all alignments."""

    def __init__(
        self,
        instants: InstantSolver,
        colours: LearnedColours,
        pictures: Sequence[Picture | None],
        before: Array,
        whole: InstantSolver | None,
    ) -> None:
        self._instants, self._colours, self._pictures, self._whole = instants, colours, pictures, whole
        self.views = colours.views(pictures, before)
        self._rendering = instants.solver.rendering(self.views)
        self.use = present_masks(self.views)

    def align(self, start: Pose, expected: Expected, gates_px: Sequence[float]) -> Aligned:
        """Return the most likely pose near a start."""
        weight = np.full(2, 1.0 / BORDER_PX3)
        return self._instants.align(start, self.views, self.use, gates_px, expected, weight, self._rendering)

    def polished(self, found: Aligned) -> Aligned:
        """Refine an alignment with all faces and the same prior; visibility is not recomputed."""
        if self._whole is None:
            return found
        weight = np.full(2, 1.0 / BORDER_PX3)
        self._counting = views = self._colours.counting(self.views)
        return self._whole.align(found.pose, views, self.use, LAST_GATES_PX, found.expected, weight, self._rendering)

    def fraction_in_sight(self, found: Aligned) -> Array:
        """Return the matched fraction of each arch's contour in sight, shape (2,), after colours were learned."""
        return fraction_in_sight(found.solution, self._counting)

    def upper_crowns(self, pose: Pose) -> list[Mask]:
        """Return masks of the pixels that upper crowns cover at a pose, one per view."""
        self._instants.linearise(pose, self.views, self.use, self._rendering, self._instants.config.final_gate_px[1])
        return [labels[0] == CROWN for labels in self._rendering.labels]

    def learn(self, pose: Pose, rates: tuple[float, float]) -> None:
        """Update the colour models from both sides of the borders matched at a pose."""
        if self._whole is None:
            self._counting, gate = self._colours.counting(self.views), self._instants.config.final_gate_px[1]
            self._instants.linearise(pose, self._counting, self.use, self._rendering, gate)
        self._colours.learn(self._counting, self._pictures, self._instants.coordinates.arches(pose), rates)

    def fit(self, found: Aligned, trusted: Mask, free_focal: bool) -> FrameFit:
        """Return the fit of the frame, in which only arches in `trusted` (2,) count as found."""
        use = self.use & trusted[:, None]
        unknown = np.full(use.shape, np.nan)
        if not free_focal or not trusted.any():
            return FrameFit(found.pose, found.solution, use, use, unknown)
        matched: list[Matched] = []
        gate, instants = self._instants.config.final_gate_px[1], self._whole or self._instants
        solution = instants.linearise(found.pose, self.views, use, self._rendering, gate, True, matched)
        growth = growth_of(matched, solution.poses, solution.centres, self.views)
        return FrameFit(found.pose, solution, use, use, unknown, growth)


@dataclass(frozen=True, eq=False)
class Begun:
    """A first frame: the colours learned in it, its images, its rough and its refined alignment, and the pose prior."""

    colours: LearnedColours
    look: InstantImages
    rough: Aligned
    found: Aligned
    expected: Expected

    @property
    def share(self) -> float:
        """Fraction of the visible contour of the worse arch that fits."""
        return float(fitting_share(self.found.solution).min())

    @property
    def fit(self) -> float:
        """Matched fraction of the contour in sight, of the worse arch."""
        return float(self.look.fraction_in_sight(self.found).min())
