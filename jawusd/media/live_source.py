"""Read live images of a camera from a device, a network stream, or a file played at its own frame rate.

`now_s` and `wait_until` are the live clock, which tests replace.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

from jawusd.base.errors import CaptureError
from jawusd.media.pixels import ColourPicture, DecodedPicture
from jawusd.media.video import Video


def now_s() -> float:
    """Return the time [s] since an arbitrary origin."""
    return time.monotonic()


def wait_until(time_s: float, stopped: threading.Event) -> bool:
    """Wait until a time [s]; return whether `stopped` was set before then."""
    return stopped.wait(max(0.0, time_s - time.monotonic()))


_WAIT_S = 0.1
_KEPT = 8  # maximum number of images that wait for processing; older ones are discarded
# Address prefix of local devices, and PyAV's input format for them, by platform.
_DEVICES = {"linux": ("/dev/", "v4l2"), "darwin": ("avfoundation:", "avfoundation"), "win32": ("video=", "dshow")}


@dataclass(frozen=True, eq=False)
class LivePicture:
    """A live image: its time on the common clock [s], and RGB pixels uint8 (H, W, 3), converted on first access."""

    time_s: float
    rgb: ColourPicture


class LiveSource:
    """Reader of one live camera, in its own thread, with a buffer of the most recent images."""

    def __init__(self, where: str, size_px: tuple[int, int], early_s: float = 0.0) -> None:
        """Prepare to read images of a calibrated size (width, height).

        Args:
            where: a file, a URL (rtsp://, http://, ...), or a device (/dev/video0 on Linux).
            early_s: time by which the recording in a file begins before those of the other sources [s].
        """
        self.where, self._size_px, self._early_s = where, size_px, early_s
        self._kept: deque[LivePicture] = deque(maxlen=_KEPT)
        self._changed, self._stopped = threading.Condition(), threading.Event()
        self._open, self._playing, self._begin_s = threading.Event(), threading.Event(), 0.0
        self._streams, self._heard_s = not Path(where).is_file(), 0.0
        self._error: CaptureError | None = None
        self.ended = False

    def open(self, from_s: float = 0.0) -> None:
        """Open the source in a thread; files start `from_s` [s] after the recordings begin; see `play`."""
        self._heard_s = now_s()
        threading.Thread(target=self._read, args=(from_s,), daemon=True).start()

    def wait_open(self, silence_s: float) -> None:
        """Wait until the source is open or has failed.

        Raises:
            CaptureError: see `refuse_silence`.
        """
        while not self._open.wait(_WAIT_S):
            self.refuse_silence(silence_s)

    def refuse_silence(self, silence_s: float) -> None:
        """Check that a device or stream has sent an image within `silence_s` [s].

        Raises:
            CaptureError: the source has not sent an image.
        """
        if self._streams and not self.ended and now_s() - self._heard_s > silence_s:
            raise CaptureError(
                f"has sent no image for {silence_s:g} s.",
                path=self.where,
                hint="Check that the camera is switched on and sending images. --silence sets the time limit.",
            )

    def play(self, begin_s: float) -> None:
        """Start delivering images; the recordings of files begin at `begin_s` on the live clock."""
        self._begin_s = begin_s
        self._playing.set()

    def stop(self) -> None:
        """Stop reading."""
        self._stopped.set()
        self._playing.set()

    def times_s(self) -> list[float]:
        """Return the times of the buffered images, newest last.

        Raises:
            CaptureError: the source cannot be read.
        """
        if self._error is not None:
            raise self._error
        with self._changed:
            return [picture.time_s for picture in self._kept]

    def at(self, time_s: float) -> LivePicture | None:
        """Return the buffered image nearest to a time, or None before the first image has arrived."""
        with self._changed:
            return min(self._kept, key=lambda picture: abs(picture.time_s - time_s), default=None)

    def wait(self, after_s: float, timeout_s: float) -> bool:
        """Wait for an image that is newer than a time; return whether one has arrived."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self.ended or self._error is not None or (bool(self._kept) and self._kept[-1].time_s > after_s),
                timeout_s,
            )

    def _read(self, from_s: float) -> None:
        try:
            pictures = self._stream() if self._streams else self._file(from_s)
            for picture in pictures:
                if picture.rgb.shape[1::-1] != self._size_px:
                    found, wanted = "{} x {}".format(*picture.rgb.shape[1::-1]), "{} x {}".format(*self._size_px)
                    raise CaptureError(
                        f"images are {found} px, but the calibration is for {wanted} px.", path=self.where
                    )
                with self._changed:
                    self._kept.append(picture)
                    self._changed.notify_all()
                if self._stopped.is_set():
                    return
        except CaptureError as error:
            self._error = error
        finally:
            self._open.set()
            with self._changed:
                self.ended = True
                self._changed.notify_all()

    def _file(self, from_s: float) -> Iterator[LivePicture]:
        """Yield each image of a file at the time at which it was recorded."""
        video = Video(self.where)
        first = int(np.searchsorted(video.times_s, from_s + self._early_s))
        numbers = range(first, video.count)
        for time_s, picture in zip(video.times_s[first:], video.colour_pictures(numbers, threads=1), strict=True):
            self._open.set()
            self._playing.wait()
            due = self._begin_s - self._early_s + float(time_s)
            if picture is None or wait_until(due, self._stopped):
                return
            yield LivePicture(due, picture)

    def _stream(self) -> Iterator[LivePicture]:
        start, name = _DEVICES.get(sys.platform, ("", ""))
        device = bool(start) and self.where.startswith(start)
        address = self.where.removeprefix(start) if device and start.endswith(":") else self.where
        try:
            with av.open(address, format=name if device else None) as container:
                for frame in container.decode(video=0):
                    self._open.set()
                    self._heard_s = now_s()
                    yield LivePicture(self._heard_s, DecodedPicture(frame, 0))
        except (av.FFmpegError, OSError, IndexError) as error:
            raise CaptureError(
                f"cannot be read ({error}).",
                path=self.where,
                hint="Give a file, a device such as /dev/video0, or a stream such as rtsp://host/camera.",
            ) from error
