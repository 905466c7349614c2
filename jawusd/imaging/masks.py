"""Read segmentation masks, numbered by their camera's own video frames, decoding ahead in the background."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.errors import CaptureError
from jawusd.imaging.video import Video

__all__ = ["MaskReader", "mask_size_px"]

_AHEAD = 4  # pictures waiting at most: 8 MB of full HD per reader
_NUMBER = re.compile(r"%(0(\d+))?d")

Mask = NDArray[np.uint8]


class MaskReader:
    """Read the masks of one row of teeth in one camera.

    Reading frame after frame decodes the next few in a background thread; any other order works and decodes on
    demand. One reader serves one thread; use it as a context manager or close it, or its thread waits for ever.

    Attributes:
        path: PNG pattern or video.
        count: one past the last frame the source knows of.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        size_px: tuple[int, int],
        *,
        video_count: int | None = None,
        prepare: Callable[[Mask], Any] | None = None,
    ) -> None:
        """Find the masks; decodes nothing yet, except the first picture of a video.

        Args:
            path: a PNG pattern with one `%d` or `%06d` (the frame of the camera's video), or a video with one picture
                per frame of the camera's video.
            size_px: (width, height) of the camera's pictures.
            video_count: frames of the camera's video; a mask video of another length is refused.
            prepare: applied to each mask in the background thread, such as `WorkingView.mask`; its result is returned
                instead of the mask.

        Raises:
            CaptureError: the folder or file is missing, holds no masks, or their size or count is wrong.
        """
        self.path = Path(path)
        is_pattern = "%" in self.path.name
        self._source = _PngMasks(self.path, size_px) if is_pattern else _VideoMasks(self.path, size_px, video_count)
        self.count = self._source.count
        self._prepare = prepare
        self._previous: int | None = None
        self._ahead: _Ahead | None = None

    def read(self, frame: int) -> Any:
        """Return the mask of a frame of the camera's video.

        Args:
            frame: frame number; numbers outside the video are allowed.

        Returns:
            (h, w) uint8, 255 = tooth, 0 = not (soft edges in between stay), or what `prepare` makes of it; None where
            the frame is not segmented: no picture, or a black one.

        Raises:
            CaptureError: the picture cannot be decoded, or has the wrong size.
        """
        if not 0 <= frame < self.count:
            self._previous = frame
            return None
        follows = self._previous is not None and frame == self._previous + 1
        self._previous = frame
        if self._ahead is not None and self._ahead.next_frame == frame:
            return self._ahead.take()
        if not follows:
            with contextlib.closing(self._results(frame)) as results:
                return next(results)
        self.close()
        self._ahead = _Ahead(self._results(frame), frame)
        return self._ahead.take()

    def close(self) -> None:
        """Stop decoding ahead; the reader can still be used."""
        if self._ahead is not None:
            self._ahead.stop()
            self._ahead = None

    def __enter__(self) -> MaskReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _results(self, first: int) -> Iterator[Any]:
        for mask in self._source.masks(first):
            if mask is not None and not mask.any():
                mask = None
            yield mask if mask is None or self._prepare is None else self._prepare(mask)


