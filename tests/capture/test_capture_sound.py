"""Synchronisation by sound, videos of variable rate, and clips with neither flashes nor sound."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from scipy.signal import fftconvolve, resample_poly

from jawusd.base.errors import CaptureError, SyncError
from jawusd.capture.signals import RATE_HZ, Step, match_sounds, match_steps, to_frames
from jawusd.capture.sync import align_videos, light_curve
from jawusd.media.clip import Timeline
from jawusd.media.containers import Sound, read_sound
from jawusd.media.video import Video

FPS = 24
TICK = Fraction(1, 90000)


def speech(seconds: float, rate: int, seed: int = 0) -> np.ndarray:
    """Return a synthetic voice: filtered noise in bursts of irregular length."""
    rng = np.random.default_rng(seed)
    noise = fftconvolve(rng.normal(size=int(seconds * rate)), np.exp(-np.arange(40) / 6.0), mode="same")
    edges = np.cumsum(rng.uniform(0.05, 0.6, 400))
    loud = np.searchsorted(edges, np.arange(len(noise)) / rate) % 2
    return noise * (0.05 + loud)


def heard(scene: np.ndarray, at: float, seconds: float, rate: int, seed: int, noise: float = 0.2) -> np.ndarray:
    """Return a microphone's recording from a start time: echoes, noise and gain."""
    rng = np.random.default_rng(seed)
    first = round(at * rate)
    part = scene[first : first + round(seconds * rate)]
    room = np.zeros(400)
    room[0], room[rng.integers(50, 400, 5)] = 1.0, rng.uniform(-0.3, 0.3, 5)
    return rng.uniform(0.1, 0.5) * (fftconvolve(part, room)[: len(part)] + rng.normal(0, noise, len(part)))


@pytest.mark.parametrize("late_s", [0.0, 1.2345, -2.71])
def test_the_delay_is_found_to_a_fraction_of_a_frame(late_s: float) -> None:
    rate = RATE_HZ * 4
    scene = speech(40, rate)
    a = resample_poly(heard(scene, 5.0, 20, rate, 1), 1, 4)
    b = resample_poly(heard(scene, 5.0 + late_s, 25, rate, 2), 1, 4)
    delay_s, confidence = match_sounds(Sound(b, RATE_HZ, 0.5), Sound(a, RATE_HZ, 0.0))
    # b starts later in the scene, and its file starts at 0.5 s.
    assert delay_s == pytest.approx(late_s - 0.5, abs=0.001)
    assert 0.3 < confidence <= 1


