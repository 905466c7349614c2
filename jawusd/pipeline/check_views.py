"""Checks of the footage of a capture: clips, calibration, masks, frames, and whether they fit one another."""

from __future__ import annotations

import filecmp
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CaptureError, JawusdError
from jawusd.formats.finding import Finding, Severity
from jawusd.geometry import Camera
from jawusd.pipeline.cameras import load_cameras, rescaled_cameras
from jawusd.pipeline.check_parts import Parts, found_error

_INSTANTS = 5  # at which the views are compared
_CROWN_POINTS = 6000


def clips(parts: Parts) -> Iterator[Finding]:
    """Open every clip and decode it, long ones in parts."""
    from jawusd.media.clip_checks import decoded_findings, rate_findings
    from jawusd.media.footage import open_clip

    for camera in parts.given.cameras:
        if camera.clip is None or not parts.usable(camera.clip.path):
            continue
        try:
            video = open_clip(camera.clip)
        except JawusdError as error:
            yield replace(found_error("clip", error), camera=camera.name)
            continue
        parts.videos[camera.name] = video
    with ThreadPoolExecutor() as pool:
        for found in pool.map(lambda item: list(decoded_findings(item[1], item[0])), parts.videos.items()):
            yield from found
    yield from _copies({name: video.path for name, video in parts.videos.items()})
    yield from rate_findings(parts.videos, parts.given.fps, parts.description)


def _copies(clips: Mapping[str, Path]) -> Iterator[Finding]:
    """Find clips that are copies of one file: of two cameras no clips are alike to the byte."""
    for one, other in combinations(clips, 2):
        paths = clips[one], clips[other]
        if not all(path.is_file() for path in paths) or not filecmp.cmp(*paths, shallow=False):
            continue
        message = f"its clip {paths[1].name} is a copy of {paths[0].name}, the clip of camera {one}"
        hint = "Copy the clip of this camera again."
        yield Finding("clips_alike", "error", message, path=str(paths[1]), camera=other, hint=hint)


def calibration(parts: Parts) -> Iterator[Finding]:
    """Read the calibration and judge it."""
    from jawusd.capture.camera_checks import camera_findings

    capture = parts.given
    if capture.calibration is None:
        if capture.boards is None:
            message = 'has neither "calibration" nor [boards] to make one from'
            hint = "Name a calibration file, or clips of a calibration board."
            yield Finding("no_calibration", "error", message, path=parts.description, hint=hint)
        return
    if not parts.usable(capture.calibration) or not all(parts.clip_read(camera) for camera in capture.cameras):
        return  # a clip tells the size that its camera must be brought to
    if len(capture.cameras) < 2:
        message = "has one camera; two or more are needed to track teeth in space"
        yield Finding("one_camera", "error", message, 1, 2, path=parts.description)
    parts.cameras = {camera.name: camera for camera in load_cameras(capture)}
    yield from camera_findings(list(parts.cameras.values()), str(capture.calibration))
    yield from _rescaled(parts)


def _rescaled(parts: Parts) -> Iterator[Finding]:
    """Say whose calibration is of another picture size; of some cameras only it is a mistake rather than a mode."""
    found = rescaled_cameras(parts.given)
    for name, (was, now) in found.items():
        every = len(found) == len(parts.cameras)
        message = (
            f"it is calibrated at {was[0]} x {was[1]} px, its pictures or masks have the size {now[0]} x {now[1]} "
        )
        message += "px: taken as the same picture, scaled" + ("" if every else "; the other cameras' sizes agree")
        hint = "Check that its masks were not made at a reduced size; picks count in the pixels of the calibration."
        severity: Severity = "note" if every else "warning"
        yield Finding("calibration_rescaled", severity, message, camera=name, hint=hint)


