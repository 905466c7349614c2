"""Synchronise cameras by light flashes or sound, or by the time codes or image numbers of their clips.

Images are counted by their presentation times: in a video with a variable frame rate, frame k is the image shown k
nominal frame durations after the first one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jawusd.base.errors import CaptureError, SyncError
from jawusd.capture.signals import (
    RATE_HZ,
    Offset,
    find_flashes,
    find_steps,
    match_sounds,
    match_steps,
    mean_brightness,
    to_frames,
)
from jawusd.formats.capture import Capture
from jawusd.formats.clips import ClipSource, LightCurve, frame_of_timecode
from jawusd.media.clip import Clip
from jawusd.media.containers import Sound, read_sound
from jawusd.media.footage import open_clip
from jawusd.media.video import Video

_FPS_TOLERANCE = 5e-3  # maximum relative difference of equal frame rates; 24 and 23.976 are equal
_EARLY_S = 2.0  # time before the end of the last clip; clips that end earlier are reported


@dataclass(frozen=True)
class Alignment:
    """Offsets of all cameras of a capture."""

    reference: str  # camera whose frame numbers are used for all cameras
    cameras: dict[str, Offset]  # offset of each camera, in the order of the capture
    method: str = "light flash"  # One of "light flash", "sound", "time code" and "frame numbers".
    notes: tuple[str, ...] = ()  # Remarks on the clips for the user.

    @property
    def offsets(self) -> dict[str, int]:
        """Return the offset of each camera in whole frames."""
        return {name: offset.frames for name, offset in self.cameras.items()}

    @property
    def confidence(self) -> dict[str, float]:
        """Return the confidence of each camera's offset, 0 to 1."""
        return {name: offset.confidence for name, offset in self.cameras.items()}


def estimate_offsets(capture: Capture) -> Alignment:
    """Synchronise the cameras of a capture by light flashes, sound or clocks of their videos; see `align_videos`.

    Raises:
        SyncError: a camera has no video, the videos have neither light flashes nor sound, or a clip lacks the clock,
            has another frame rate or does not overlap the others in time.
        CaptureError: a video cannot be read.
    """
    videos = {camera.name: camera.clip for camera in capture.cameras if camera.clip is not None}
    for camera in capture.cameras:
        if camera.video is None:
            raise SyncError(
                f"camera {camera.name} has no video to search for light flashes.",
                path=capture.file,
                hint=_offsets_hint([camera.name for camera in capture.cameras]),
            )
    if capture.sync.method in ("timecode", "numbers"):
        by = "time code" if capture.sync.method == "timecode" else "frame numbers"
        offsets, notes = _offsets_by_clock(capture, {name: open_clip(video) for name, video in videos.items()})
        return Alignment(capture.reference, offsets, by, notes)
    found = align_videos(videos, capture.reference, by_light=capture.sync.method != "audio")
    rate = open_clip(videos[capture.reference]).timeline.rate
    if abs(rate / capture.fps - 1) < _FPS_TOLERANCE:
        return found
    said = f"but capture.toml has fps = {capture.fps:g}, which is used as the time base"
    note = f"the clips run at {rate:.6g} frames per second, {said}"
    return replace(found, notes=(*found.notes, note))


