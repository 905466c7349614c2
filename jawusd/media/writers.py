"""Write videos (H.264 for viewing, lossless gray for masks) and undistorted plates."""

from __future__ import annotations

import contextlib
from fractions import Fraction
from types import TracebackType

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.errors import AnyPath
from jawusd.formats.atomic import atomic_path, write_bytes_atomic
from jawusd.geometry import Camera
from jawusd.media.working_view import WorkingView

_QUALITY = 95


class VideoWriter:
    """Writer of a video file, as a context manager; the file gets its name only if the block succeeds."""

    def __init__(
        self,
        path: AnyPath,
        size_px: tuple[int, int],
        fps: float,
        *,
        lossless: bool = False,
        quality_crf: int = 16,
    ) -> None:
        """Prepare the video file, `.mp4` for H.264 (yuv420p), `.mkv` for lossless FFV1 gray.

        Args:
            size_px: (width, height); both even for H.264.
            quality_crf: constant rate factor of H.264, 0 (best) to 51.

        Raises:
            ValueError: the suffix, the size or the frame rate is not supported.
        """
        suffix = ".mkv" if lossless else ".mp4"
        if not str(path).endswith(suffix):
            raise ValueError(f"{path}: expected the suffix {suffix} for a {'lossless' if lossless else 'H.264'} video")
        if min(size_px) < 2 or (not lossless and (size_px[0] % 2 or size_px[1] % 2)):
            raise ValueError(f"size is {size_px} px; expected an even width and height of at least 2 px for H.264")
        if not fps > 0:
            raise ValueError(f"fps is {fps}; expected a positive number")
        self._size_px = size_px
        self._lossless = lossless
        self._atomic = atomic_path(path)
        self._rate = Fraction(fps).limit_denominator(1001)
        self._crf = quality_crf

    def __enter__(self) -> VideoWriter:
        with contextlib.ExitStack() as stack:
            temporary = stack.enter_context(self._atomic)
            container = av.open(str(temporary), "w", format="matroska" if self._lossless else "mp4")
            self._container = stack.enter_context(container)
            stream = container.add_stream("ffv1" if self._lossless else "libx264", rate=self._rate)
            stream.width, stream.height = self._size_px
            stream.pix_fmt = "gray" if self._lossless else "yuv420p"
            # Only key frames in FFV1: seeking is fast, and damage affects a single image.
            stream.options = {"level": "3", "g": "1"} if self._lossless else {"crf": str(self._crf)}
            self._stream = stream
            self._next = 0
            self._stack = stack.pop_all()
        return self

    def write(self, image: NDArray[np.uint8]) -> None:
        """Append an image: (h, w) gray, or (h, w, 3) RGB for H.264; uint8.

        Raises:
            ValueError: the image has the wrong shape or type.
        """
        shape = (self._size_px[1], self._size_px[0])
        colour = image.ndim == 3
        if image.dtype != np.uint8 or image.shape not in ((shape,) if self._lossless else (shape, (*shape, 3))):
            raise ValueError(f"image is {image.dtype} of shape {image.shape}; expected uint8 of shape {shape}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24" if colour else "gray")
        frame.pts = self._next
        frame.time_base = 1 / self._rate
        self._next += 1
        self._container.mux(self._stream.encode(frame))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            if error is not None:
                raise error
            self._container.mux(self._stream.encode(None))


class PlateWriter:
    """Writer of the undistorted images (plates) of one camera at full size: JPEG, or EXR for linear light.

    A plate has the intrinsics K and size of the recorded image, so that the same pinhole camera applies; regions that
    were not recorded are black.
    """

    def __init__(self, camera: Camera) -> None:
        self._view = WorkingView(camera, camera.size_px)

    def write(self, path: AnyPath, image: NDArray[np.uint8]) -> None:
        """Undistort and write a recorded image (h, w, 3) RGB.

        Raises:
            OutputError: the file cannot be written.
        """
        plate = self._view.picture(image)[..., ::-1]
        write_bytes_atomic(path, cv2.imencode(".jpg", plate, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())

    def write_light(self, path: AnyPath, image: NDArray[np.float32]) -> None:
        """Undistort a linear-light RGB image (h, w, 3) and write it as a ZIP-compressed EXR of half floats.

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
