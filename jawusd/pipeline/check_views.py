"""Checks that masks, frame numbers, camera views and picks of a capture are consistent with one another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, JawusdError
from jawusd.formats.finding import Finding, Severity
from jawusd.geometry import Camera
from jawusd.pipeline.check_files import Parts, found_error

_INSTANTS = 5  # number of video frames in which the views are compared
_CROWN_POINTS = 6000


def masks(parts: Parts) -> Iterator[Finding]:
    """Check a sample of the masks of every camera."""
    from jawusd.media.checks import MaskSamples, survey_masks
    from jawusd.media.masks import mask_size_px

    capture = parts.given
    sources = [camera for camera in capture.cameras if camera.masks is not None]
    if not sources:
        for camera in capture.cameras:
            if camera.video is None:
                yield Finding("no_masks", "error", "it has neither masks nor a video", camera=camera.name)
        return
    missing = False
    for source in capture.cameras:
        try:
            if source.masks is None:
                yield from survey_masks(source, (0, 0))
                continue
            usable = all(parts.usable(path) for path in (source.masks.upper, source.masks.lower))
            if not usable or not parts.clip_read(source):
                missing = True
                continue
            known = parts.cameras.get(source.name)
            video = parts.videos.get(source.name)
            size = known.size_px if known else video.size_px if video else mask_size_px(source.masks.upper)
            yield from survey_masks(source, size)
            sample = MaskSamples(source, size, parts.open_files)
        except JawusdError as error:
            missing = True
            yield found_error("masks", error, source.name)
            continue
        if sample.first_frame is not None:
            parts.samples[source.name] = sample
    if len(parts.samples) < 2 and not missing:
        message = f"masks of at least two cameras are needed; usable: {', '.join(parts.samples) or 'none'}"
        yield Finding("few_masks", "error", message, len(parts.samples), 2, path=parts.description)


def synchronisation(parts: Parts) -> Iterator[Finding]:
    """Check that the cameras can be aligned in time."""
    capture = parts.given
    if capture.sync.offsets is None and len(capture.cameras) > 1:
        silent = [camera.name for camera in capture.cameras if camera.video is None]
        if silent:
            message = f"no video for {', '.join(silent)}: the cameras cannot be aligned and are assumed simultaneous"
            hint = "Give [sync] offsets."
            yield Finding("taken_as_simultaneous", "warning", message, path=parts.description, hint=hint)


def frames(parts: Parts) -> Iterator[Finding]:
    """Check that the frame numbers given in the capture exist."""
    from jawusd.capture.camera_checks import swapped_cameras

    capture = parts.given
    count = _frame_count(parts, capture.reference)
    first, stop = capture.frames or (0, count or 0)

    def out_of(kind: str, what: str, frame: int, severity: Severity) -> Finding:
        message = f"{what} is {frame}; frames run from {first} to {stop - 1}"
        hint = "Correct it in capture.toml."
        return Finding(kind, severity, message, frame, stop - 1, path=parts.description, hint=hint)

    if count is None:
        return
    offsets = parts.offsets() or {}
    known = {name: _frame_count(parts, name) for name in offsets}
    # Other cameras may have footage or masks beyond the end of the reference camera.
    end = max([count, *(own + offsets[name] for name, own in known.items() if own is not None)])
    if stop > end:
        message = f"frames end at {stop - 1}, but the last frame of any camera is {end - 1}"
        yield Finding("frames_missing", "error", message, stop, end, path=parts.description, hint="Correct `frames`.")
    if capture.bootstrap is not None and not first <= capture.bootstrap.frame < stop:
        yield out_of("bootstrap_frame", "bootstrap.frame", capture.bootstrap.frame, "error")
    rest = capture.motion.rest_frame
    if rest is not None and not first <= rest < stop:
        yield out_of("rest_frame", "motion.rest_frame", rest, "error" if rest >= end else "warning")
    for name, offset in offsets.items():
        own = known[name]
        if own is not None and (first - offset >= own or stop - offset <= 0):
            message = f"with its offset of {offset:+d}, none of its {own} frames lies within the take"
            yield Finding("offset_wrong", "error", message, offset, camera=name, path=parts.description)
    ranges = {name: sample.first_last for name, sample in parts.samples.items() if name in offsets}
    for a, b in swapped_cameras(ranges, offsets, first, stop):
        message = (
            f"the masks of cameras {a} and {b} are swapped: with their offsets, they cover the take only after swapping"
        )
        hint = f"Swap the masks of cameras {a} and {b}, or their offsets."
        yield Finding("masks_cameras_exchanged", "error", message, path=parts.description, hint=hint)
    yield from _mask_ranges(parts, first, stop)


def _frame_count(parts: Parts, name: str) -> int | None:
    if name in parts.videos:
        return parts.videos[name].timeline.count
    return max(parts.samples[name].counts) if name in parts.samples else None


def _mask_ranges(parts: Parts, first: int, stop: int) -> Iterator[Finding]:
    """Report cameras whose masks cover only part of the take."""
    for name, sample in parts.samples.items():
        for arch, shown in zip(("upper", "lower"), sample.first_last, strict=True):
            if shown is None:
                continue
            length = shown[1] - shown[0] + 1
            if length < 0.9 * (stop - first):
                message = f"the masks of the {arch} teeth cover frames {shown[0]} to {shown[1]} of the camera, "
                message += f"{length} of the {stop - first} frames of the take"
                hint = "The other frames are tracked without this camera."
                yield Finding("masks_short", "warning", message, length, stop - first, camera=name, hint=hint)


def views(parts: Parts) -> Iterator[Finding]:
    """Check that the views of all cameras agree on the position and size of the teeth."""
    from jawusd.capture.camera_checks import centre_findings, width_findings

    reference = parts.samples.get(parts.given.reference)
    if reference is None or reference.first_frame is None:
        return
    cameras = {name: camera for name, camera in parts.cameras.items() if name in parts.samples}
    shown = [frames for frames in reference.first_last if frames is not None]
    instants = np.unique(np.linspace(min(f[0] for f in shown), max(f[1] for f in shown), _INSTANTS + 2)[1:-1].round())
    middles, pixels = [], []
    for instant in instants.astype(int).tolist():
        guesses = [_teeth(parts, cameras, instant, guess) for guess in parts.offset_guesses()]
        middles.append([{name: found.mean(0) for name, found in guess.items()} for guess in guesses])
        pixels.append(guesses[-1])
    yield from centre_findings(cameras, middles)
    yield from width_findings(cameras, max(pixels, key=lambda guess: sum(map(len, guess.values()))))


def _teeth(parts: Parts, cameras: Mapping[str, Camera], instant: int, offsets: Mapping[str, int]) -> dict[str, Array]:
    """Return, for cameras with masks of both arches, the mask pixels at a frame of the reference camera."""
    out = {}
    for name in cameras:
        if name not in offsets:
            continue
        arches = [parts.samples[name].pixels(arch, instant - offsets[name]) for arch in (0, 1)]
        if all(len(arch) for arch in arches):
            out[name] = np.concatenate(arches)
    return out


def picks(parts: Parts) -> Iterator[Finding]:
    """Check the picks for consistency, and against the masks; raises CaptureError if they are unusable."""
    from jawusd.tracking.initialization.pick_causes import Setting
    from jawusd.tracking.initialization.pick_checks import pick_findings

    capture = parts.given
    if capture.bootstrap is None:
        if not parts.samples:
            message = "has neither masks nor [bootstrap] picks: the teeth must be found in the footage"
            yield Finding("no_picks", "warning", message, path=parts.description, hint="Add picks.")
        return
    picked, meshes = capture.bootstrap, parts.meshes
    upper, lower = parts.scans
    given = Setting(
        (picked.upper, picked.lower),
        (meshes["upper_teeth"].vertices, meshes["lower_teeth"].vertices),
        (upper.crown_vertices(_CROWN_POINTS), lower.crown_vertices(_CROWN_POINTS)),
        parts.cameras,
    )
    guesses = parts.offset_guesses()
    # If the masks of two cameras were swapped, they may be numbered by the frames of either camera.
    seen = [_pixels(parts, picked.frame, guess, numbered) for guess in guesses for numbered in (0, 1)]
    try:
        yield from pick_findings(given, seen, [name for name in parts.cameras if name in parts.samples], picked.frame)
    except JawusdError as error:
        raise CaptureError(error.message, path=parts.description, frame=picked.frame, hint=error.hint) from error


def _pixels(
    parts: Parts, instant: int, offsets: Mapping[str, int], numbered: int
) -> Callable[[str, str], tuple[Array, Array]]:
    """Return a function that returns the mask pixels of one camera by arch, as if they were the masks of another.

    The masks are numbered by the frames of the other camera if `numbered` is 0, and by those of their own if it is 1.
    """

    @cache
    def pixels(source: str, camera: str) -> tuple[Array, Array]:
        by = (camera, source)[numbered]
        if source not in parts.samples or by not in offsets:
            return np.empty((0, 2)), np.empty((0, 2))
        frame, sample = instant - offsets[by], parts.samples[source]
        return sample.pixels(0, frame), sample.pixels(1, frame)

    return pixels
