"""Read segmentation masks by frame number of their camera's video, decoded ahead in a background thread."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import repeat
from pathlib import Path

from jawusd.base.errors import AnyPath, CaptureError
from jawusd.formats.capture import CameraSource
from jawusd.formats.clips import ClipSource
from jawusd.formats.file_names import is_pattern, numbered_files
from jawusd.media.clip import Timeline, read_ahead
from jawusd.media.footage import open_clip
from jawusd.media.mask_files import LabelValues, OneMask, PngMasks, VideoMasks, load_png
from jawusd.media.mask_levels import MaskImage, MaskLevels
from jawusd.media.video import Video

_LOOKED_AT = 10  # number of label images that are sampled
_AHEAD = 4  # number of buffered images; the buffer takes 8 MB per reader for full HD


@dataclass(frozen=True, eq=False)
class FrameMasks:
    """Masks of both arches in one frame of a camera, in memory."""

    name: str  # name of the camera
    frame: int  # frame number of the camera
    masks: MaskImage  # upper and lower arch: 255 for tooth, 0 for background, shape (2, h, w)


class MaskReader:
    """Reader of the masks of one arch in one camera.

    Sequential reads decode the next frames in a background thread; random access decodes on demand. A reader is not
    thread-safe. Use it as a context manager or close it; otherwise its thread never ends. Frames are those of the
    camera's `Timeline`.

    Attributes:
        count: one past the last frame number of the masks.
        levels: meaning of the pixel values; None for label images, or if nothing is segmented.
    """

    def __init__(
        self,
        path: AnyPath | OneMask,
        size_px: tuple[int, int],
        *,
        timeline: Timeline | None = None,
        labels: LabelValues | None = None,
        prepare: Callable[[MaskImage], MaskImage] | None = None,
    ) -> None:
        """Find the masks, and the meaning of their pixel values from samples of the whole take.

        Args:
            path: a PNG pattern with one `%d` or `%06d` (the index of the image in the camera's video), a mask video
                with one mask per image or per frame of the camera's video, or a mask in memory.
            timeline: timeline of the camera's video; if it is None, PNG files are numbered by frame.
            labels: for label images, the gray values of the requested arch and of the other arch.
            prepare: function applied to each mask in the background thread, such as `WorkingView.mask`.

        Raises:
            CaptureError: the folder or file is missing, has no masks, or their size or number is wrong.
        """
        self._labels = labels
        self._source: PngMasks | VideoMasks | OneMask
        self._timeline: Timeline | None
        if isinstance(path, OneMask):
            self._source, self._timeline = path, None
        elif is_pattern(path := Path(path)):
            self._source = pngs = PngMasks(path, size_px, labels)
            self._timeline = _timeline_of_pngs(path, pngs, timeline)
        else:
            self._source = pictures = VideoMasks(path, size_px, labels)
            self._timeline = _timeline_of_video(path, pictures, timeline)
        self.count = self._source.count if self._timeline is None else self._timeline.count
        self.levels: MaskLevels | None = None if labels else self._source.levels
        self._prepare = prepare
        self._previous: int | None = None
        self._ahead: Generator[MaskImage | None] | None = None
        self._next_ahead = 0

    def read(self, frame: int) -> MaskImage | None:
        """Return the prepared mask (h, w) of a frame, 255 for tooth, 0 for background; None if nothing is segmented.

        Raises:
            CaptureError: the image cannot be decoded, has the wrong size, or is not a mask.
        """
        if not 0 <= frame < self.count:
            self._previous = frame
            return None
        follows = self._previous is not None and frame == self._previous + 1
        self._previous = frame
        if self._ahead is None or self._next_ahead != frame:
            if not follows:
                with contextlib.closing(self._results(frame)) as results:
                    return next(results)
            self.close()
            self._ahead = self._results_ahead(frame)
        self._next_ahead = frame + 1
        try:
            return next(self._ahead)
        except Exception:
            self.close()  # the iterator has ended, and no mask will follow
            raise

    @cached_property
    def is_black(self) -> bool:
        """Return whether all mask images are empty.

        Raises:
            CaptureError: a label image cannot be decoded, has the wrong size or unknown values.
        """
        if isinstance(self._source, OneMask):
            return not self._source.image.any()
        if self._labels is None:
            return self.levels is None
        some = range(self.count // 2, self.count, max(1, self.count // _LOOKED_AT))
        with contextlib.closing(self._results(0)) as results:
            return all(self.read(frame) is None for frame in some) and all(mask is None for mask in results)

    @property
    def odd(self) -> list[str]:
        """Return the reasons why images were rejected so far; rejected images count as not segmented."""
        return [self._source.odd[number] for number in sorted(self._source.odd)]

    def read_some(self, first: int, stop: int) -> list[MaskImage | None]:
        """Return the masks of frames first to stop - 1, like `read`, but without decoding ahead.

        Raises:
            CaptureError: an image cannot be decoded, has the wrong size, or is not a mask.
        """
        inside = range(max(first, 0), min(stop, self.count))
        if not inside:
            return [None] * (stop - first)
        with contextlib.closing(self._results(inside.start)) as results:
            found = [next(results) for _ in inside]
        return [None] * (inside.start - first) + found + [None] * (stop - inside.stop)

    def close(self) -> None:
        """Stop decoding in the background; the reader remains usable."""
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None

    def __enter__(self) -> MaskReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _results(self, first: int) -> Generator[MaskImage | None]:
        for mask in self._masks(first):
            if mask is not None and not mask.any():
                mask = None
            yield mask if mask is None or self._prepare is None else self._prepare(mask)

    def _results_ahead(self, first: int) -> Generator[MaskImage | None]:
        with contextlib.closing(self._results(first)) as results:
            yield from read_ahead(repeat(partial(next, results, None)), 1, _AHEAD)

    def _masks(self, first: int) -> Iterator[MaskImage | None]:
        """Yield the mask of every frame from `first` on."""
        if self._timeline is None:
            yield from self._source.masks(first)
            return
        # PNG files are numbered like the files of the clip, images of a mask video like the images of the clip.
        numbered = self._timeline.number if isinstance(self._source, PngMasks) else self._timeline.picture
        pictures, at = None, 0
        for frame in range(first, self.count):
            picture = numbered(frame)
            if picture is None or picture >= self._source.count:
                yield None
                continue
            if pictures is None:
                pictures, at = self._source.masks(picture), picture
            while at < picture:  # if two images belong to one frame, use the first
                next(pictures)
                at += 1
            yield next(pictures)
            at += 1


def _timeline_of_pngs(path: Path, source: PngMasks, video: Timeline | None) -> Timeline | None:
    """Return the timeline that maps frames to the numbers of mask files; None if they are equal."""
    if video is None or not (video.missing or video.is_numbered):
        return None
    if video.is_numbered:
        if not source.numbers & set(video.stored.tolist()):
            raise CaptureError(
                f"the masks are numbered {min(source.numbers)} to {max(source.numbers)}, but the camera's images are "
                f"numbered {video.stored[0]} to {video.stored[-1]}.",
                path=path,
                hint="Number the masks like the images from which they were made.",
            )
        return video
    if source.count > len(video.numbers):
        raise CaptureError(
            f"the masks are numbered up to {source.count - 1}, but the camera's video, with a variable frame rate, has "
            f"only images 0 to {len(video.numbers) - 1} (in {video.count} frames).",
            path=path,
            hint="Number masks by the images of the video, or convert the video to a constant rate "
            "before making masks.",
        )
    return video


def _timeline_of_video(path: Path, source: VideoMasks, video: Timeline | None) -> Timeline:
    """Return the timeline that maps the camera's frames to images of a mask video."""
    if video is None or source.timeline.count == video.count != len(video.numbers) != source.count:
        return source.timeline  # masks that were made from footage converted to a constant rate
    if source.count != len(video.numbers):
        frames = f" in {video.count} frames" if video.missing else ""
        raise CaptureError(
            f"the mask video has {source.count} images, but the camera's video has {len(video.numbers)}{frames}.",
            path=path,
            hint="Export the masks again, with one mask for each image of the video, from the first image on.",
        )
    return video


def open_masks(
    source: CameraSource | FrameMasks,
    size_px: tuple[int, int],
    *,
    prepare: Callable[[MaskImage], MaskImage] | None = None,
) -> tuple[MaskReader, MaskReader]:
    """Return readers of the upper and lower teeth masks of a camera; see `MaskReader`.

    Raises:
        CaptureError: masks or video are missing, damaged or do not match.
        ValueError: the camera has no masks.
    """
    if isinstance(source, FrameMasks):
        held = [OneMask(source.frame, mask) for mask in source.masks]
        return MaskReader(held[0], size_px, prepare=prepare), MaskReader(held[1], size_px, prepare=prepare)
    masks = source.masks
    if masks is None:
        raise ValueError(f"camera {source.name} has no masks")
    timeline = None
    if source.clip is not None:
        path = source.clip.path
        timeline = _timeline(source.clip, (path.parent if is_pattern(path) else path).stat().st_mtime_ns)
    labels = masks.labels
    upper = MaskReader(masks.upper, size_px, timeline=timeline, labels=labels, prepare=prepare)
    lower = MaskReader(masks.lower, size_px, timeline=timeline, labels=labels and labels[::-1], prepare=prepare)
    return upper, lower


@lru_cache(maxsize=64)
def _timeline(clip: ClipSource, changed_ns: int) -> Timeline:
    """Return the timeline of a clip; the modification time identifies the version of the file."""
    return open_clip(clip).timeline


def mask_size_px(path: AnyPath) -> tuple[int, int]:
    """Return the (width, height) of the first mask in a PNG pattern or a video.

    Raises:
        CaptureError: the folder or file is missing, has no masks, or cannot be decoded.
    """
    path = Path(path)
    if not is_pattern(path):
        return Video(path).size_px
    height, width = load_png(next(iter(numbered_files(path).values()))).shape[:2]
    return width, height
