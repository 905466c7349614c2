"""Align cameras by what their clips say of time: time codes, or the numbers of their pictures."""

from __future__ import annotations

from collections.abc import Mapping

from jawusd.capture.light import Offset
from jawusd.errors import CaptureError, SyncError
from jawusd.formats.capture import Capture
from jawusd.formats.timecode import frame_of_timecode
from jawusd.imaging.clip import Clip
from jawusd.imaging.footage import open_clip

_DAY_S = 86400


def offsets_by_clock(capture: Capture) -> dict[str, Offset]:
    """Return the offset of every camera by `[sync] method`, "timecode" or "numbers".

    Raises:
        SyncError: a camera has no video, or its clip no such clock; the clips share no instant; or their rates differ.
        CaptureError: a clip cannot be read.
    """
    path = capture.folder / "capture.toml"
    clips: dict[str, Clip] = {}
    for camera in capture.cameras:
        if camera.clip is None:
            raise SyncError("has no video, so there is no clock to align it by.", camera=camera.name, path=path)
        clips[camera.name] = open_clip(camera.clip)
    starts = _timecodes(clips) if capture.sync.method == "timecode" else _numbers(capture, clips)
    reference = starts[capture.reference]
    day = round(_DAY_S * clips[capture.reference].timeline.rate)
    out = {}
    for name, start in starts.items():
        offset = start - reference
        if capture.sync.method == "timecode" and abs(offset) > day // 2:
            offset -= day if offset > 0 else -day  # recorded over midnight
        if offset >= clips[capture.reference].timeline.count or -offset >= clips[name].timeline.count:
            raise SyncError(
                f"begins {abs(offset)} frames {'after' if offset > 0 else 'before'} camera {capture.reference} by its "
                f"{capture.sync.method}: the clips share no instant.",
                camera=name,
                path=clips[name].path,
                hint="Check that the clips are of one take; align them by light flashes instead, or give "
                "[sync] offsets.",
            )
        out[name] = Offset(offset, float(offset), 0.0, 0, 1.0)
    return out


def _timecodes(clips: Mapping[str, Clip]) -> dict[str, int]:
    out = {}
    for name, clip in clips.items():
        if not clip.timecode:
            raise SyncError(
                "its clip carries no time code.",
                camera=name,
                path=clip.path,
                hint='Give that of the first picture, timecode = "HH:MM:SS:FF" in its [[camera]], or align by light.',
            )
        try:
            out[name] = frame_of_timecode(clip.timecode, clip.timeline.rate)
        except CaptureError as error:
            raise SyncError(error.message, camera=name, path=clip.path) from error
    return out


def _numbers(capture: Capture, clips: Mapping[str, Clip]) -> dict[str, int]:
    given = {camera.name: camera.start_frame for camera in capture.cameras}
    return {
        name: int(clip.timeline.stored[0]) if given[name] is None else int(given[name] or 0)
        for name, clip in clips.items()
    }