def align_videos(videos: Mapping[str, Path | ClipSource], reference: str, *, by_light: bool = True) -> Alignment:
    """Synchronise videos with the reference camera by light flashes or sound.

    Decode the start and the end of each video, then more until flashes are found. If a video has no flash, or
    `by_light` is false, use the sound, which all videos must then have.

    Raises:
        SyncError: the videos have neither light flashes nor sound, frame rates differ, or the signals do not match.
        CaptureError: a video cannot be read.
    """
    opened = {name: open_clip(clip) for name, clip in videos.items()}
    rate = opened[reference].timeline.rate
    _check_frame_rates(opened, reference)
    notes = _missing_pictures(opened)
    with ThreadPoolExecutor(max_workers=len(opened)) as pool:
        dark = None
        if by_light:
            found = dict(zip(opened, pool.map(find_flashes, opened.values())))
            dark = next((name for name in opened if found[name][1]), None)
        if by_light and dark is None:
            steps = {name: to_frames(found[name][0], video.timeline.numbers) for name, video in opened.items()}
            offsets = _compared(opened, reference, lambda name: match_steps(steps[name], steps[reference], rate))
            return Alignment(reference, offsets, "light flash", (*notes, *_stopped_early(opened, offsets, rate)))
        found_sounds = pool.map(
            lambda video: read_sound(video.path, RATE_HZ) if isinstance(video, Video) else None, opened.values()
        )
        sounds = {name: sound for name, sound in zip(opened, found_sounds) if sound is not None}
    why = "" if dark is None else f"camera {dark} {found[dark][1]}; "
    silent = [name for name in opened if name not in sounds]
    if silent:
        whose = "no clip has" if len(silent) == len(opened) else f"camera {silent[0]} has no"
        raise SyncError(
            f"{why}{whose} sound to use instead.", path=opened[dark or silent[0]].path, hint=_offsets_hint(videos)
        )
    offsets = _compared(opened, reference, lambda name: _by_sound(name, reference, sounds, opened, rate), why)
    by_sound = (f"{why}the cameras are synchronised by sound",) if why else ()
    return Alignment(reference, offsets, "sound", (*by_sound, *notes, *_stopped_early(opened, offsets, rate)))


def light_curve(clip: Path | ClipSource) -> LightCurve:
    """Return the mean brightness of every image of a video, and the times of sudden brightness changes.

    Raises:
        CaptureError: the video cannot be read.
    """
    video = open_clip(clip)
    brightness = np.array([mean_brightness(frame.image) for frame in video.frames(threads=1)])
    numbers = video.timeline.numbers
    steps = to_frames(find_steps(brightness), numbers)
    off, on = (np.array([step.time_frames for step in steps if step.rising == rising]) for rising in (False, True))
    return LightCurve(video.times_s, numbers, brightness, off, on)


def _missing_pictures(videos: Mapping[str, Clip]) -> tuple[str, ...]:
    return tuple(
        f"camera {name} has a variable frame rate: {video.timeline.missing} of {video.timeline.count} frames have no "
        "image. Frames are counted by time, but masks in PNG files are numbered by the images of their video."
        for name, video in videos.items()
        if video.timeline.missing
    )


def _stopped_early(videos: Mapping[str, Clip], offsets: Mapping[str, Offset], rate: float) -> tuple[str, ...]:
    """Return a note for each clip that ends more than `_EARLY_S` before the last clip ends."""
    ends = {name: offsets[name].frames + video.timeline.count for name, video in videos.items()}
    last = max(ends, key=lambda name: ends[name])
    return tuple(
        f"camera {name} ends at frame {end - 1} of the reference camera, {ends[last] - end} frames before camera "
        f"{last}: it was stopped early or its clip is truncated."
        for name, end in ends.items()
        if ends[last] - end > _EARLY_S * rate
    )


def _by_sound(name: str, reference: str, sounds: Mapping[str, Sound], videos: Mapping[str, Clip], fps: float) -> Offset:
    if name == reference:
        return Offset(0, 0.0, 0.0, 0, 1.0)
    delay_s, confidence = match_sounds(sounds[name], sounds[reference])
    exact = (delay_s - videos[reference].start_s + videos[name].start_s) * fps
    return Offset(round(exact), exact, 0.0, 0, confidence)


def _compared(
    videos: Mapping[str, Clip], reference: str, offset_of: Callable[[str], Offset], before: str = ""
) -> dict[str, Offset]:
    """Return the offset of each camera from the reference camera; errors name both cameras."""
    out = {}
    for name, video in videos.items():
        try:
            out[name] = offset_of(name)
        except SyncError as error:
            message = f"{before}camera {name}, compared with {reference}: {error.statement()}"
            raise SyncError(message, path=video.path, hint=_offsets_hint(videos)) from error
    return out


def _offsets_hint(names: Iterable[str]) -> str:
    return f"Set whole-frame offsets in capture.toml instead: [sync] offsets = {{ {' = .., '.join(names)} = .. }}."


_DAY_S = 86400
_RATE_TOLERANCE = 1e-3
_NEARLY_WHOLE = 0.01
_FASTEST_USUAL = 30.5  # frame rate [Hz] above which two or four images often have the same time code


