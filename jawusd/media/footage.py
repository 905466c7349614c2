"""Open the clip of a camera, whatever it is stored as."""

from __future__ import annotations

from pathlib import Path

from jawusd.base.errors import CaptureError
from jawusd.formats.clip_source import ClipSource
from jawusd.formats.numbered import is_pattern
from jawusd.media.clip import Clip
from jawusd.media.picture_sequence import PictureSequence
from jawusd.media.video import Video


def open_clip(source: ClipSource | Path) -> Clip:
    """Open a video or numbered pictures.

    Raises:
        CaptureError: the clip is missing or damaged.
    """
    source = source if isinstance(source, ClipSource) else ClipSource(source)
    if source.path.is_dir():
        raise CaptureError(
            "is a folder.", path=source.path, hint=f'Name the pictures in it, as "{source.path.name}/*.png".'
        )
    clip: Clip = (
        PictureSequence(source)
        if is_pattern(source.path)
        else Video(source.path, source.colour_space, source.colour_config)
    )
    if source.timecode:
        clip.timecode, clip.timecode_fps = source.timecode, None
    clip.pixel_aspect = source.pixel_aspect or clip.pixel_aspect
    return clip
