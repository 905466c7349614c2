"""Synchronise cameras by the clocks of their clips: time codes or image numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from jawusd.base.errors import CaptureError, SyncError
from jawusd.capture.signals import Offset
from jawusd.formats.capture import Capture
from jawusd.formats.clips import frame_of_timecode
from jawusd.media.clip import Clip
from jawusd.media.footage import open_clip

_DAY_S = 86400
_RATE_TOLERANCE = 1e-3
_NEARLY_WHOLE = 0.01
_FASTEST_USUAL = 30.5  # frame rate [Hz] above which two or four images often have the same time code


def check_frame_rates(clips: Mapping[str, Clip], reference: str) -> None:
    """Check that all clips have the frame rate of the reference camera.

    Raises:
        SyncError: a clip has a different frame rate.
    """
    rate = clips[reference].timeline.rate
    for name, clip in clips.items():
        if abs(clip.timeline.rate / rate - 1) > _RATE_TOLERANCE:
            raise SyncError(
                f"camera {name} has {clip.timeline.rate:.6g} frames per second, but camera {reference} has {rate:.6g}.",
                path=clip.path,
                hint="Offsets in whole frames need equal frame rates: convert the videos to one rate.",
            )


def offsets_by_clock(capture: Capture) -> tuple[dict[str, Offset], tuple[str, ...]]:
    """Return the offset of each camera, and notes for the user, from the clock in `[sync] method`.

    Raises:
        SyncError: a camera has no video or its clip does not have this clock, the clips do not overlap in time, or the
            frame rates of the clips differ.
        CaptureError: a clip cannot be read.
    """
    path = capture.folder / "capture.toml"
    clips: dict[str, Clip] = {}
    for camera in capture.cameras:
        if camera.clip is None:
            raise SyncError("has no video, so there is no clock for synchronisation.", camera=camera.name, path=path)
        clips[camera.name] = open_clip(camera.clip)
    check_frame_rates(clips, capture.reference)
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


def _frames_of_number(clip: Clip) -> int:
    """Return the number of images that have the same time code.

    Raises:
        CaptureError: the number is not an integer.
    """
    ratio = clip.timeline.rate / (clip.timecode_fps or clip.timeline.rate)
    if round(ratio) < 1 or abs(ratio / round(ratio) - 1) > _NEARLY_WHOLE:
        raise CaptureError(
            f"the time code has {clip.timecode_fps:.6g} frames per second, which is not an integer fraction of the "
            f"clip's {clip.timeline.rate:.6g} frames per second.",
            hint="State the time code of the first frame at the frame rate of the clip, or synchronise "
            "by light flashes.",
        )
    return round(ratio)


def _timecodes(clips: Mapping[str, Clip]) -> dict[str, int]:
    out = {}
    for name, clip in clips.items():
        if not clip.timecode:
            raise SyncError(
                "the clip has no time code.",
                camera=name,
                path=clip.path,
                hint='Set timecode = "HH:MM:SS:FF" of the first frame in this [[camera]], or '
                "synchronise by light flashes.",
            )
        try:
            shared = _frames_of_number(clip)
            out[name] = shared * frame_of_timecode(clip.timecode, clip.timeline.rate / shared)
        except CaptureError as error:
            raise SyncError(error.message, camera=name, path=clip.path, hint=error.hint) from error
    return out


def _numbers(capture: Capture, clips: Mapping[str, Clip]) -> dict[str, int]:
    given = {camera.name: camera.start_frame for camera in capture.cameras}
    return {
        name: int(clip.timeline.stored[0]) if given[name] is None else int(given[name] or 0)
        for name, clip in clips.items()
    }
