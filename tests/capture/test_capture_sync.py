"""Synchronisation by light flashes on videos with a simulated lamp, and all its errors."""

from pathlib import Path

import numpy as np
import pytest

from jawusd.base.errors import SyncError
from jawusd.capture.signals import Step, find_steps, match_steps
from jawusd.capture.sync import align_videos, estimate_offsets
from jawusd.formats.capture import Capture
from jawusd.media.writers import VideoWriter

FPS = 24.0
FLASHES = ((10.3, 16.0), (371.0, 378.4))  # dark, in frames of the reference camera


def exposures(
    count: int, start: float, flashes: tuple[tuple[float, float], ...] = FLASHES, exposure: float = 1.0
) -> np.ndarray:
    """Return the lit fraction of each frame's exposure for a camera that starts at a time [reference frames]."""
    opened = start + np.arange(count)
    lit = np.ones(count)
    for off, on in flashes:
        overlap = np.minimum(opened + exposure, on) - np.maximum(opened, off)
        lit -= np.clip(overlap, 0, None) / exposure
    return lit


def film(path: Path, lit: np.ndarray, fps: float = FPS, bright: float = 120.0, seed: int = 0) -> Path:
    """Write a video whose brightness follows the lamp, with a moving person and noise."""
    rng = np.random.default_rng(seed)
    with VideoWriter(path, (64, 48), fps) as out:
        for k, share in enumerate(lit):
            image = np.full((48, 64), bright) + 6 * np.sin(k / 40)
            image[20:40, 10 + k % 30 : 25 + k % 30] *= 0.7
            out.write(np.clip(image * (0.1 + 0.9 * share) + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
    return path


@pytest.mark.parametrize("polarity", ["off", "on"])
def test_offsets_of_three_cameras(tmp_path: Path, polarity: str) -> None:
    starts = {"a": 0.0, "b": 7.0, "c": -4.4}
    videos = {}
    for k, (name, start) in enumerate(starts.items()):
        lit = exposures(400, start)
        lit = lit if polarity == "off" else 1 - lit
        videos[name] = film(tmp_path / f"{name}.mp4", lit, bright=100 + 20 * k, seed=k)
    found = align_videos(videos, "a").cameras
    assert list(found) == ["a", "b", "c"]
    assert [found[name].frames for name in "abc"] == [0, 7, -4]
    for name, start in starts.items():
        assert found[name].exact_frames == pytest.approx(start, abs=0.05)
        assert found[name].spread_frames < 0.1
        assert found[name].matched_steps == 4 and found[name].confidence == 1.0
    assert align_videos(videos, "b").offsets == {"a": -7, "b": 0, "c": -11}


def test_only_both_ends_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = film(tmp_path / "a.mp4", exposures(400, 0))
    late = film(tmp_path / "late.mp4", exposures(400, 0, ((130.0, 140.0), (371.0, 376.4))))
    from jawusd.media.video import Video

    decoded: list[tuple[int, int]] = []
    frames = Video.frames

    def spy(self: Video, first: int = 0, last: int | None = None, **options: int):
        decoded.append((first, last))
        return frames(self, first, last, **options)

    monkeypatch.setattr(Video, "frames", spy)
    align_videos({"a": path}, "a")
    assert decoded == [(0, 96), (304, 400)]
    decoded.clear()
    align_videos({"a": late}, "a")
    assert decoded == [(0, 96), (304, 400), (0, 192)]


def test_one_flash_is_enough_and_lowers_the_confidence(tmp_path: Path) -> None:
    videos = {
        "a": film(tmp_path / "a.mp4", exposures(400, 0)),
        "b": film(tmp_path / "b.mp4", exposures(200, 5)),
    }
    found = align_videos(videos, "a").cameras["b"]
    assert (found.frames, found.matched_steps) == (5, 2)
    assert found.confidence == pytest.approx(2 / 3)


def test_a_video_without_flash_is_named(tmp_path: Path) -> None:
    videos = {
        "a": film(tmp_path / "a.mp4", exposures(60, 0)),
        "b": film(tmp_path / "b.mp4", np.ones(60)),
    }
    with pytest.raises(SyncError, match=r"b\.mp4: camera b shows no light flash: 0 .*60 frames.*\[sync\] offsets = \{"):
        align_videos(videos, "a")


def test_different_rates_are_refused(tmp_path: Path) -> None:
    videos = {
        "a": film(tmp_path / "a.mp4", exposures(60, 0)),
        "b": film(tmp_path / "b.mp4", exposures(60, 0), fps=25),
    }
    with pytest.raises(SyncError, match=r"b\.mp4: camera b has 25 frames per second, but camera a has 24"):
        align_videos(videos, "a")


def test_lost_frames_are_noticed(tmp_path: Path) -> None:
    lit = exposures(400, 3)
    videos = {
        "a": film(tmp_path / "a.mp4", exposures(400, 0)),
        "b": film(tmp_path / "b.mp4", np.delete(lit, [100, 101, 102, 103])),
    }
    with pytest.raises(
        SyncError, match=r"camera b, compared with a: the offset is 3\.0 frames at frame 7 and 7\.0 at frame 3\d\d"
    ):
        align_videos(videos, "a")


def test_a_clip_cut_short_is_aligned_and_named(tmp_path: Path) -> None:
    videos = {
        "a": film(tmp_path / "a.mp4", exposures(400, 0)),
        "b": film(tmp_path / "b.mp4", exposures(200, 5)),
        "c": film(tmp_path / "c.mp4", exposures(390, 3)),
    }
    found = align_videos(videos, "a")
    assert found.offsets == {"a": 0, "b": 5, "c": 3} and found.confidence["b"] < 1.0
    assert len(found.notes) == 1
    assert found.notes[0].startswith("camera b ends at frame 204 of the reference camera, 195 frames before camera a:")


def steps(*times: float) -> list[Step]:
    return [Step(time, bool(k % 2)) for k, time in enumerate(times)]


def test_alignments_that_fit_equally_well_are_refused() -> None:
    with pytest.raises(SyncError, match=r"equally well at offsets of \S+ and \S+ frames"):
        match_steps(steps(10, 15), steps(20, 25, 600, 605), FPS)
    # One more dark frame resolves the ambiguity.
    assert match_steps(steps(10, 15), steps(20, 25, 600, 606), FPS).frames == 10


def test_steps_that_do_not_fit_are_refused() -> None:
    for own, other in ((steps(10, 15), steps(20, 40)), ([Step(5, False)], steps(20, 40)), ([], [])):
        with pytest.raises(SyncError, match="do not match"):
            match_steps(own, other, FPS)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.9])
