"""Write pictures without lens distortion, as the camera of a scene sees them."""

from __future__ import annotations

import os

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.formats.atomic import atomic_path, write_bytes_atomic
from jawusd.geometry import Camera
from jawusd.media.working_view import WorkingView

_QUALITY = 95


class PlateWriter:
    """Undistort the pictures of one camera at full size and write them as JPEG, or light as EXR.

    A plate has the intrinsics K and the size of the recorded picture, so that the same pinhole camera fits it; the
    corners that the lens did not record are black.
    """

    def __init__(self, camera: Camera) -> None:
        """Take the calibrated camera."""
        self._view = WorkingView(camera, camera.size_px)

    def write(self, path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
        """Write the plate of a recorded picture (h, w, 3) RGB.

        Raises:
            OutputError: the file cannot be written.
        """
        plate = self._view.picture(image)[..., ::-1]
        write_bytes_atomic(path, cv2.imencode(".jpg", plate, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())

    def write_light(self, path: str | os.PathLike[str], image: NDArray[np.float32]) -> None:
        """Write the plate of light (h, w, 3) RGB as EXR of half floats, ZIP compressed.

        Raises:
            OutputError: the file cannot be written.
        """
        planes = np.ascontiguousarray(self._view.light(image))
        height, width = planes.shape[:2]
        with atomic_path(path) as temporary, av.open(str(temporary), "w", "image2", options={"update": "1"}) as out:
            stream = out.add_stream("exr", rate=1)
            stream.width, stream.height, stream.pix_fmt = width, height, "gbrpf32le"
            stream.options = {"format": "half", "compression": "zip16"}
            frame = av.VideoFrame.from_ndarray(planes, format="gbrpf32le")
            out.mux([*stream.encode(frame), *stream.encode(None)])
