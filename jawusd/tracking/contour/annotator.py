"""Annotator bias: offsets between mask outlines and tooth edges that all frames of a take share.

The bias of a mask, with the components of `OutlineSums`, is the sum of the bias common to all masks of a take, its
deviations in each arch, and its deviations in each arch and camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from jawusd.base.arrays import Array
from jawusd.tracking.contour.scan import Scan

#: Number of components of the bias of a mask.
COMPONENTS = 3


@dataclass(frozen=True)
class AnnotatorPrior:
    """Prior standard deviations of mask biases, per component: tooth edges [px], gum line [px], gum line [mm]."""

    #: bias of all masks; the second component is the bias of the gum line relative to tooth edges
    common: tuple[float, float, float]
    arch: tuple[float, float, float]  # deviations in each arch
    camera: tuple[float, float]  # deviations in each arch and camera [px]; tooth edges and gum line only
    #: effective number of independent frames in a take [-]: few, since all frames show the same lips and teeth
    frames: float

    def sigma(self, cameras: int) -> Array:
        """Return the standard deviations of the layers, in the order of `bias_layers`, shape (9 + 4 C,)."""
        return np.r_[self.common, self.arch, self.arch, np.tile(self.camera, 2 * cameras)]

    def redundancy(self, frames: int) -> float:
        """Return the factor by which a number of frames overstates the information on the bias."""
        return max(1.0, frames / self.frames)


#: Prior for hand-drawn masks.
DRAWN = AnnotatorPrior(common=(0.5, 0.4, 0.1), arch=(0.15, 0.15, 0.05), camera=(0.1, 0.1), frames=1.5)


#: Prior for hand-drawn masks and scans without gum. For these scans, outlines at the neck of a tooth are classified by
#: their direction, and classification errors recur in every frame.
DRAWN_BESIDE_CROWNS = replace(DRAWN, frames=0.75)


def drawn_prior(scans: Sequence[Scan]) -> AnnotatorPrior:
    """Return the prior for hand-drawn masks of these scans."""
    return DRAWN if all(scan.shows_gum for scan in scans) else DRAWN_BESIDE_CROWNS


def bias_layers(cameras: int) -> Array:
    """Return the matrices from the layers to the bias of each arch and camera, shape (2, C, 3, 9 + 4 C)."""
    out = np.zeros((2, cameras, COMPONENTS, 9 + 4 * cameras))
    for arch, camera in np.ndindex(2, cameras):
        of_arch, of_view = 3 + 3 * arch, 9 + 2 * (2 * camera + arch)
        out[arch, camera, 0, [0, of_arch, of_view]] = 1.0
        out[arch, camera, 1, [0, 1, of_arch + 1, of_view + 1]] = 1.0
        out[arch, camera, 2, [2, of_arch + 2]] = 1.0
    return out
