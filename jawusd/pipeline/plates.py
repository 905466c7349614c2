"""Write the footage without lens distortion beside a take, to be seen behind the rig in a DCC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jawusd.errors import OutputError, explain_missing_packages
from jawusd.formats.capture import Capture
from jawusd.pipeline.overlay import open_footage
from jawusd.pipeline.state import Progress


@explain_missing_packages()
def write_plates(
    capture: Capture, offsets: dict[str, int], frames: NDArray[np.int64], folder: Path, progress: Progress
) -> list[str]:
    """Write one JPEG per frame and camera, where `cameras.usda` says they are, numbered by its time codes.

    Args:
        capture: gives footage and calibration.
        offsets: frame offset by camera.
        frames: frames of the reference camera, increasing, shape (F,). Where a camera has no picture there is
            no plate.
        folder: the rig's folder.
        progress: told of every picture.

    Returns:
        The file pattern of every camera, below the folder.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        CalibrationError: a video has another shape than its camera's calibration.
        OutputError: the files cannot be written.
    """
    from jawusd.imaging.plates import PlateWriter
    from jawusd.rig.cameras import PLATE

    cameras, videos = open_footage(capture)
    done, total = 0, len(videos) * len(frames)
    for name, video in videos.items():
        plates = PlateWriter(cameras[name])
        files = str(folder / PLATE.format(name=name))
        try:
            Path(files).parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot write here: {error.strerror}.", path=Path(files).parent) from error
        wanted = [video.timeline.picture(frame - offsets[name]) for frame in frames.tolist()]
        for frame, image in zip(frames.tolist(), video.pictures(wanted, colour="rgb")):
            if image is not None:
                plates.write(files % frame, image)
            done += 1
            progress("plates", done, total)
    return [PLATE.format(name=name) for name in videos]
