"""Clips, keys and playback."""

import asyncio

import numpy as np
import pytest

from jawusd.base.errors import FormatError
from jawusd.formats.keys import Key
from jawusd.viewer import motion
from jawusd.viewer.motion import Clip, Player, frame_after

KEYS = (Key(frame=0, d=(0, 0, 0)), Key(frame=10, d=(1, 2, 3)), Key(frame=20, d=(4, 5, 6)))


def frames_of(keys):
    return [key.frame for key in keys]


def test_keys_are_added_replaced_deleted_and_moved():
    added = motion.with_key(KEYS, 5, [7, 8, 9])
    assert frames_of(added) == [0, 5, 10, 20] and added[1].d == (7, 8, 9)
    replaced = motion.with_key(KEYS, 10, [7, 8, 9])
    assert frames_of(replaced) == [0, 10, 20] and replaced[1].d == (7, 8, 9)
    assert frames_of(motion.without_key(KEYS, 10)) == [0, 20]
    shifted = motion.at_frames(KEYS, (3, 11, 90))
    assert frames_of(shifted) == [3, 11, 90] and [key.d for key in shifted] == [key.d for key in KEYS]
    assert frames_of(KEYS) == [0, 10, 20]  # not modified in place


@pytest.mark.parametrize(
    "action",
    [
        lambda: motion.without_key(KEYS, 5),
        lambda: motion.at_frames(KEYS, (1, 2)),
        lambda: motion.at_frames(KEYS, (1, 2, 2)),
    ],
)
def test_what_cannot_be_done_to_keys_is_said(action):
    with pytest.raises(FormatError):
        action()


def test_a_clip_bridges_lost_frames_and_holds_its_ends():
    d = np.array([[0, 0, 0], [np.nan] * 3, [2, 4, 6], [3, 3, 3]])
    clip = Clip.of("take", np.array([5, 6, 7, 8]), d, 24)
    np.testing.assert_allclose(
        clip.at([4, 5, 6, 7.5, 99]), [[0, 0, 0], [0, 0, 0], [1, 2, 3], [2.5, 3.5, 4.5], [3, 3, 3]]
    )
    assert clip.span == (5, 8) and clip.at(6.0).shape == (3,)


def test_clips_without_motion_or_order_are_refused():
    with pytest.raises(FormatError, match="nothing to play"):
        Clip.of("empty", np.arange(2), np.full((2, 3), np.nan), 24)
    with pytest.raises(FormatError, match="do not increase"):
        Clip.of("odd", np.array([2, 1]), np.zeros((2, 3)), 24)


def test_playing_keeps_time_stops_at_the_end_or_goes_round():
    assert frame_after(10, 0.5, 24, (0, 100), loop=False) == 22
    assert frame_after(90, 1.0, 24, (0, 100), loop=False) is None
    assert frame_after(90, 1.0, 24, (0, 100), loop=True) == pytest.approx(13)  # a cycle has 101 frames
    assert frame_after(100, 0.0, 24, (0, 100), loop=False) == 0  # restarts from the end
    assert frame_after(-40, 0.25, 24, (0, 100), loop=False) == 6
    assert frame_after(0, 100.0, 24, (0, 0), loop=True) == 0
    assert frame_after(90, 10.5 / 24, 24, (0, 100), loop=True) == 100  # the last frame keeps its full duration


def test_the_player_shows_rising_frames_ends_by_itself_and_can_be_stopped():
    async def play():
        shown, ended = [], []
        player = Player(shown.append, lambda: ended.append(True))
        player.start(0, 1000.0, (0.0, 100.0), lambda: False)
        assert player.playing
        for _ in range(500):
            await asyncio.sleep(0.02)
            if not player.playing:
                break
        first, count = list(shown), len(ended)
        player.start(0, 10.0, (0.0, 100.0), lambda: True)
        await asyncio.sleep(0.05)
        player.start(50, 10.0, (0.0, 100.0), lambda: True)  # a new start cancels the old one
        player.stop()
        player.stop()
        await asyncio.sleep(0.15)
        return first, count, len(ended), player.playing

    first, once, thrice, playing = asyncio.run(play())
    assert first == sorted(first) and first[-1] == 100.0 and once == 1
    assert thrice == 3 and not playing
