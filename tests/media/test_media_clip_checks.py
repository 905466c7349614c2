"""Clips that cannot be decoded everywhere, or run at another rate than is said, are told."""

import numpy as np

from jawusd.media.clip_checks import decoded_findings, rate_findings
from jawusd.media.video import Video
from jawusd.media.video_writer import VideoWriter


def clip(path, fps=24.0, count=30):
    rng = np.random.default_rng(0)
    with VideoWriter(path, (64, 48), fps, lossless=True) as writer:
        for _ in range(count):
            writer.write(rng.integers(0, 255, (48, 64), dtype=np.uint8))
    return Video(path)


def test_whole_clips_at_the_stated_rate_are_accepted(tmp_path):
    videos = {name: clip(tmp_path / f"{name}.mkv") for name in ("cam0", "cam1")}
    assert not list(decoded_findings(videos["cam0"], "cam0"))
    assert not list(rate_findings(videos, 24.0, "capture.toml"))


def test_another_rate_is_told_and_cameras_that_drift_apart(tmp_path):
    videos = {"cam0": clip(tmp_path / "a.mkv"), "cam1": clip(tmp_path / "b.mkv", 30.0)}
    found = list(rate_findings(videos, 24.0, "capture.toml"))
    assert [(f.kind, f.camera) for f in found] == [("fps_differs", "cam1"), ("rates_differ", "cam1")]
    assert all(f.severity == "warning" for f in found)


def test_a_picture_that_cannot_be_decoded_is_an_error(tmp_path):
    video = clip(tmp_path / "a.mkv")
    data = bytearray(video.path.read_bytes())
    data[len(data) // 2 - 1500 : len(data) // 2 + 1500] = bytes(3000)
    video.path.write_bytes(data)
    found = list(decoded_findings(video, "cam0"))
    assert found and all(f.kind == "clip_damaged" and f.severity == "error" for f in found)