def boards(parts: Parts) -> Iterator[Finding]:
    """Open the board clips, where a calibration must be made from them."""
    from jawusd.media.clip_checks import decoded_findings
    from jawusd.media.footage import open_clip

    capture = parts.given
    if capture.boards is None or capture.calibration is not None:
        return
    for path, camera in zip(capture.boards.videos, capture.cameras, strict=True):
        if not parts.usable(path):
            continue
        try:
            video = open_clip(path)
        except JawusdError as error:
            yield replace(found_error("board_clip", error), camera=camera.name)
            continue
        yield from decoded_findings(video, camera.name)
        own = parts.videos.get(camera.name)
        if own is not None and abs(video.size_px[0] * own.size_px[1] / own.size_px[0] - video.size_px[1]) > 1.0:
            yield Finding(
                "board_shape",
                "error",
                f"its board clip is {video.size_px[0]} x {video.size_px[1]} px, its video {own.size_px[0]} x "
                f"{own.size_px[1]} px, another shape",
                path=str(path),
                camera=camera.name,
                hint="Record the boards in the mode of the take.",
            )


def masks(parts: Parts) -> Iterator[Finding]:
    """Look at some masks of every camera."""
    from jawusd.media.mask_survey import sample_masks, survey_masks
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
            sample = sample_masks(source, size, parts.open_files)
        except JawusdError as error:
            found = found_error("masks", error)
            missing = True
            yield replace(found, camera=source.name)
            continue
        if sample.first_frame is not None:
            parts.samples[source.name] = sample
    if len(parts.samples) < 2 and not missing:
        names = ", ".join(parts.samples) or "none"
        message = f"masks of two cameras or more are needed, those that can be used are of: {names}"
        yield Finding("few_masks", "error", message, len(parts.samples), 2, path=parts.description)


def synchronisation(parts: Parts) -> Iterator[Finding]:
    """Look whether there is something to align the cameras by."""
    capture = parts.given
    if capture.sync.offsets is None and len(capture.cameras) > 1:
        silent = [camera.name for camera in capture.cameras if camera.video is None]
        if silent:
            yield Finding(
                "taken_as_simultaneous",
                "warning",
                f"{', '.join(silent)} without a video: the cameras cannot be aligned in time and count as simultaneous",
                path=parts.description,
                hint="Give [sync] offsets.",
            )


def frames(parts: Parts) -> Iterator[Finding]:
    """Look whether the frames that the capture names exist."""
    from jawusd.capture.mask_checks import swapped_cameras

    capture = parts.given
    count = _frame_count(parts, capture.reference)
    first, stop = capture.frames or (0, count or 0)

    def out_of(kind: str, what: str, frame: int, severity: Severity) -> Finding:
        message = f"{what} is {frame}, frames run from {first} to {stop - 1}"
        hint = "Correct it in capture.toml."
        return Finding(kind, severity, message, frame, stop - 1, path=parts.description, hint=hint)

    if count is None:
        return
    offsets = parts.offsets() or {}
    known = {name: _frame_count(parts, name) for name in offsets}
    # the reference camera may end, or lack masks, before others do
    end = max([count, *(own + offsets[name] for name, own in known.items() if own is not None)])
    if stop > end:
        message = f"frames end at {stop - 1}, but no camera has any after {end - 1}"
        yield Finding("frames_missing", "error", message, stop, end, path=parts.description, hint="Correct frames.")
    if capture.bootstrap is not None and not first <= capture.bootstrap.frame < stop:
        yield out_of("bootstrap_frame", "bootstrap.frame", capture.bootstrap.frame, "error")
    rest = capture.motion.rest_frame
    if rest is not None and not first <= rest < stop:
        yield out_of("rest_frame", "motion.rest_frame", rest, "error" if rest >= end else "warning")
    for name, offset in offsets.items():
        own = known[name]
        if own is not None and (first - offset >= own or stop - offset <= 0):
            message = f"none of its {own} frames lies within the frames of the take, by its offset of {offset:+d}"
            yield Finding("offset_wrong", "error", message, offset, camera=name, path=parts.description)
    ranges = {name: sample.first_last for name, sample in parts.samples.items() if name in offsets}
    for a, b in swapped_cameras(ranges, offsets, first, stop):
        message = (
            f"the masks of cameras {a} and {b} are exchanged: by their offsets, each has masks of all frames of the "
            "take only if it takes those of the other"
        )
        hint = f"Exchange the masks of cameras {a} and {b}, or their offsets."
        yield Finding("masks_cameras_exchanged", "error", message, path=parts.description, hint=hint)
    yield from _mask_ranges(parts, first, stop)