def test_sounds_that_cannot_tell_are_refused() -> None:
    a = Sound(speech(10, RATE_HZ, 1), RATE_HZ, 0.0)
    with pytest.raises(SyncError, match="do not match"):
        match_sounds(Sound(speech(10, RATE_HZ, 2), RATE_HZ, 0.0), a)
    with pytest.raises(SyncError, match="silent"):
        match_sounds(Sound(np.zeros(1000), RATE_HZ, 0.0), a)
    click = np.random.default_rng(0).normal(size=800) * np.exp(-np.arange(800) / 100)
    beat = np.zeros(10 * RATE_HZ)
    beat[np.arange(19) * RATE_HZ // 2 + 100] = 1.0
    rhythm = fftconvolve(beat, click)[: len(beat)]
    with pytest.raises(SyncError, match="equally well"):
        match_sounds(Sound(rhythm, RATE_HZ, 0.0), Sound(rhythm[3 * RATE_HZ :], RATE_HZ, 0.0))


def film(path: Path, times_s: np.ndarray, light: np.ndarray, sound: np.ndarray | None = None, turn: int = 0) -> Path:
    """Write pictures at given times with a brightness each, and 48 kHz sound."""
    rng = np.random.default_rng(len(light))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = stream.time_base = TICK
        if turn:
            stream.set_display_rotation(turn)
        track = container.add_stream("aac", rate=48000, layout="mono") if sound is not None else None
        for time_s, share in zip(times_s, light, strict=True):
            image = np.clip(15 + 110 * share + rng.normal(0, 2, (48, 64)), 0, 255).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts, frame.time_base = round(float(time_s) / TICK), TICK
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if track is not None:
            for first in range(0, len(sound), 1024):
                piece = av.AudioFrame.from_ndarray(
                    np.float32(sound[None, first : first + 1024]), format="fltp", layout="mono"
                )
                piece.sample_rate, piece.pts, piece.time_base = 48000, first, Fraction(1, 48000)
                container.mux(track.encode(piece))
            container.mux(track.encode(None))
    return path


def lit(count: int, start: int, dark: tuple[tuple[int, int], ...] = ((10, 16), (170, 178))) -> np.ndarray:
    """Return the light of each frame of a camera that starts at a reference frame."""
    frames = start + np.arange(count)
    return 1.0 - sum(((frames >= a) & (frames < b)).astype(float) for a, b in dark)


def test_clips_without_a_flash_are_aligned_by_their_sound(tmp_path: Path) -> None:
    scene = speech(30, 48000)
    videos = {}
    for seed, (name, start) in enumerate({"a": 0, "b": 31, "c": -17}.items()):
        sound = heard(scene, 10 + start / FPS, 8, 48000, seed)
        videos[name] = film(tmp_path / f"{name}.mp4", np.arange(190) / FPS, np.ones(190), sound)
    found = align_videos(videos, "a")
    assert found.method == "sound" and found.offsets == {"a": 0, "b": 31, "c": -17}
    for name, exact in (("b", 31), ("c", -17)):
        assert found.cameras[name].exact_frames == pytest.approx(exact, abs=0.05)
        assert found.cameras[name].matched_steps == 0 and found.confidence[name] > 0.3
    assert "camera a shows no light flash" in found.notes[0] and "are synchronised by sound" in found.notes[0]


def test_a_flash_goes_before_sound_unless_sound_is_asked_for(tmp_path: Path) -> None:
    scene = speech(30, 48000)
    videos = {
        name: film(
            tmp_path / f"{name}.mp4", np.arange(190) / FPS, lit(190, start), heard(scene, 9 + start / FPS, 8, 48000, k)
        )
        for k, (name, start) in enumerate({"a": 0, "b": 5}.items())
    }
    assert align_videos(videos, "a").method == "light flash"
    asked = align_videos(videos, "a", by_light=False)
    assert asked.method == "sound" and asked.offsets == {"a": 0, "b": 5} and asked.notes == ()


def test_clips_with_neither_flash_nor_sound_are_refused(tmp_path: Path) -> None:
    silent = film(tmp_path / "silent.mp4", np.arange(60) / FPS, np.ones(60))
    loud = film(tmp_path / "loud.mp4", np.arange(60) / FPS, np.ones(60), speech(2, 48000))
    with pytest.raises(SyncError, match=r"silent\.mp4: camera a shows no light flash.*no clip has sound.*offsets = "):
        align_videos({"a": silent, "b": silent}, "a")
    with pytest.raises(SyncError, match="camera a shows no light flash.*camera a has no sound"):
        align_videos({"a": silent, "b": loud}, "a")
    other = film(tmp_path / "other.mp4", np.arange(60) / FPS, np.ones(60), speech(2, 48000, 5))
    with pytest.raises(SyncError, match="a shows no light flash.*b, compared with a: the sounds (do not )?match"):
        align_videos({"a": loud, "b": other}, "a")
    assert read_sound(silent, RATE_HZ) is None


def test_a_variable_rate_is_followed_by_presentation_times(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    videos = {}
    for name, start in {"a": 0, "b": 12, "c": -6}.items():
        light = lit(200, start)
        kept = np.sort(np.append(0, 1 + rng.permutation(199)[:160]))
        times = (kept + np.append(0, rng.uniform(-0.1, 0.1, 160))) / FPS
        videos[name] = film(tmp_path / f"{name}.mp4", times, light[kept])
    found = align_videos(videos, "a")
    assert found.offsets == {"a": 0, "b": 12, "c": -6}
    assert any(note.startswith("camera b has a variable frame rate: ") for note in found.notes)


def test_a_quarter_turn_changes_nothing(tmp_path: Path) -> None:
    plain = film(tmp_path / "a.mp4", np.arange(200) / FPS, lit(200, 0))
    turned = film(tmp_path / "b.mp4", np.arange(200) / FPS, lit(200, 7), turn=90)
    assert Video(turned).rotation_deg in (90, 270) and Video(turned).size_px == (48, 64)
    assert align_videos({"a": plain, "b": turned}, "a").offsets == {"a": 0, "b": 7}


def test_a_clip_cut_short_is_aligned_by_what_is_left(tmp_path: Path) -> None:
    whole = film(tmp_path / "a.mp4", np.arange(200) / FPS, lit(200, 0))
    short = film(tmp_path / "b.mp4", np.arange(100) / FPS, lit(100, 4))
    found = align_videos({"a": whole, "b": short}, "a").cameras["b"]
    assert found.frames == 4 and found.confidence < 1
    broken = tmp_path / "c.mp4"
    broken.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.raises(CaptureError, match=r"c\.mp4: .*(cannot be opened|truncated)"):
        align_videos({"a": whole, "c": broken}, "a")


def test_a_codec_nobody_knows_is_one_clear_error(tmp_path: Path) -> None:
    good = film(tmp_path / "a.mp4", np.arange(30) / FPS, np.ones(30))
    strange = tmp_path / "b.mp4"
    data = good.read_bytes()
    assert data.count(b"avc1") >= 1
    strange.write_bytes(data.replace(b"avc1", b"zzz1"))
    with pytest.raises(CaptureError, match=r"b\.mp4: .*codec.*ffmpeg"):
        Video(strange)


@pytest.mark.parametrize("tick_s", [1e-3, 1 / 90000])
@pytest.mark.parametrize("fps", [23.976, 24.0, 29.97, 59.94])
def test_pictures_fall_on_the_frames_they_were_taken_at(tick_s: float, fps: float) -> None:
    rng = np.random.default_rng(int(fps))
    numbers = np.sort(np.append(0, 1 + rng.permutation(3000)[:2200]))
    times = np.round(numbers / fps / tick_s) * tick_s
    timeline = Timeline(times, 1.0)
    assert np.array_equal(timeline.numbers, numbers) and timeline.rate == pytest.approx(fps, rel=1e-4)


def test_a_step_in_a_gap_does_not_mislead() -> None:
    # Frames 10 to 12 are missing: the light went off somewhere from 10 to 13.
    numbers = np.append(np.arange(10), np.arange(13, 60))
    placed = to_frames([Step(10.0, False), Step(20.4, True)], numbers)
    assert [(s.time_frames, s.slack_frames) for s in placed] == [(13.0, 3.0), (pytest.approx(23.4), 0.0)]
    reference = [Step(16.0, False), Step(28.4, True)]
    assert match_steps(placed, reference, 24.0).frames == 5


def test_the_light_curve_has_every_picture(tmp_path: Path) -> None:
    curve = light_curve(film(tmp_path / "a.mp4", np.arange(30) / FPS, lit(30, 0)))
    assert curve.frames.tolist() == list(range(30)) and curve.times_s[24] == pytest.approx(1.0)
    assert curve.brightness[5] > 100 and curve.brightness[12] < 30
    assert len(curve.off_frames) == len(curve.on_frames) == 1 and 5 < curve.off_frames[0] <= 12 < curve.on_frames[0]
