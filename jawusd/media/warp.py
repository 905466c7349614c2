"""Pictures brought to other pixels by an affine map."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array


def warp_nearest(
    picture: NDArray[np.uint8] | NDArray[np.float32], to_picture: Array, out: NDArray[np.uint8] | NDArray[np.float32]
) -> None:
    """Write what lies nearest to where each pixel comes from, 0 beyond the picture.

    Args:
        picture: shape (H, W).
        to_picture: from pixels of `out` to those of the picture, shape (2, 3).
        out: receives, of the picture's type, shape (h, w).
    """
    cv2.warpAffine(picture, to_picture, out.shape[::-1], out, cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
