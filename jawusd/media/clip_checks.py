"""Can the clips of a capture be read, and do they fit one another? A few pictures of each are decoded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from jawusd.base.errors import JawusdError
from jawusd.formats.finding import Finding
from jawusd.formats.numbered import gaps
from jawusd.media.clip import INTERLACED, INTERLACED_HINT, Clip
from jawusd.media.picture_sequence import PictureSequence

# Cameras that drift apart by less than this over a take keep their offset [frames].
_DRIFT_FRAMES = 0.5
# Rates stated to three digits differ from the file's by less; 23.976 against 24 is within, 25 is not [1].
_RATE_TOLERANCE = 0.005
_MISSING_SHARE = 0.01  # of the frames without a picture of their own that a constant rate may show


def decoded_findings(video: Clip, camera: str) -> Iterator[Finding]:
    """Decode the first, the middle and the last picture of a clip; yield an error for each that cannot be.

    Say, too, whether pictures are woven of two instants.
    """
    for number in sorted({0, video.count // 2, video.count - 1}):
        try:
            next(iter(video.frames(number, number + 1, threads=1)))
        except JawusdError as error:
            yield Finding(
                "clip_damaged",
                "error",
                error.message,
                path=str(video.path),
                camera=camera,
                frame=number,
                hint=error.hint,
            )
    if video.is_interlaced:
        yield Finding("interlaced", "warning", INTERLACED, path=str(video.path), camera=camera, hint=INTERLACED_HINT)


def rate_findings(videos: Mapping[str, Clip], fps: float, path: str) -> Iterator[Finding]:
    """Compare the rates of clips with that of the capture [frames per second] and with one another.

    Args:
        videos: by the names of their cameras.
        fps: what the capture says.
        path: of the capture, for the findings.
    """
    for name, video in videos.items():
        rate = video.timeline.rate
        if abs(rate / fps - 1.0) > _RATE_TOLERANCE:
            yield Finding(
                "fps_differs",
                "warning",
                f"fps is {fps:g} in the capture, but the clip shows {rate:.3f} pictures per second",
                rate,
                fps,
                path=path,
                camera=name,
                hint="Correct fps, or convert the clip: speeds and times would be wrong.",
            )
        if isinstance(video, PictureSequence) and video.timeline.missing:
            yield Finding(
                "pictures_missing",
                "warning",
                f"pictures {gaps(video.numbers.tolist())} are missing",
                video.timeline.missing / video.timeline.count,
                path=str(video.path),
                camera=name,
                hint="Export them again, or leave it: those frames are tracked without this camera.",
            )
        elif (share := video.timeline.missing / video.timeline.count) > _MISSING_SHARE:
            yield Finding(
                "pictures_missing",
                "warning",
                f"{video.timeline.missing} of {video.timeline.count} frames have no picture: dropped, or variable rate",
                share,
                _MISSING_SHARE,
                path=str(video.path),
                camera=name,
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
                f"the clip runs at {video.timeline.rate:.3f} pictures per second, that of the first camera at "
                f"{reference.timeline.rate:.3f}: they drift apart by {drift:.1f} frames",
                drift,
                _DRIFT_FRAMES,
                path=str(video.path),
                camera=name,
                hint="Record all cameras at one rate, or convert the clips to one.",
            )
