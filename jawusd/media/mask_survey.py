"""What the masks of a capture contain, measured on a few frames in seconds, without tracking."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import cv2
import numpy as np

from jawusd.base.arrays import Array
from jawusd.formats.capture import CameraSource
from jawusd.formats.finding import Finding
from jawusd.media.mask_levels import MOST_SOFT, MaskImage, MaskLevels
from jawusd.media.masks import MaskReader, open_masks

ARCHES = ("upper", "lower")
_LISTED = 5
_SPREAD = 9  # frames looked at over a whole clip
_POINTS = 500  # pixels kept of a mask
_HALF = 128


def survey_masks(source: CameraSource, size_px: tuple[int, int]) -> list[Finding]:
    """Return what is to be said of the masks of one camera, from some pictures of the whole take.

    `size_px` is the (width, height) of the camera's pictures. Kinds: "camera_without_masks" and "masks_black", warnings
    of what is not used; "mask_levels", a note of values that are not 0 and full white; "masks_soft" and
    "mask_polarity", warnings that the outline, or background and teeth, can hardly be told apart.

    Raises:
        CaptureError: the masks cannot be used: missing, damaged, of another size or number than the camera's pictures,
            or pictures that are no masks; the message names the file and what it holds.
    """
    if source.masks is None:
        return [
            Finding(
                "camera_without_masks",
                "warning",
                "it has no masks and is not used for tracking.",
                camera=source.name,
                hint="Name its masks in capture.toml, or let `jawusd segment` make them.",
            )
        ]
    readers = open_masks(source, size_px)
    if all(reader.is_black for reader in readers):
        return [_black(source, "its masks are all black: it is not used for tracking.")]
    out = [
        _black(source, f"the masks of the {arch} teeth are all black and are not used.")
        for arch, reader in zip(ARCHES, readers, strict=True)
        if reader.is_black
    ]
    upper, lower = (reader.levels for reader in readers)
    if upper is not None and upper == lower:
        return out + _of_levels(source, "both rows of", upper)
    for arch, levels in zip(ARCHES, (upper, lower), strict=True):
        if levels is not None:
            out += _of_levels(source, f"the {arch}", levels)
    return out


def odd_pictures(source: CameraSource, arch: str, odd: Sequence[str]) -> list[Finding]:
    """Return what is to be said of pictures that contradict the others, see `MaskReader.odd`; empty without any."""
    if not odd:
        return []
    more = f"; and {len(odd) - _LISTED} more" if len(odd) > _LISTED else ""
    return [
        Finding(
            "masks_odd",
            "warning",
            f"{len(odd)} masks of the {arch} teeth are not used: {'; '.join(odd[:_LISTED])}{more}.",
            value=len(odd),
            camera=source.name,
            hint="Export them like the others.",
        )
    ]


def _black(source: CameraSource, message: str) -> Finding:
    return Finding(
        "masks_black",
        "warning",
        message,
        camera=source.name,
        hint="Check that they were exported with the teeth in white, or take `masks` of this camera out.",
    )


def _of_levels(source: CameraSource, rows: str, levels: MaskLevels) -> list[Finding]:
    out = []
    if not levels.usual:
        low, high = sorted((levels.background, levels.teeth))
        inverted = "; they are inverted, teeth dark on light" if levels.inverted else ""
        channel = "transparency" if levels.plane == "alpha" else "masks"
        out.append(
            Finding(
                "mask_levels",
                "note",
                f"the {channel} of {rows} teeth hold the values {low:g} and {high:g}: {levels.teeth:g} is "
                f"taken as teeth{inverted}.",
                value=levels.teeth,
                camera=source.name,
            )
        )
    if levels.soft > MOST_SOFT:
        out.append(
            Finding(
                "masks_soft",
                "warning",
                f"{levels.soft:.0%} of what the masks of {rows} teeth show lie between background "
                f"({levels.background:g}) and teeth ({levels.teeth:g}), at most {MOST_SOFT:.0%} are usual; the outline "
                "is taken half the way.",
                value=round(levels.soft, 3),
                limit=MOST_SOFT,
                camera=source.name,
                hint="Export masks with edges a few pixels wide, and not the footage cut out.",
            )
        )
    if levels.doubtful:
        out.append(
            Finding(
                "mask_polarity",
                "warning",
                f"the masks of {rows} teeth hold {levels.background:g} and {levels.teeth:g}, and border and area "
                f"of the pictures disagree about which is the background; {levels.teeth:g} is taken as teeth.",
                camera=source.name,
                hint="Export them with teeth in white on black, up to the border of the picture.",
            )
        )
    return out


@dataclass(frozen=True, eq=False)
class MaskSamples:
    """Hold what some masks of one camera show; frames are the camera's own."""

    counts: tuple[int, int]  # frames of the mask sources, upper and lower
    first_last: tuple[
        tuple[int, int] | None, tuple[int, int] | None
    ]  # frames with a mask of each arch, None: none found
    read: Callable[[int, int], MaskImage | None]  # arch, frame: the mask

    @property
    def first_frame(self) -> int | None:
        """Return the first frame with a mask of any arch."""
        return min((frames[0] for frames in self.first_last if frames is not None), default=None)

    def pixels(self, arch: int, frame: int) -> Array:
        """Return some pixels (x, y) of a mask, shape (N <= 500, 2); N = 0 where there is none."""
        mask = self.read(arch, frame)
        if mask is None:
            return np.empty((0, 2))
        y, x = np.nonzero(mask >= _HALF)
        chosen = slice(None, None, max(1, len(x) // _POINTS))
        return np.stack([x[chosen], y[chosen]], axis=1).astype(np.float64)


def sample_masks(source: CameraSource, size_px: tuple[int, int], files: ExitStack) -> MaskSamples:
    """Look at masks spread over a clip, and find the first and the last frame that has any.

    Args:
        source: a camera with masks.
        size_px: (width, height) of its pictures.
        files: closes the masks when it is closed.

    Raises:
        CaptureError: masks are missing, damaged, of another size or no masks.
    """
    pair = [files.enter_context(reader) for reader in open_masks(source, size_px)]
    ranges = tuple(_first_last(reader) for reader in pair)
    return MaskSamples(
        (pair[0].count, pair[1].count), (ranges[0], ranges[1]), lambda arch, frame: pair[arch].read(frame)
    )


def _first_last(reader: MaskReader) -> tuple[int, int] | None:
    """Return the first and the last frame with a mask, taking those between for masked, or None."""
    spread = np.unique(np.linspace(0, reader.count - 1, _SPREAD).round().astype(int)).tolist()
    shown = [frame for frame in spread if _shows(reader, frame)]
    if not shown:
        return None
    before = max((frame for frame in spread if frame < shown[0]), default=-1)
    after = min((frame for frame in spread if frame > shown[-1]), default=reader.count)
    return _boundary(reader, shown[0], before), _boundary(reader, shown[-1], after)


def _boundary(reader: MaskReader, shown: int, empty: int) -> int:
    """Return the frame with a mask that is nearest to the empty one, by bisection."""
    while abs(shown - empty) > 1:
        middle = (shown + empty) // 2
        if _shows(reader, middle):
            shown = middle
        else:
            empty = middle
    return shown


def _shows(reader: MaskReader, frame: int) -> bool:
    mask = reader.read(frame)
    return mask is not None and cv2.countNonZero(mask) > 0