def test_split_steps_give_the_fraction(fraction: float) -> None:
    found = find_steps(20 + 100 * exposures(40, 0, ((10 + fraction, 20 + fraction),)), first_frame=100)
    assert [s.rising for s in found] == [False, True]
    assert [s.time_frames for s in found] == pytest.approx([110 + fraction, 120 + fraction])


def test_short_flashes_and_slow_changes() -> None:
    pulse = np.full(40, 100.0)
    pulse[20] = 10
    assert [(s.time_frames, s.rising) for s in find_steps(pulse)] == [(20, False), (21, True)]
    assert find_steps(np.linspace(20, 200, 60)) == []
    assert find_steps(100 + 10 * np.sin(np.arange(60.0))) == []
    assert find_steps(np.zeros(30)) == []


def capture(folder: Path, videos: dict[str, Path | None], **sync: object) -> Capture:
    cameras = [
        {"name": name, "video": video, "masks": {"upper": folder / "u.mkv", "lower": folder / "l.mkv"}}
        for name, video in videos.items()
    ]
    return Capture(
        folder=folder, name="x", fps=FPS, scans={"upper_teeth": "u.ply", "lower_teeth": "l.ply"}, cameras=cameras,
        sync=sync,
    )  # fmt: skip


def test_a_capture_is_aligned_to_its_reference(tmp_path: Path) -> None:
    videos: dict[str, Path | None] = {
        "a": film(tmp_path / "a.mp4", exposures(80, 0)),
        "b": film(tmp_path / "b.mp4", exposures(80, -2)),
    }
    found = estimate_offsets(capture(tmp_path, videos, reference="b"))
    assert found.reference == "b"
    assert found.offsets == {"a": 2, "b": 0} and found.confidence == {"a": 1.0, "b": 1.0}
    assert found.notes == ()
    faster = capture(tmp_path, videos, reference="b").model_copy(update={"fps": 48.0})
    assert estimate_offsets(faster).notes == (
        "the clips run at 24 frames per second, but capture.toml has fps = 48, which is used as the time base",
    )
    message = r"capture\.toml: camera c has no video.*offsets = \{ a = \.\., b = \.\., c = \.\. \}"
    with pytest.raises(SyncError, match=message):
        estimate_offsets(capture(tmp_path, videos | {"c": None}))
