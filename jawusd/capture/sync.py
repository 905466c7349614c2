"""Align cameras in time by the light going off and on, else by their sound.

Pictures are placed by their presentation times: in a video of variable rate, frame k is the picture shown k nominal
frame durations after the first one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from jawusd.base.errors import SyncError
from jawusd.capture.clocks import offsets_by_clock, refuse_other_rates
from jawusd.capture.signals import (
    RATE_HZ,
    Offset,
    find_flashes,
    find_steps,
    match_sounds,
    match_steps,
    mean_brightness,
    on_grid,
)
from jawusd.formats.capture import Capture
from jawusd.formats.clip_source import ClipSource
from jawusd.formats.light_curve import LightCurve
from jawusd.media.audio import Sound, read_sound
from jawusd.media.clip import Clip
from jawusd.media.footage import open_clip
from jawusd.media.video import Video

_FPS_TOLERANCE = 5e-3  # people write 24 for 23.976
_EARLY_S = 2.0  # people stop their cameras one after the other


@dataclass(frozen=True)
class Alignment:
    """Hold the offsets of all cameras of a capture."""

    reference: str  # the camera that counts the frames
    cameras: dict[str, Offset]  # the offset per camera, in the order of the capture
    method: str = "light flash"  # "light flash", "sound", "time code" or "picture numbers"
    notes: tuple[str, ...] = ()  # remarks on the clips for the user

    @property
    def offsets(self) -> dict[str, int]:
        """Return the whole-frame offset per camera."""
        return {name: offset.frames for name, offset in self.cameras.items()}

    @property
    def confidence(self) -> dict[str, float]:
        """Return the confidence per camera, 0 .. 1."""
        return {name: offset.confidence for name, offset in self.cameras.items()}


def estimate_offsets(capture: Capture) -> Alignment:
    """Align the cameras of a capture by the light flashes, the sound or the clocks of their videos; see `align_videos`.

    Raises:
        SyncError: a camera has no video, or there are neither flashes nor sound to align by.
        CaptureError: a video cannot be read.
    """
    videos = {camera.name: camera.clip for camera in capture.cameras if camera.clip is not None}
    for camera in capture.cameras:
        if camera.video is None:
            raise SyncError(
                f"camera {camera.name} has no video to find light flashes in.",
                path=capture.folder / "capture.toml",
                hint=_offsets_hint([camera.name for camera in capture.cameras]),
            )
    if capture.sync.method in ("timecode", "numbers"):
        by = "time code" if capture.sync.method == "timecode" else "picture numbers"
        offsets, notes = offsets_by_clock(capture)
        return Alignment(capture.reference, offsets, by, notes)
    found = align_videos(videos, capture.reference, by_light=capture.sync.method != "audio")
    rate = open_clip(videos[capture.reference]).timeline.rate
    if abs(rate / capture.fps - 1) < _FPS_TOLERANCE:
        return found
    said = f"capture.toml says fps = {capture.fps:g}: motion is timed by it"
    note = f"the clips run at {rate:.6g} frames per second, {said}"
    return replace(found, notes=(*found.notes, note))


def align_videos(videos: Mapping[str, Path | ClipSource], reference: str, *, by_light: bool = True) -> Alignment:
    """Find the light flashes in all videos and align them with those of the reference camera.

    Only the beginning and the end of each video are decoded, more of it only while no flash is found. If a video shows
    no flash, or without `by_light`, and all have sound, the sound aligns them.

    Raises:
        SyncError: neither flash nor sound, rates that differ, or steps that do not fit together.
        CaptureError: a video cannot be read.
    """
    opened = {name: open_clip(clip) for name, clip in videos.items()}
    hint = _offsets_hint(videos)
    rate = opened[reference].timeline.rate
    refuse_other_rates(opened, reference)
    notes = _missing_pictures(opened)
    with ThreadPoolExecutor(max_workers=len(opened)) as pool:
        dark = None
        if by_light:
            found = dict(zip(opened, pool.map(find_flashes, opened.values())))
            dark = next((name for name in opened if found[name].reason), None)
        if by_light and dark is None:
            steps = {name: on_grid(found[name].steps, video.timeline.numbers) for name, video in opened.items()}
            offsets = {
                name: _against(name, reference, video, hint, partial(match_steps, steps[name], steps[reference], rate))
                for name, video in opened.items()
            }
            return Alignment(reference, offsets, "light flash", (*notes, *_stopped_early(opened, offsets, rate)))
        found_sounds = pool.map(
            lambda video: read_sound(video.path, RATE_HZ) if isinstance(video, Video) else None, opened.values()
        )
        sounds = {name: sound for name, sound in zip(opened, found_sounds) if sound is not None}
    why = "" if dark is None else f"camera {dark} {found[dark].reason}; "
    silent = [name for name in opened if name not in sounds]
    if silent:
        whose = "no clip has" if len(silent) == len(opened) else f"camera {silent[0]} has no"
        raise SyncError(f"{why}{whose} sound to go by.", path=opened[dark or silent[0]].path, hint=hint)
    offsets = {
        name: _against(name, reference, video, hint, partial(_by_sound, name, reference, sounds, opened, rate), why)
        for name, video in opened.items()
    }
    by_sound = (f"{why}the sound aligns the cameras",) if why else ()
    return Alignment(reference, offsets, "sound", (*by_sound, *notes, *_stopped_early(opened, offsets, rate)))


def light_curve(clip: Path | ClipSource) -> LightCurve:
    """Return the mean brightness of every picture of a video, and the sudden changes in it.

    Raises:
        CaptureError: the video cannot be read.
    """
    video = open_clip(clip)
    brightness = np.array([mean_brightness(frame.image) for frame in video.frames(threads=1)])
    numbers = video.timeline.numbers
    steps = on_grid(find_steps(brightness), numbers)
    off, on = (np.array([step.time_frames for step in steps if step.rising == rising]) for rising in (False, True))
    return LightCurve(video.times_s, numbers, brightness, off, on)


def _missing_pictures(videos: Mapping[str, Clip]) -> tuple[str, ...]:
    return tuple(
        f"camera {name} has a variable rate: {video.timeline.missing} of {video.timeline.count} frames have no picture "
        "of their own. Frames are counted by time; masks as PNG files are numbered by the pictures of their video."
        for name, video in videos.items()
        if video.timeline.missing
    )


def _stopped_early(videos: Mapping[str, Clip], offsets: Mapping[str, Offset], rate: float) -> tuple[str, ...]:
    """Return a note for every clip that ends long before the last one."""
    ends = {name: offsets[name].frames + video.timeline.count for name, video in videos.items()}
    last = max(ends, key=lambda name: ends[name])
    return tuple(
        f"camera {name} ends at frame {end - 1} of the reference camera, {ends[last] - end} frames before camera "
        f"{last}: it was stopped early or its clip was cut short."
        for name, end in ends.items()
        if ends[last] - end > _EARLY_S * rate
    )


def _by_sound(name: str, reference: str, sounds: Mapping[str, Sound], videos: Mapping[str, Clip], fps: float) -> Offset:
    if name == reference:
        return Offset(0, 0.0, 0.0, 0, 1.0)
    match = match_sounds(sounds[name], sounds[reference])
    exact = (match.delay_s - videos[reference].start_s + videos[name].start_s) * fps
    return Offset(round(exact), exact, 0.0, 0, match.confidence)


def _against(name: str, reference: str, video: Clip, hint: str, work: Callable[[], Offset], before: str = "") -> Offset:
    """Name the cameras in errors of comparing them."""
    try:
        return work()
    except SyncError as error:
        raise SyncError(
            f"{before}camera {name}, against {reference}: {error.statement()}", path=video.path, hint=hint
        ) from error


def _offsets_hint(names: Iterable[str]) -> str:
    return f"Give whole-frame offsets instead, in capture.toml: [sync] offsets = {{ {' = .., '.join(names)} = .. }}."
