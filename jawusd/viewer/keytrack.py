"""Keys of an animation as a tuple that is replaced, never changed: add, move, delete."""

from __future__ import annotations

from collections.abc import Sequence

from jawusd.errors import FormatError
from jawusd.formats.keys import Key

KeyTrack = tuple[Key, ...]


def with_key(keys: KeyTrack, frame: float, d: Sequence[float]) -> KeyTrack:
    """Return the keys with one more at a frame; one that was there is replaced."""
    added = Key(frame=float(frame), d=tuple(float(value) for value in d))
    return tuple(sorted([*(key for key in keys if key.frame != frame), added], key=lambda key: key.frame))


def without_key(keys: KeyTrack, frame: float) -> KeyTrack:
    """Return the keys without the one at a frame.

    Raises:
        FormatError: there is none.
    """
    _key_at(keys, frame)
    return tuple(key for key in keys if key.frame != frame)


def at_frames(keys: KeyTrack, frames: Sequence[float]) -> KeyTrack:
    """Return the keys, in their order, at other frames.

    Raises:
        FormatError: not one frame per key, or two keys would share a frame.
    """
    if len(frames) != len(keys) or len(set(frames)) != len(keys):
        raise FormatError(f"{len(set(frames))} frames for {len(keys)} keys; each key needs a frame of its own.")
    return tuple(Key(frame=float(frame), d=key.d) for key, frame in zip(keys, sorted(frames), strict=True))


def _key_at(keys: KeyTrack, frame: float) -> Key:
    for key in keys:
        if key.frame == frame:
            return key
    known = ", ".join(f"{key.frame:g}" for key in keys) or "none"
    raise FormatError(f"there is no key at frame {frame:g}; keys are at: {known}.")
