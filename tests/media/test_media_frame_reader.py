"""Pictures asked for in any order, by several threads, are the pictures of the video."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from jawusd.base.errors import CaptureError
from jawusd.media.footage import FrameReader
from jawusd.media.video import Video
from jawusd.media.writers import VideoWriter

COUNT = 90


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "clip.mp4"
    with VideoWriter(path, (64, 48), 24.0) as writer:
        for k in range(COUNT):
            writer.write(np.full((48, 64), 20 + 2 * k, np.uint8))
    return Video(path)


@pytest.fixture
def all_pictures(video):
    return [frame.image for frame in video.frames(colour="rgb")]


ORDERS = {
    "forwards": range(COUNT),
    "backwards": reversed(range(COUNT)),
    "there and back": [5, 6, 7, 6, 5, 4, 5, 60, 59, 58, 61, 10, 89, 0, 88, 30, 29],
    "anyhow": np.random.default_rng(0).integers(0, COUNT, 40).tolist(),
}


@pytest.mark.parametrize("order", ORDERS)
def test_any_order_gives_the_pictures(video, all_pictures, order):
    reader = FrameReader(video)
    reader._most = 12  # as with large pictures
    for index in ORDERS[order]:
        np.testing.assert_array_equal(reader.picture(int(index)), all_pictures[index])
    assert len(reader._kept) <= 12


def test_threads_do_not_disturb_one_another(video, all_pictures):
    reader = FrameReader(video)
    wanted = np.random.default_rng(1).integers(0, COUNT, 60).tolist()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(reader.picture, wanted))
    for index, image in zip(wanted, found, strict=True):
        np.testing.assert_array_equal(image, all_pictures[index])


def test_steps_do_not_start_over_at_the_key_frame(video, monkeypatch):
    reader, starts = FrameReader(video), []
    frames = video.frames
    monkeypatch.setattr(video, "frames", lambda first, **more: starts.append(first) or frames(first, **more))
    for index in (*range(40, 60), *range(59, 39, -1)):
        reader.picture(index)
    assert starts == [40]


def test_pictures_outside_are_an_error_and_the_next_one_works(video, all_pictures):
    reader = FrameReader(video)
    for index in (COUNT, -1):
        with pytest.raises(CaptureError):
            reader.picture(index)
    np.testing.assert_array_equal(reader.picture(3), all_pictures[3])