def mask_size_px(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Return the (width, height) of the first mask of a PNG pattern or video.

    Raises:
        CaptureError: the folder or file is missing, holds no masks, or cannot be decoded.
    """
    path = Path(path)
    if "%" not in path.name:
        return Video(path).size_px
    return _PngMasks(path, None).first_size_px()


class _PngMasks:
    """Masks as numbered PNG files; of any size where none is named."""

    def __init__(self, pattern: Path, size_px: tuple[int, int] | None) -> None:
        self._pattern, self._size_px = pattern, size_px
        number = _NUMBER.search(pattern.name)
        if number is None or pattern.name.count("%") != 1:
            raise CaptureError(
                "the mask pattern needs one number such as %06d.", path=pattern, hint="Correct it in capture.toml."
            )
        if not pattern.parent.is_dir():
            raise CaptureError(
                f"there is no folder {pattern.parent}.", path=pattern, hint="Correct it in capture.toml."
            )
        digits = rf"\d{{{number[2]},}}" if number[2] else r"\d+"
        before, after = (re.escape(part) for part in (pattern.name[: number.start()], pattern.name[number.end() :]))
        name = re.compile(f"{before}({digits}){after}")
        found = (name.fullmatch(entry.name) for entry in os.scandir(pattern.parent))
        self._files = {int(match[1]): pattern.parent / match[0] for match in found if match}
        if not self._files:
            raise CaptureError(
                "no file of the folder has such a name.", path=pattern, hint="Correct `masks` in capture.toml."
            )
        self.count = max(self._files) + 1

    def masks(self, first: int) -> Iterator[Mask | None]:
        for frame in range(first, self.count):
            path = self._files.get(frame)
            yield None if path is None else self._load(path)

    def first_size_px(self) -> tuple[int, int]:
        height, width = self._load(self._files[min(self._files)]).shape
        return width, height

    def _load(self, path: Path) -> Mask:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise CaptureError(
                "the mask cannot be decoded.", path=path, hint="Export it again, or delete it: that frame is skipped."
            )
        if self._size_px is not None:
            _check_size(path, image.shape[1::-1], self._size_px)
        return _single_channel(image)


class _VideoMasks:
    """Masks as a video with one picture per frame of the camera's video."""

    def __init__(self, path: Path, size_px: tuple[int, int], video_count: int | None) -> None:
        self._video = Video(path)
        _check_size(path, self._video.size_px, size_px)
        self.count = self._video.count
        if video_count is not None and self.count != video_count:
            raise CaptureError(
                f"the mask video has {self.count} pictures, the camera's video {video_count}.",
                path=path,
                hint="Export the masks again, one picture per frame of the video, from its first frame on.",
            )

    def masks(self, first: int) -> Iterator[Mask | None]:
        for frame in self._video.frames(first, threads=1):
            yield frame.image


def _check_size(path: Path, found: tuple[int, int], allowed: tuple[int, int]) -> None:
    if tuple(found) != tuple(allowed):
        raise CaptureError(
            f"the mask is {found[0]} x {found[1]} px, the camera's pictures are {allowed[0]} x {allowed[1]} px.",
            path=path,
            hint="Export the masks at the size of the video.",
        )


def _single_channel(image: NDArray) -> Mask:
    """Turn any PNG into 8-bit coverage: alpha where it is used, else the brightest colour; 0/1 becomes 0/255."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 3:
        has_alpha = image.shape[2] == 4 and image[..., 3].min() < 255
        image = np.ascontiguousarray(image[..., 3]) if has_alpha else image[..., :3].max(axis=2)
    return image * np.uint8(255) if image.max() == 1 else image


class _Ahead:
    """Run an iterator in a thread, a few items ahead of whoever takes them."""

    def __init__(self, items: Iterator[Any], first_frame: int) -> None:
        self.next_frame = first_frame
        self._queue: queue.Queue[tuple[Any, Exception | None]] = queue.Queue(_AHEAD)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(items,), daemon=True, name="jawusd-masks")
        self._thread.start()

    def take(self) -> Any:
        self.next_frame += 1
        item, error = self._queue.get()
        if error is not None:
            self.next_frame = -1  # the thread has ended
            raise error
        return item

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self, items: Iterator[Any]) -> None:
        try:
            with contextlib.closing(items):
                for item in items:
                    self._put(item, None)
                    if self._stopping.is_set():
                        return
        except Exception as error:  # handed to the thread that reads, whatever it is
            self._put(None, error)

    def _put(self, item: Any, error: Exception | None) -> None:
        while not self._stopping.is_set():
            with contextlib.suppress(queue.Full):
                self._queue.put((item, error), timeout=0.05)
                return
