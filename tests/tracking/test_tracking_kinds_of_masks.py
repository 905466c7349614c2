"""Masks in every supported encoding track alike, and unused cameras are reported."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image
from small_take import CAMERAS, FIRST, OFFSETS, ROWS, errors_mm, make_capture, png, source, track, write_masks

from jawusd.base.errors import CaptureError, TrackingError
from jawusd.cli.text_build import track_lines
from jawusd.formats.finding import Finding
from jawusd.formats.tracks import Tracks
from jawusd.pipeline.track import track_summary

COUNT = 4


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    return write_masks(tmp_path_factory.mktemp("drawn"), COUNT)


@pytest.fixture(scope="module")
def expected(drawn) -> Tracks:
    """Tracks of black-and-white masks; read-only."""
    return track(make_capture(drawn, COUNT))


def rewritten(drawn: Path, folder: Path, change, cameras=("cam0", "cam1", "cam2")) -> Path:
    """Rewrite the masks of a take; `change` converts a mask of 0 and 255, and may write it itself."""
    for camera in OFFSETS:
        for row in ROWS:
            (folder / camera / row).mkdir(parents=True)
            for k in range(COUNT):
                mask = cv2.imread(str(png(drawn, camera, row, k)), cv2.IMREAD_GRAYSCALE)
                out = png(folder, camera, row, k)
                picture = change(mask) if camera in cameras else mask
                picture.save(out) if isinstance(picture, Image.Image) else cv2.imwrite(str(out), picture)
    return folder


def palette(mask: np.ndarray, colours: list[int]) -> Image.Image:
    image = Image.fromarray((mask > 0).astype(np.uint8))
    image.putpalette(colours)
    return image


KINDS = {
    "zero_one": lambda m: m // 255,
    "zero_two": lambda m: m // 255 * 2,
    "zero_hundred": lambda m: m // 255 * 100,
    "sixteen": lambda m: m.astype(np.uint16) * 257,
    "sixteen_thousand": lambda m: m.astype(np.uint16) // 255 * 1000,
    "sixteen_one": lambda m: m.astype(np.uint16) // 255,
    "inverted": lambda m: 255 - m,
    "one_bit": lambda m: Image.fromarray(m).convert("1", dither=Image.Dither.NONE),
    "palette": lambda m: palette(m, [0, 0, 0, 128, 0, 0]),
    "palette_of_black": lambda m: palette(m, [0, 0, 0, 0, 0, 0]),
    "red_on_white": lambda m: np.dstack([255 - m, 255 - m, np.full_like(m, 255)]),
    "red_on_blue": lambda m: np.dstack([255 - m, 0 * m, m]),
    "alpha_alone": lambda m: np.dstack([0 * m, 0 * m, 0 * m, m]),
    "gray_and_opaque": lambda m: np.dstack([m, m, m, np.full_like(m, 255)]),
}


USUAL = ("zero_one", "sixteen", "inverted", "palette")  # one for each reader; the others are slow


@pytest.mark.parametrize("kind", [k if k in USUAL else pytest.param(k, marks=pytest.mark.slow) for k in KINDS])
def test_every_kind_of_mask_tracks_like_black_and_white(drawn, expected, tmp_path, kind):
    tracks = track(make_capture(rewritten(drawn, tmp_path, KINDS[kind]), COUNT))
    assert np.array_equal(tracks.T_upper_lower, expected.T_upper_lower)
    assert tracks.masks_used.all()
    kinds = {str(found["kind"]) for found in tracks.meta["findings"] if "mask" in str(found["kind"])}
    usual = kind in ("sixteen", "one_bit", "alpha_alone", "gray_and_opaque")
    assert kinds == (set() if usual else {"mask_levels"})


def test_soft_edges_are_not_shifted(drawn, expected, tmp_path):
    soft = rewritten(drawn, tmp_path, lambda m: cv2.GaussianBlur(m, (0, 0), 1.0) // 2)
    found = errors_mm(track(make_capture(soft, COUNT))).mean(0)
    assert (found < errors_mm(expected).mean(0) + 0.02).all()


@pytest.mark.parametrize("crf", ["18", "28"])
def test_lossy_video_tracks_nearly_as_well(drawn, expected, tmp_path, crf):
    sources = []
    for camera in OFFSETS:
        (tmp_path / camera).mkdir()
        for row in ROWS:
            first = png(drawn, camera, row, 0)
            black = np.zeros_like(cv2.imread(str(first), cv2.IMREAD_GRAYSCALE))
            with av.open(str(tmp_path / camera / f"{row}.mp4"), "w") as container:
                stream = container.add_stream("libx264", rate=25)
                stream.height, stream.width = black.shape
                stream.pix_fmt, stream.options = "yuv420p", {"crf": crf}
                for _ in range(int(first.stem)):
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(black, format="gray")))
                for k in range(COUNT):
                    mask = cv2.imread(str(png(drawn, camera, row, k)), cv2.IMREAD_GRAYSCALE)
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(mask, format="gray")))
                container.mux(stream.encode(None))
        sources.append({"name": camera, "masks": {row: tmp_path / camera / f"{row}.mp4" for row in ROWS}})
    tracks = track(make_capture(tmp_path, COUNT, cameras=sources))
    assert tracks.masks_used.all() and not any("mask" in str(found["kind"]) for found in tracks.meta["findings"])
    assert (errors_mm(tracks).mean(0) < errors_mm(expected).mean(0) + 0.05).all()


def findings(tracks, kind: str) -> list[Finding]:
    return [Finding.from_json(found) for found in tracks.meta["findings"] if found["kind"] == kind]


def test_a_black_camera_is_excluded_and_reported(drawn, tmp_path):
    tracks = track(make_capture(rewritten(drawn, tmp_path, lambda m: 0 * m, ["cam1"]), COUNT))
    assert tracks.camera_names == ("cam0", "cam2") and tracks.tracked().all()
    (found,) = findings(tracks, "masks_black")
    assert found.camera == "cam1" and "all black: it is not used" in found.message


def test_a_camera_without_masks_is_reported(drawn):
    cameras = [source(drawn, "cam0"), {"name": "cam1", "video": "cam1.mp4"}, source(drawn, "cam2")]
    tracks = track(make_capture(drawn, COUNT, cameras=cameras))
    assert tracks.camera_names == ("cam0", "cam2")
    assert [found.camera for found in findings(tracks, "camera_without_masks")] == ["cam1"]


def test_a_camera_whose_masks_are_of_other_frames_is_reported(drawn, tmp_path):
    folder = rewritten(drawn, tmp_path, lambda m: m)
    for row in ROWS:
        for k in range(COUNT):
            own = png(folder, "cam1", row, k)
            own.rename(own.with_name(f"{int(own.stem) + 100:06d}.png"))
    tracks = track(make_capture(folder, COUNT))
    (found,) = findings(tracks, "camera_not_used")
    assert found.camera == "cam1" and found.message.startswith(f"used in 0 of {COUNT} frames: it has no masks")


def test_a_camera_whose_masks_never_fit_is_reported(drawn, tmp_path):
    folder = rewritten(drawn, tmp_path, lambda m: np.roll(m, 60, axis=1), ["cam2"])
    tracks = track(make_capture(folder, COUNT))
    (found,) = findings(tracks, "camera_not_used")
    assert found.camera == "cam2" and found.message.startswith(f"used in 0 of {COUNT} frames: ")
    assert " of its " in found.message
    assert (errors_mm(tracks).mean(0) < 0.05).all()


def test_one_picture_unlike_the_others_is_excluded_and_reported(drawn, tmp_path):
    folder = rewritten(drawn, tmp_path, lambda m: m)
    odd = png(folder, "cam1", "upper", 2)
    cv2.imwrite(str(odd), cv2.imread(str(odd), cv2.IMREAD_GRAYSCALE) // 255 * 100)
    tracks = track(make_capture(folder, COUNT))
    assert not tracks.masks_used[2, 0, 1] and tracks.masks_used.sum() == tracks.masks_used.size - 1
    (found,) = findings(tracks, "masks_odd")
    assert found.camera == "cam1" and f"{odd.name} reaches only 100, but teeth are 255" in found.message


def test_black_masks_everywhere_and_masks_of_three_levels_are_refused(drawn, tmp_path):
    black = rewritten(drawn, tmp_path / "black", lambda m: 0 * m, ["cam0", "cam1"])
    with pytest.raises(TrackingError, match=r"1 of 3 cameras .*cam0: masks are all black; cam1: masks are all black"):
        track(make_capture(black, COUNT))

    def two_rows(mask: np.ndarray) -> np.ndarray:
        return np.maximum(mask, np.roll(mask, 40, axis=0) // 2)

    three = rewritten(drawn, tmp_path / "three", two_rows, ["cam1"])
    with pytest.raises(CaptureError, match=r"cam1/upper/.*png: it has the levels 0, 127, 255.*upper_value"):
        track(make_capture(three, COUNT))
    assert CAMERAS[1].name == "cam1" and FIRST


def test_a_camera_that_biases_the_first_frame_is_excluded(drawn, tmp_path):
    folder = rewritten(drawn, tmp_path, lambda m: np.roll(m, 25, axis=0), ["cam1"])
    tracks = track(make_capture(folder, COUNT, away_mm=1.5))
    assert [found.camera for found in findings(tracks, "camera_not_used")] == ["cam1"]
    assert (errors_mm(tracks).mean(0) < 0.05).all()
    summary = track_summary(tracks)
    assert summary["frames_used"] == {"cam0": COUNT, "cam1": 0, "cam2": COUNT}
    assert summary["coverage_error_percent"] < 1.0  # of the masks that are used
    assert any(f"camera cam1: used in 0 of {COUNT} frames" in line for line in track_lines(summary))
