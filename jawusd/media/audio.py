"""Read the sound of a video with PyAV, as one channel."""

from __future__ import annotations

import os
from typing import NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import CaptureError
from jawusd.base.inputs import check_input
from jawusd.media.containers import open_container


class Sound(NamedTuple):
    """Hold the sound of a file."""

    samples: NDArray[np.float32]  # one channel, shape (n,)
    rate_hz: int  # samples per second
    start_s: float  # presentation time of the first sample in the file [s]


def read_sound(path: str | os.PathLike[str], rate_hz: int) -> Sound | None:
    """Return the first sound track of a file, None if it carries none.

    Raises:
        CaptureError: the file or its sound cannot be decoded.
    """
    parts: list[NDArray[np.float32]] = []
    start_s = 0.0
    check_input(path, CaptureError)
    try:
        with open_container(path) as container:
            if not container.streams.audio:
                return None
            resampler = av.AudioResampler(format="flt", layout="mono", rate=rate_hz)
            for frame in container.decode(container.streams.audio[0]):
                if not parts and frame.pts is not None and frame.time_base is not None:
                    start_s = float(frame.pts * frame.time_base)
                parts += [piece.to_ndarray()[0] for piece in resampler.resample(frame)]
            parts += [piece.to_ndarray()[0] for piece in resampler.resample(None)]
    except (av.FFmpegError, OSError) as error:
        raise CaptureError(
            f"its sound cannot be decoded ({error.strerror}).", path=path, hint="Copy it again from the camera."
        ) from error
    return Sound(np.concatenate(parts), rate_hz, start_s) if parts else None
