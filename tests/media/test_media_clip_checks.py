"""Clips that cannot be decoded everywhere, or run at another rate than is said, are told."""

import cv2
import numpy as np
import pytest
from damaged_clips import packets, with_zeros, write_gray

from jawusd.media import checks
from jawusd.media.checks import decoded_findings, rate_findings
from jawusd.media.video import Video
from jawusd.media.writers import VideoWriter


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


SCENE = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (180, 320)).astype(np.float32), (0, 0), 2)


def talking(count=120, noise=1.0, move=lambda k: 6 * np.sin(k / 5) + 2.5 * np.sin(k / 2.3)):
    """Return pictures (n, h, w) of a patch that moves over a texture."""
    rng, pictures = np.random.default_rng(4), []
    back, patch = 3 * (SCENE - SCENE.mean()) + 110, 4 * (SCENE[::-1] - SCENE.mean()) + 150
    for k in range(count):
        moved = cv2.warpAffine(
            patch[:60, :80], np.array([[1, 0, 120], [0, 1, 60 + move(k)]], np.float32), (320, 180), borderValue=-1000
        )
        shown = np.where(moved > -900, moved, back) + rng.normal(size=back.shape) * noise
        pictures.append(np.clip(shown, 0, 255).astype(np.uint8))
    return np.stack(pictures)


def repeating(pictures, again):
    """Replace pictures by the one before them."""
    out = pictures.copy()
    for k in again:
        out[k] = out[k - 1]
    return out


def repeated(path, pictures, crf=18):
    video = Video(write_gray(path, pictures, crf))
    return [f for f in decoded_findings(video, "left") if f.kind == "pictures_repeated"]


@pytest.mark.parametrize("crf", [18, 28])
@pytest.mark.parametrize(
    ("again", "said"),
    [
        (range(60, 84), "frames 60 to 83 repeat"),
        (range(62, 68), "frames 62 to 67 repeat"),
        (range(100, 120), "frames 100 to 119 repeat"),
        (range(60, 61), "frames 60 repeat"),
        ([*range(12, 20), *range(60, 84)], "frames 12 to 19, 60 to 83 repeat"),
    ],
)
def test_frozen_cameras_and_doubled_pictures_are_named(tmp_path, again, said, crf):
    (finding,) = repeated(tmp_path / "a.mp4", repeating(talking(), again), crf)
    assert said in finding.message and finding.severity == "warning" and finding.camera == "left"
    assert finding.frame in again and 0.7 * len(again) <= finding.value <= len(again)


def test_clips_converted_from_another_rate_are_named(tmp_path):
    (finding,) = repeated(tmp_path / "a.mp4", repeating(talking(), range(3, 120, 4)))
    assert " more times repeat the previous image" in finding.message and finding.value > 20


def test_a_frozen_camera_is_named_in_noise_that_hides_motion(tmp_path):
    still = talking(noise=4.0, move=lambda k: 0.0)
    (finding,) = repeated(tmp_path / "a.mp4", repeating(still, range(60, 84)), 12)
    assert "frames 60 to 83" in finding.message
    assert repeated(tmp_path / "a.mp4", still, 12) == []


def dark(pictures):
    pictures[60:72] //= 10
    return pictures


def black(pictures):
    pictures[60:63] = 0
    return pictures


def white(pictures):
    pictures[60:64] = 255
    return pictures


@pytest.mark.parametrize("crf", [18, 30])
@pytest.mark.parametrize(
    "pictures",
    [
        lambda: talking(),
        lambda: talking(noise=0.0),
        lambda: talking(noise=0.0, move=lambda k: 0.0),
        lambda: talking(move=lambda k: 0.0),
        lambda: talking(noise=3.0, move=lambda k: 0.0),
        lambda: talking(move=lambda k: 0.0 if k < 60 else 6 * (1 - np.cos((k - 60) / 6))),
        lambda: talking(move=lambda k: 5 * np.sin(1.1 * k)),
        lambda: dark(talking()),
        lambda: black(talking()),
        lambda: white(talking()),
        lambda: np.full((60, 180, 320), 90, np.uint8),
        lambda: np.repeat(np.arange(0, 240, 4, dtype=np.uint8), 180 * 320).reshape(60, 180, 320),
    ],
    ids=["talking", "clean", "clean and still", "still", "noisy and still", "resting first", "quick", "light off",
         "black", "white flash", "without texture", "brightening"],
)  # fmt: skip
def test_still_noisy_and_dark_scenes_are_not_frozen(tmp_path, pictures, crf):
    assert repeated(tmp_path / "a.mp4", pictures(), crf) == []


@pytest.mark.parametrize("number", [7, 30, 50, 77, 101])
def test_damage_anywhere_in_a_clip_is_found(tmp_path, number):
    """Not only where the first, middle and last pictures are, which cameras are not aligned by."""
    path = write_gray(tmp_path / "a.mp4", talking())
    at, size = packets(path)[number]
    path.write_bytes(with_zeros(path.read_bytes(), at + 8, size - 8))
    (finding,) = [f for f in decoded_findings(Video(path), "left") if f.severity == "error"]
    assert finding.kind == "clip_damaged" and "cannot be decoded" in finding.message


def test_long_clips_are_decoded_in_parts_and_at_both_ends(tmp_path, monkeypatch):
    video = Video(write_gray(tmp_path / "a.mp4", np.zeros((500, 16, 16), np.uint8)))
    assert checks._parts(video) == [(0, 500)]
    monkeypatch.setattr(checks, "_DECODED_PX", 16 * 16 * 400)
    parts = checks._parts(video)
    assert parts[0] == (0, 96) and parts[-1] == (404, 500) and sum(b - a for a, b in parts) <= 400
    assert all(0 <= a < b <= 500 for a, b in parts)