def _check_frame_rates(clips: Mapping[str, Clip], reference: str) -> None:
    """Raise SyncError if a clip does not have the frame rate of the reference camera."""
    rate = clips[reference].timeline.rate
    for name, clip in clips.items():
        if abs(clip.timeline.rate / rate - 1) > _RATE_TOLERANCE:
            raise SyncError(
                f"camera {name} has {clip.timeline.rate:.6g} frames per second, but camera {reference} has {rate:.6g}.",
                path=clip.path,
                hint="Offsets in whole frames need equal frame rates: convert the videos to one rate.",
            )


def _offsets_by_clock(capture: Capture, clips: Mapping[str, Clip]) -> tuple[dict[str, Offset], tuple[str, ...]]:
    """Return the offset of each camera, and notes for the user, from the clock in `[sync] method`."""
    _check_frame_rates(clips, capture.reference)
    by_code = capture.sync.method == "timecode"
    starts = _timecodes(clips) if by_code else _numbers(capture, clips)
    reference = starts[capture.reference]
    day = round(_DAY_S * clips[capture.reference].timeline.rate)
    out = {}
    for name, start in starts.items():
        offset = start - reference
        if by_code and abs(offset) > day // 2:
            offset -= day if offset > 0 else -day  # time codes start again at midnight
        if offset >= clips[capture.reference].timeline.count or -offset >= clips[name].timeline.count:
            raise SyncError(
                f"according to its {capture.sync.method}, starts {abs(offset)} frames "
                f"{'after' if offset > 0 else 'before'} camera {capture.reference}: the clips do not overlap in time.",
                camera=name,
                path=clips[name].path,
                hint="Check that the clips belong to one take, synchronise by light flashes, or set [sync] offsets.",
            )
        out[name] = Offset(offset, float(offset), 0.0, 0, 1.0)
    return out, tuple(_notes(clips)) if by_code else ()


def _notes(clips: Mapping[str, Clip]) -> Iterator[str]:
    for name, clip in clips.items():
        rate, counted = clip.timeline.rate, clip.timecode_fps
        if counted is None and rate > _FASTEST_USUAL:
            yield (
                f"camera {name}: its time code is assumed to count {rate:.6g} frames per second, since the file does "
                "not specify it"
            )
        elif counted is not None and (shared := round(rate / counted)) > 1:
            yield (
                f"camera {name}: its time code counts {counted:.6g} numbers per second, so {shared} frames share one: "
                f"the offset is accurate to {shared} frames only"
            )


def _timecodes(clips: Mapping[str, Clip]) -> dict[str, int]:
    out = {}
    for name, clip in clips.items():
        try:
            out[name] = _timecode_frame(clip)
        except CaptureError as error:
            raise SyncError(error.message, camera=name, path=clip.path, hint=error.hint) from error
    return out


def _timecode_frame(clip: Clip) -> int:
    """Return the frame number that the time code of a clip's first image states; raises CaptureError if it cannot."""
    if not clip.timecode:
        hint = 'Set timecode = "HH:MM:SS:FF" of the first frame in this [[camera]], or synchronise by light flashes.'
        raise CaptureError("the clip has no time code.", hint=hint)
    ratio = clip.timeline.rate / (clip.timecode_fps or clip.timeline.rate)
    shared = round(ratio)  # number of images that have the same time code
    if shared < 1 or abs(ratio / shared - 1) > _NEARLY_WHOLE:
        raise CaptureError(
            f"the time code has {clip.timecode_fps:.6g} frames per second, which is not an integer fraction of the "
            f"clip's {clip.timeline.rate:.6g} frames per second.",
            hint="State the time code of the first frame at the frame rate of the clip, or synchronise "
            "by light flashes.",
        )
    return shared * frame_of_timecode(clip.timecode, clip.timeline.rate / shared)


def _numbers(capture: Capture, clips: Mapping[str, Clip]) -> dict[str, int]:
    given = {camera.name: camera.start_frame for camera in capture.cameras}
    return {
        name: int(clip.timeline.stored[0]) if given[name] is None else int(given[name] or 0)
        for name, clip in clips.items()
    }
