"""Check clips and masks quickly: decoding errors, frozen images, unequal frame rates, and masks on a few frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import JawusdError
from jawusd.formats.capture import CameraSource
from jawusd.formats.file_names import gaps
from jawusd.formats.finding import Finding
from jawusd.media.clip import INTERLACED, INTERLACED_HINT, Clip
from jawusd.media.footage import PictureSequence
from jawusd.media.mask_levels import MOST_SOFT, MaskLevels
from jawusd.media.masks import MaskReader, open_masks

# Maximum drift between cameras over a take [frames]; larger drifts are reported.
_DRIFT_FRAMES = 0.5
# Relative tolerance of frame rates [-]; accepts rounding to three digits, and 23.976 for 24, but not 25 for 24.
_RATE_TOLERANCE = 0.005
_DECODED_PX = 1.5e9  # maximum number of pixels decoded per clip: 700 full-HD images, which takes seconds
_ENDS_S = 4.0  # duration that is decoded at each end of a clip; `sync` reads these parts first
_PART = 48  # number of images per decoded part
_SPARSE = 4  # pixel step in both directions when images are compared
_LISTED = 5
# Percentile that defines the usual change between consecutive images, and number of images before and after an image
# over which it is computed. Thresholds for repeated images are relative to the usual change. They were chosen with
# `tests/benchmarks/frozen.py` and 150 of its random clips; 10 % of 150 other clips without a fault are reported:
# noise-free scenes at rest, and scenes whose noise is removed by strong compression.
_MOST, _AROUND = 75, 48
_FEWEST = 12  # minimum number of images for estimating the typical change between consecutive images
_LEAST_CHANGE = 0.1  # minimum change [of 255 levels] that counts as noise or motion
# Maximum change, relative to the usual change, in a run of repeated images, and in a run of only one or two images.
_SAME, _ALIKE = 0.05, 0.03
# Lengths of runs of repeated images: maximum of a short run, minimum of a run that is compared with noise, minimum
# at a clip's end.
_SHORT, _SOME, _LONG = 2, 5, 12
# Range of the change before a run, and minimum change after it, both as multiples of the usual change.
_STOPS, _FARTHER = (0.5, 4.0), 1.25
# Numbers of images before and after a run over which encoders spread the stop and the start of motion.
_BEFORE, _AFTER = 6, 2
_NOISE = 1.0  # minimum 25th percentile of the changes around a run [of 255 levels] that is attributed to noise
_FAR_BELOW = 0.2  # maximum change in a run relative to the 25th percentile of the changes around the run
_REGULAR = 0.15  # number of short runs, as a fraction of all images, above which repetition counts as regular
_MISSING_SHARE = 0.01  # maximum fraction of frames without an image for a rate to count as constant

ARCHES = ("upper", "lower")
_SPREAD = 9  # number of frames sampled from a clip
_POINTS = 500  # maximum number of pixels sampled from a mask
_HALF = 128


def decoded_findings(video: Clip, camera: str) -> Iterator[Finding]:
    """Decode a clip, or parts of a long clip; yield errors for undecodable images, and warnings about the content.

    The kinds of findings are "clip_damaged", "interlaced" and "pictures_repeated".
    """
    finding = partial(Finding, path=str(video.path), camera=camera)
    repeated: list[tuple[int, int]] = []
    for first, last in _parts(video):
        try:
            changes = picture_changes(frame.image for frame in video.frames(first, last))
        except JawusdError as error:
            yield finding("clip_damaged", "error", error.message, hint=error.hint)
            break
        repeated += [(first + start, first + end) for start, end in repeated_runs(changes)]
    if video.is_interlaced:
        yield finding("interlaced", "warning", INTERLACED, hint=INTERLACED_HINT)
    if repeated:
        numbers = [video.timeline.numbers[[start, end]].tolist() for start, end in repeated]
        listed = ", ".join(f"{start} to {end}" if end > start else f"{start}" for start, end in numbers[:_LISTED])
        more = f" and {len(numbers) - _LISTED} more times" if len(numbers) > _LISTED else ""
        yield finding(
            "pictures_repeated",
            "warning",
            f"frames {listed}{more} repeat the previous image: the camera froze, or images were duplicated",
            sum(end - start + 1 for start, end in repeated),
            0,
            frame=numbers[0][0],
            hint="Export the clip again at its own frame rate, or exclude those frames from the take.",
        )


def _parts(video: Clip) -> list[tuple[int, int]]:
    """Return the ranges of images to decode: all images, or the ends of a long clip and parts in between."""
    most = int(_DECODED_PX / (video.size_px[0] * video.size_px[1]))
    if video.count <= most:
        return [(0, video.count)]
    end = min(round(_ENDS_S * video.fps), most // 3)
    starts = np.linspace(end, video.count - end - _PART, max(1, (most - 2 * end) // _PART)).astype(int)
    return [(0, end), *((start, start + _PART) for start in starts.tolist()), (video.count - end, video.count)]


def picture_changes(pictures: Iterable[NDArray[np.uint8]]) -> Array:
    """Return the mean difference [of 255 levels] between each gray image (h, w) and the previous one; NaN first."""
    before, changes = None, []
    for picture in pictures:
        shown = picture[::_SPARSE, ::_SPARSE].astype(np.int16)
        changes.append(np.nan if before is None else float(np.abs(shown - before).mean()))
        before = shown
    return np.array(changes)


def repeated_runs(changes: Array) -> list[tuple[int, int]]:
    """Return the first and last index of each run of repeated images, from `picture_changes` (n,).

    Encoders also repeat images of static scenes, but the changes then fade out and in; in a freeze they stop and resume
    abruptly. After one or two repeated images, the next change must be larger than usual, and larger than the one
    before the run (otherwise a light was switched off). Scenes that hardly change are skipped.
    """
    known = changes[1:]
    if len(known) < _FEWEST:
        return []
    around = sliding_window_view(np.pad(known, _AROUND, mode="edge"), 2 * _AROUND + 1)
    usual = np.maximum(np.percentile(around, _MOST, axis=1), np.percentile(known, _MOST))
    same = np.flatnonzero((known <= _SAME * usual) & (usual > _LEAST_CHANGE))
    runs = [(int(run[0]), int(run[-1])) for run in np.split(same, np.flatnonzero(np.diff(same) > 1) + 1) if len(run)]
    short = [
        run for run in runs if run[1] - run[0] < _SHORT and known[run[0] : run[1] + 1].max() <= _ALIKE * usual[run[0]]
    ]
    regular = len(short) > _REGULAR * len(known)  # frame rate conversion repeats images regularly
    found = [run for run in runs if (run in short and regular) or _stands_out(known, *run)]
    return [(first + 1, last + 1) for first, last in found]


def _stands_out(changes: Array, first: int, last: int) -> bool:
    """Return whether changes stop abruptly before a run of repeated images and resume abruptly after it."""
    outside = np.concatenate([changes[max(0, first - _AROUND) : first], changes[last + 1 : last + 1 + _AROUND]])
    if first == 0 or len(outside) < _FEWEST:
        return False  # many takes begin without motion, so a run at the start does not count as a freeze
    little, usual = np.percentile(outside, (100 - _MOST, _MOST))
    length, most = last - first + 1, changes[first : last + 1].max()
    # If even the most static images change (by noise or motion), the encoder did not cause the repeated images.
    restless = length >= _SOME and little > _NOISE and most <= _FAR_BELOW * little
    least = _STOPS[0] * (little if restless else usual)
    before = changes[max(0, first - (2 if length <= _SHORT else _BEFORE)) : first].max()
    if usual <= _LEAST_CHANGE or not least <= before <= _STOPS[1] * usual:
        return False
    if last + 1 == len(changes):
        return length >= _LONG
    if length <= _SHORT:
        after = changes[last + 1]
        beside = [changes[first - 1], *changes[last + 2 : last + 3]]
        alike = most <= _ALIKE * usual and min(beside) >= _STOPS[0] * usual
        return bool(alike and _FARTHER * max(beside) <= after <= _STOPS[1] * usual)
    after = changes[last + 1 : last + 1 + _AFTER].max()
    return bool(after >= (little if restless else _FARTHER * usual))


def rate_findings(videos: Mapping[str, Clip], fps: float, path: str) -> Iterator[Finding]:
    """Compare the frame rates of clips by camera with the rate [Hz] in the capture at `path`, and with one another."""
    for name, video in videos.items():
        rate, missing, count = video.timeline.rate, video.timeline.missing, video.timeline.count
        if abs(rate / fps - 1.0) > _RATE_TOLERANCE:
            said = f"fps is {fps:g} in the capture, but the clip has {rate:.3f} frames per second"
            hint = "Correct fps or convert the clip, otherwise speeds and times are wrong."
            yield Finding("fps_differs", "warning", said, rate, fps, path=path, camera=name, hint=hint)
        absent = partial(
            Finding, "pictures_missing", "warning", value=missing / count, path=str(video.path), camera=name
        )
        if isinstance(video, PictureSequence) and missing:
            yield absent(
                message=f"images {gaps(video.numbers.tolist())} are missing",
                hint="Export them again, or ignore this: those frames are tracked without this camera.",
            )
        elif missing / count > _MISSING_SHARE:
            yield absent(
                message=f"{missing} of {count} frames have no image: dropped frames or a variable rate",
                limit=_MISSING_SHARE,
                hint="Those frames are tracked without this camera.",
            )
    reference = next(iter(videos.values()), None)
    for name, video in videos.items():
        if reference is None or video.count < 2:
            continue
        drift = abs(video.timeline.rate / reference.timeline.rate - 1.0) * min(video.count, reference.count)
        if drift > max(_DRIFT_FRAMES, 1e-3 * min(video.count, reference.count)):
            yield Finding(
                "rates_differ",
                "warning",
                f"the clip has {video.timeline.rate:.3f} frames per second, but the clip of the first camera has "
                f"{reference.timeline.rate:.3f}: the clips drift apart by {drift:.1f} frames",
                drift,
                _DRIFT_FRAMES,
                path=str(video.path),
                camera=name,
                hint="Record all cameras at one rate, or convert the clips to one.",
            )


def survey_masks(source: CameraSource, size_px: tuple[int, int]) -> list[Finding]:
    """Return findings about the masks of one camera with images (width, height), from samples of the whole take.

    Kinds: "camera_without_masks" and "masks_black", warnings about unused masks; "mask_levels", a note about values
    other than 0 and full white; "masks_soft", a warning that the outline is ambiguous; "mask_polarity", a warning that
    it is ambiguous which level is teeth.

    Raises:
        CaptureError: the masks are missing or damaged, differ in size or number from the camera's images, or are not
            masks.
    """
    if source.masks is None:
        hint = "Add masks in capture.toml, or create them with `jawusd segment`."
        said = "the camera has no masks and is not used for tracking."
        return [Finding("camera_without_masks", "warning", said, camera=source.name, hint=hint)]
    readers = open_masks(source, size_px)
    hint = "Export the masks with the teeth in white, or remove `masks` of this camera."
    black = partial(Finding, "masks_black", "warning", camera=source.name, hint=hint)
    if all(reader.is_black for reader in readers):
        return [black(message="its masks are all black: it is not used for tracking.")]
    out = [
        black(message=f"the masks of the {arch} teeth are all black and are not used.")
        for arch, reader in zip(ARCHES, readers, strict=True)
        if reader.is_black
    ]
    upper, lower = (reader.levels for reader in readers)
    if upper is not None and upper == lower:
        return [*out, *_of_levels(source, "both rows of", upper)]
    for arch, levels in zip(ARCHES, (upper, lower), strict=True):
        if levels is not None:
            out += _of_levels(source, f"the {arch}", levels)
    return out


def odd_pictures(source: CameraSource, arch: str, odd: Sequence[str]) -> list[Finding]:
    """Return findings about mask images that are inconsistent with the other masks; see `MaskReader.odd`."""
    if not odd:
        return []
    more = f"; and {len(odd) - _LISTED} more" if len(odd) > _LISTED else ""
    said = f"{len(odd)} masks of the {arch} teeth are not used: {'; '.join(odd[:_LISTED])}{more}."
    hint = "Export these masks like the other masks."
    return [Finding("masks_odd", "warning", said, value=len(odd), camera=source.name, hint=hint)]


def _of_levels(source: CameraSource, rows: str, levels: MaskLevels) -> Iterator[Finding]:
    if not levels.usual:
        low, high = sorted((levels.background, levels.teeth))
        inverted = "; they are inverted, with teeth dark on light" if levels.inverted else ""
        channel = "transparency" if levels.plane == "alpha" else "masks"
        said = f"the {channel} of {rows} teeth have the values {low:g} and {high:g}: {levels.teeth:g} is taken as teeth"
        yield Finding("mask_levels", "note", f"{said}{inverted}.", value=levels.teeth, camera=source.name)
    if levels.soft > MOST_SOFT:
        yield Finding(
            "masks_soft",
            "warning",
            f"in the masks of {rows} teeth, {levels.soft:.0%} of the segmented pixels lie between background "
            f"({levels.background:g}) and teeth ({levels.teeth:g}); a fraction of at most {MOST_SOFT:.0%} is "
            "usual. The outline is placed midway.",
            value=round(levels.soft, 3),
            limit=MOST_SOFT,
            camera=source.name,
            hint="Export masks with edges a few pixels wide, not the masked footage.",
        )
    if levels.ambiguous:
        yield Finding(
            "mask_polarity",
            "warning",
            f"the masks of {rows} teeth have the values {levels.background:g} and {levels.teeth:g}, and it is "
            f"unclear which is the background; {levels.teeth:g} is taken as teeth.",
            camera=source.name,
            hint="Export the masks with teeth in white, on black up to the border of the image.",
        )


class MaskSamples:
    """Samples of the masks of one camera over a whole clip, by frame number of the camera itself.

    Attributes:
        counts: numbers of frames of the upper and the lower mask source.
        first_last: first and last frame with a mask, for the upper and the lower arch; None if the arch has no masks.
        first_frame: first frame with a mask of either arch, or None.
    """

    def __init__(self, source: CameraSource, size_px: tuple[int, int], files: ExitStack) -> None:
        """Sample the masks of a camera with images (width, height); the exit stack closes the masks.

        Raises:
            CaptureError: masks are missing, damaged, of the wrong size, or not masks.
        """
        upper, lower = self._readers = [files.enter_context(reader) for reader in open_masks(source, size_px)]
        self.counts = upper.count, lower.count
        self.first_last = _first_last(upper), _first_last(lower)
        self.first_frame = min((frames[0] for frames in self.first_last if frames is not None), default=None)

    def pixels(self, arch: int, frame: int) -> Array:
        """Return at most 500 pixels (x, y) of the mask of an arch (0 upper, 1 lower), (N, 2); N = 0 without a mask."""
        mask = self._readers[arch].read(frame)
        if mask is None:
            return np.empty((0, 2))
        y, x = np.nonzero(mask >= _HALF)
        chosen = slice(None, None, max(1, len(x) // _POINTS))
        return np.stack([x[chosen], y[chosen]], axis=1).astype(np.float64)


def _first_last(reader: MaskReader) -> tuple[int, int] | None:
    """Return the first and last frame with a mask, assuming no gaps between them, or None."""
    spread = np.unique(np.linspace(0, reader.count - 1, _SPREAD).round().astype(int)).tolist()
    shown = [frame for frame in spread if reader.read(frame) is not None]
    if not shown:
        return None
    before = max((frame for frame in spread if frame < shown[0]), default=-1)
    after = min((frame for frame in spread if frame > shown[-1]), default=reader.count)
    return _boundary(reader, shown[0], before), _boundary(reader, shown[-1], after)


def _boundary(reader: MaskReader, shown: int, empty: int) -> int:
    """Return the frame at which masks begin or end, found by bisection between a masked and an empty frame."""
    while abs(shown - empty) > 1:
        middle = (shown + empty) // 2
        if reader.read(middle) is not None:
            shown = middle
        else:
            empty = middle
    return shown