def _frame_count(parts: Parts, name: str) -> int | None:
    if name in parts.videos:
        return parts.videos[name].timeline.count
    return max(parts.samples[name].counts) if name in parts.samples else None


def _mask_ranges(parts: Parts, first: int, stop: int) -> Iterator[Finding]:
    """Say which cameras have masks for a part of the take only."""
    for name, sample in parts.samples.items():
        for arch, shown in zip(("upper", "lower"), sample.first_last, strict=True):
            if shown is None:
                continue
            length = shown[1] - shown[0] + 1
            if length < 0.9 * (stop - first):
                message = f"the masks of the {arch} teeth cover frames {shown[0]} to {shown[1]} of the camera, "
                message += f"{length} of the {stop - first} frames of the take"
                hint = "The rest is tracked without this camera."
                yield Finding("masks_short", "warning", message, length, stop - first, camera=name, hint=hint)


def views(parts: Parts) -> Iterator[Finding]:
    """Look whether the cameras see the teeth at one place, of the size of teeth."""
    from jawusd.capture.mask_checks import centre_findings, width_findings

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
    """Return some pixels of both rows of teeth at an instant of the reference camera, by camera that shows both."""
    out = {}
    for name in cameras:
        if name not in offsets:
            continue
        arches = [parts.samples[name].pixels(arch, instant - offsets[name]) for arch in (0, 1)]
        if all(len(arch) for arch in arches):
            out[name] = np.concatenate(arches)
    return out


def picks(parts: Parts) -> Iterator[Finding]:
    """Look whether the picks agree with one another and with the masks.

    Raises:
        CaptureError: they cannot be used.
    """
    from jawusd.tracking.initialization.pick_causes import Setting
    from jawusd.tracking.initialization.pick_checks import pick_findings

    capture = parts.given
    if capture.bootstrap is None:
        if not parts.samples:
            message = "has neither masks nor [bootstrap] picks: the teeth must be found in the footage alone"
            yield Finding("no_picks", "warning", message, path=parts.description, hint="Give picks.")
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
    # Exchanged masks keep the numbers of the camera that they show, unless they were numbered to fit the other one.
    seen = [partial(_pixels, parts, picked.frame, guess, {}, numbered) for guess in guesses for numbered in (0, 1)]
    try:
        yield from pick_findings(given, seen, [name for name in parts.cameras if name in parts.samples], picked.frame)
    except JawusdError as error:
        raise CaptureError(error.message, path=parts.description, frame=picked.frame, hint=error.hint) from error


def _pixels(
    parts: Parts,
    instant: int,
    offsets: Mapping[str, int],
    known: dict[tuple[str, str], tuple[Array, Array]],
    numbered: int,
    source: str,
    camera: str,
) -> tuple[Array, Array]:
    """Return pixels of both arches' masks of a source as if they were those of a camera, at a reference instant.

    `numbered` is 0 if their frames are those of the camera, 1 if those of the source.
    """
    nothing = np.empty((0, 2))
    by = (camera, source)[numbered]
    if source not in parts.samples or by not in offsets:
        return nothing, nothing
    if (source, camera) not in known:
        frame = instant - offsets[by]
        sample = parts.samples[source]
        known[source, camera] = (sample.pixels(0, frame), sample.pixels(1, frame))
    return known[source, camera]
