"""Check the masks of a capture quickly on a few frames, without tracking."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.capture import CameraSource
from jawusd.formats.finding import Finding
from jawusd.media.mask_levels import MOST_SOFT, MaskImage, MaskLevels
from jawusd.media.masks import MaskReader, open_masks

ARCHES = ("upper", "lower")
_LISTED = 5
_SPREAD = 9  # number of frames sampled from a clip
_POINTS = 500  # maximum number of pixels sampled from a mask
_HALF = 128


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


@dataclass(frozen=True, eq=False)
class MaskSamples:
    """Samples of the masks of one camera, by frame number of the camera itself."""

    counts: tuple[int, int]  # numbers of frames of the upper and the lower mask source
    # First and last frame with a mask, for the upper and the lower arch; None if the arch has no masks.
    first_last: tuple[tuple[int, int] | None, tuple[int, int] | None]
    read: Callable[[int, int], MaskImage | None]  # reads the mask of an arch (0 upper, 1 lower) in a frame

    @property
    def first_frame(self) -> int | None:
        """Return the first frame with a mask of either arch."""
        return min((frames[0] for frames in self.first_last if frames is not None), default=None)

    def pixels(self, arch: int, frame: int) -> Array:
        """Return at most 500 sampled pixels (x, y) of a mask, shape (N, 2); N = 0 if there is no mask."""
        mask = self.read(arch, frame)
        if mask is None:
            return np.empty((0, 2))
        y, x = np.nonzero(mask >= _HALF)
        chosen = slice(None, None, max(1, len(x) // _POINTS))
        return np.stack([x[chosen], y[chosen]], axis=1).astype(np.float64)


def sample_masks(source: CameraSource, size_px: tuple[int, int], files: ExitStack) -> MaskSamples:
    """Sample the masks of a camera over a whole clip with images (width, height); the exit stack closes the masks.

    Raises:
        CaptureError: masks are missing, damaged, of the wrong size, or not masks.
    """
    pair = [files.enter_context(reader) for reader in open_masks(source, size_px)]
    ranges = tuple(_first_last(reader) for reader in pair)
    return MaskSamples(
        (pair[0].count, pair[1].count), (ranges[0], ranges[1]), lambda arch, frame: pair[arch].read(frame)
    )


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
