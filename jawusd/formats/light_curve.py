"""How bright a clip was from picture to picture, and when the light went off and on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array


@dataclass(frozen=True, eq=False)
class LightCurve:
    """Hold the brightness of one clip."""

    times_s: Array  # presentation time of every picture after the first one [s], shape (n,)
    frames: NDArray[np.int64]  # its frame on the clip's even grid, shape (n,)
    brightness: Array  # its mean brightness, 0 .. 255, shape (n,)
    # when the light suddenly went off, and on [frames], shapes (a,), (b,)
    off_frames: Array
    on_frames: Array
