"""A camera that dropped frames: masks are assigned by time, in tracking and in segmentation."""

from fractions import Fraction

import av
import numpy as np
import pytest
from small_take import CAMERAS, FIRST, OFFSETS, ROWS, errors_mm, make_capture, source, track, write_masks

from jawusd.media.video import Video
from jawusd.segmentation.picture import ColourFootage

COUNT = 8
FPS = 25
DROPPED = {"cam1": (1, 7), "cam2": (9,)}  # own frames without a picture


def own_frames(camera: str) -> list[int]:
    return [k for k in range(FIRST + COUNT + 3) if k not in DROPPED.get(camera, ())]


def film(path, camera) -> None:
    """Write a clip whose frame numbers are encoded as brightness."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(1000))
        stream.width, stream.height, stream.pix_fmt = *camera.size_px, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        stream.options = {"preset": "ultrafast", "crf": "30"}
        for k in own_frames(camera.name):
            picture = np.full(camera.size_px[::-1], 40 + 5 * k, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="gray")
            frame.pts, frame.time_base = 1000 * k // FPS, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    """The small take with clips, and masks numbered by picture."""
    folder = write_masks(tmp_path_factory.mktemp("variable"), COUNT)
    for camera in CAMERAS:
        film(folder / f"{camera.name}.mp4", camera)
        kept = own_frames(camera.name)
        for row in ROWS:
            for path in sorted((folder / camera.name / row).glob("*.png")):
                own = int(path.stem)
                path.rename(path.with_name(f"p{kept.index(own):06d}.png")) if own in kept else path.unlink()
            for path in sorted((folder / camera.name / row).glob("p*.png")):
                path.rename(path.with_name(path.name[1:]))
    return folder


def capture(folder, with_clips):
    cameras = [source(folder, c.name) | ({"video": folder / f"{c.name}.mp4"} if with_clips else {}) for c in CAMERAS]
    return make_capture(folder, COUNT, cameras=cameras)


@pytest.mark.slow
def test_masks_are_assigned_by_time(take):
    tracks = track(capture(take, with_clips=True))
    assert tracks.tracked().all() and errors_mm(tracks, raw=True).max() < 0.25
    used = np.isfinite(tracks.coverage_error).all(1)
    for c, camera in enumerate(CAMERAS):
        gone = [FIRST + k for k in range(COUNT) if FIRST + k - OFFSETS[camera.name] in DROPPED.get(camera.name, ())]
        assert tracks.frames[~used[:, c]].tolist() == gone
    # Counted by picture number, two cameras would show other instants.
    by_count = errors_mm(track(capture(take, with_clips=False)), raw=True)
    assert np.nanmean(by_count) > 3 * errors_mm(tracks, raw=True).mean()


def test_footage_is_read_by_time(take):
    videos = {camera.name: Video(take / f"{camera.name}.mp4") for camera in CAMERAS}
    footage = ColourFootage(videos, OFFSETS)
    for frames in (range(FIRST, FIRST + COUNT), range(FIRST + COUNT - 1, FIRST - 1, -1)):
        for frame, pictures in footage.walk(frames):
            for camera in CAMERAS:
                own, image = frame - OFFSETS[camera.name], pictures[camera.name]
                if own in DROPPED.get(camera.name, ()):
                    assert image is None and footage.own(camera.name, frame) is None
                else:
                    assert np.asarray(image).mean() == pytest.approx(40 + 5 * own, abs=1.5)
                    assert footage.own(camera.name, frame) == own_frames(camera.name).index(own)


def test_footage_just_read_is_not_decoded_again(take, monkeypatch):
    videos = {camera.name: Video(take / f"{camera.name}.mp4") for camera in CAMERAS}
    footage, decoded = ColourFootage(videos, OFFSETS), []
    seen = dict(footage.walk(range(FIRST, FIRST + COUNT)))
    forwards = ColourFootage._forwards

    def recorded(self, frames):
        decoded.extend(frames)
        return forwards(self, frames)

    monkeypatch.setattr(ColourFootage, "_forwards", recorded)
    again = dict(footage.walk(range(FIRST + COUNT - 2, FIRST - 1, -1)))
    assert list(again) == list(range(FIRST + COUNT - 2, FIRST - 1, -1)) and decoded == [FIRST, FIRST + 1]
    for frame, pictures in again.items():
        for name, picture in pictures.items():
            assert np.array_equal(np.asarray(picture), np.asarray(seen[frame][name]))
