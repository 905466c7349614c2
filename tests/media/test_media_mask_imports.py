"""Masks as other programs export them: transparency in video, label images, variable rates; each written by FFmpeg."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from jawusd.base.errors import CaptureError, FormatError
from jawusd.formats.capture import CameraSource, load_capture
from jawusd.media.clip import Timeline
from jawusd.media.masks import MaskReader, open_masks
from jawusd.media.writers import VideoWriter

SIZE = (64, 48)
COUNT = 8
SPAN = range(2, 7)  # frames that were segmented
CODECS = {
    "prores 4444": ("prores_ks", "yuva444p10le", "mov", {"profile": "4444"}),
    "png in mov": ("png", "rgba", "mov", {}),
    "animation": ("qtrle", "argb", "mov", {}),
    "vp9": ("libvpx-vp9", "yuva420p", "webm", {"lossless": "1"}),
    "ffv1": ("ffv1", "yuva444p", "mkv", {}),
}


def mask(k: int) -> np.ndarray:
    image = np.zeros(SIZE[::-1], np.uint8)
    image[8 + k : 20 + k, 10 : 34 + k] = 255
    return image


def footage(k: int, seed: int = 0) -> np.ndarray:
    """Return a picture of a face, (h, w, 3)."""
    return np.random.default_rng([seed, k]).integers(60, 200, (*SIZE[::-1], 3), dtype=np.uint8)


def write(path: Path, pictures: list[np.ndarray], codec: str, pixels: str, options: dict, pts: list[int] | None = None):
    """Encode (h, w), (h, w, 3) or (h, w, 4) pictures, at 1000 ticks per second if time stamps are given."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=1000 if pts else 24)
        stream.width, stream.height, stream.pix_fmt = *SIZE, pixels
        stream.options = options
        if pts:
            stream.codec_context.time_base = Fraction(1, 1000)
        for k, picture in enumerate(pictures):
            name = "gray" if picture.ndim == 2 else {3: "rgb24", 4: "rgba"}[picture.shape[2]]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=name)
            if pts:
                frame.pts, frame.time_base = pts[k], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def cut_out(k: int) -> np.ndarray:
    """Return what a rotoscoping program renders: the footage with its matte, opaque where nothing was segmented."""
    alpha = mask(k) if k in SPAN else np.full(SIZE[::-1], 255, np.uint8)
    return np.dstack([footage(k), alpha])


@pytest.mark.parametrize("kind", CODECS)
def test_transparency_is_the_mask(tmp_path, kind):
    codec, pixels, suffix, options = CODECS[kind]
    path = write(tmp_path / f"upper.{suffix}", [cut_out(k) for k in range(COUNT)], codec, pixels, options)
    with MaskReader(path, SIZE) as reader:
        for k in (*range(COUNT), 4):
            found = reader.read(k)
            if k in SPAN:
                assert np.array_equal(found, mask(k))
            else:
                assert found is None


def test_transparency_in_png_files_likewise(tmp_path):
    for k in range(COUNT):
        cv2.imwrite(str(tmp_path / f"{k:04d}.png"), cut_out(k))
    with MaskReader(tmp_path / "%04d.png", SIZE) as reader:
        found = [reader.read(k) for k in range(COUNT)]
    assert [k for k in range(COUNT) if found[k] is not None] == list(SPAN)
    assert all(np.array_equal(found[k], mask(k)) for k in SPAN)


def test_transparency_that_cuts_nothing_out_is_refused(tmp_path):
    opaque = np.full(SIZE[::-1], 255, np.uint8)
    pictures = [np.dstack([footage(k), opaque]) for k in range(COUNT)]
    path = write(tmp_path / "upper.mov", pictures, "prores_ks", "yuva444p10le", {"profile": "4444"})
    with pytest.raises(CaptureError, match=r"upper\.mov: the alpha channel is opaque in all 8 images.*RGB \+ Alpha"):
        MaskReader(path, SIZE)
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{k:04d}.png"), picture)
    with pytest.raises(CaptureError, match=r": the alpha channel is opaque in all 8 images"):
        MaskReader(tmp_path / "%04d.png", SIZE)
    # A matte in black and white may come with an opaque alpha channel.
    matte = [np.dstack([mask(k)] * 3 + [opaque]) for k in range(COUNT)]
    found = MaskReader(write(tmp_path / "matte.mov", matte, "png", "rgba", {}), SIZE).read(3)
    assert np.array_equal(found, mask(3))


@pytest.mark.parametrize(("codec", "pixels"), [("png", "rgb24"), ("libx264", "yuv444p")])
def test_mattes_without_transparency_may_be_coloured(tmp_path, codec, pixels):
    red = [np.dstack([mask(k), 0 * mask(k), 0 * mask(k)]) for k in range(COUNT)]
    path = write(tmp_path / "upper.mov", red, codec, pixels, {"qp": "0"} if codec == "libx264" else {})
    found = MaskReader(path, SIZE).read(3)
    assert np.abs(found.astype(int) - mask(3)).max() <= 4


def test_footage_named_as_masks_is_refused(tmp_path):
    path = tmp_path / "cam0.mp4"
    with VideoWriter(path, SIZE, 24, quality_crf=4) as out:
        for k in range(COUNT):
            out.write(footage(k))
    with pytest.raises(CaptureError, match=r"cam0\.mp4: image 0: \d+% of its pixels are gray.*and not the footage"):
        MaskReader(path, SIZE).read(2)
    cv2.imwrite(str(tmp_path / "7.png"), footage(7))
    with pytest.raises(CaptureError, match=r"7\.png: \d+% of its pixels are gray"):
        MaskReader(tmp_path / "%d.png", SIZE).read(7)


def label_image(k: int, upper: int, lower: int) -> np.ndarray:
    image = np.zeros(SIZE[::-1], np.uint8)
    image[mask(k) > 0] = upper
    image[36:44, 12:50] = lower
    return image


def rows_of(path: Path, upper: int, lower: int) -> CameraSource:
    return CameraSource(name="a", masks={"labels": path, "upper_value": upper, "lower_value": lower})


@pytest.mark.parametrize("values", [(1, 2), (255, 128), (2, 1)])
@pytest.mark.parametrize("kind", ["png", "sixteen", "gray.mkv", "rgb.mov", "h264.mp4"])
def test_labels_tell_the_rows(tmp_path, kind, values):
    images = [label_image(k, *values) for k in range(COUNT)]
    if kind in ("png", "sixteen"):
        path = tmp_path / "%03d.png"
        for k, image in enumerate(images):
            cv2.imwrite(str(path) % k, image.astype(np.uint16) if kind == "sixteen" else image)
    elif kind == "rgb.mov":
        path = write(tmp_path / kind, [np.dstack([image] * 3) for image in images], "png", "rgb24", {})
    elif kind == "gray.mkv":
        path = write(tmp_path / kind, images, "ffv1", "gray", {})
    else:
        path = write(tmp_path / kind, images, "libx264", "yuv420p", {"qp": "0"})
    upper, lower = open_masks(rows_of(path, *values), SIZE)
    for k in (0, 1, 5):
        assert np.array_equal(upper.read(k), np.where(images[k] == values[0], 255, 0))
        assert np.array_equal(lower.read(k), np.where(images[k] == values[1], 255, 0))
    upper.close(), lower.close()


def test_labels_that_mean_nothing_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), label_image(0, 1, 3))
    soft = cv2.GaussianBlur(label_image(1, 255, 128), (0, 0), 1.0)
    cv2.imwrite(str(tmp_path / "1.png"), soft)
    cv2.imwrite(str(tmp_path / "2.png"), np.dstack([label_image(2, 128, 0), label_image(2, 0, 128), 0 * soft]))
    for number, values, message in (
        (0, (1, 2), r"0\.png: the label image has the values 0, 1, 3; expected only 0, 1 and 2.*masks\.upper_value"),
        (1, (255, 128), r"1\.png: the label image has the values 0, .* and \d+ more; expected only 0, 128 and 255"),
        (2, (255, 128), r"2\.png: the label image is coloured"),
    ):
        upper, _ = open_masks(rows_of(tmp_path / "%d.png", *values), SIZE)
        with pytest.raises(CaptureError, match=message):
            upper.read(number)
    lossy = write(tmp_path / "lossy.mp4", [label_image(k, 255, 128) for k in range(4)], "libx264", "yuv420p", {})
    with pytest.raises(CaptureError, match=r"lossy\.mp4: image 1: the label image has the values .*lossy"):
        open_masks(rows_of(lossy, 255, 128), SIZE)[0].read(1)


HEAD = (
    'format = "jawusd-capture/1"\nname = "x"\nunits = "mm"\nfps = 24.0\n[scans]\nupper_teeth = "s.ply"\n'
    'lower_teeth = "t.ply"\n[[camera]]\nname = "a"\n'
)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('labels = "l.mkv"', "needs upper_value and lower_value"),
        ('labels = "l.mkv", upper_value = 1, lower_value = 1', "are both 1"),
        ('labels = "l.mkv", upper = "u.mkv", upper_value = 1, lower_value = 2', "both labels and upper or lower"),
        ('upper = "u.mkv", lower = "l.mkv", upper_value = 1', "apply only to label images, which hold both arches"),
        ('upper = "l.mkv", lower = "l.mkv"', "the same file, which needs upper_value and lower_value"),
        ('labels = "l.mkv", upper_value = 0, lower_value = 2', "must be 1 or more"),
    ],
)
def test_a_capture_says_what_labels_mean(tmp_path, keys, message):
    for name in ("s.ply", "t.ply", "l.mkv", "u.mkv"):
        (tmp_path / name).touch()
    path = tmp_path / "capture.toml"
    path.write_text(HEAD + 'masks = { labels = "l.mkv", upper_value = 1, lower_value = 2 }\n')
    masks = load_capture(path).cameras[0].masks
    assert masks.upper == masks.lower == tmp_path / "l.mkv" and masks.labels == (1, 2)
    assert masks.exchanged.labels == (2, 1)
    path.write_text(HEAD + f"masks = {{ {keys} }}\n")
    with pytest.raises(FormatError, match=message):
        load_capture(path)


LEFT_OUT = (3, 4, 9)  # of 14 frames: 11 pictures
NUMBERS = [k for k in range(14) if k not in LEFT_OUT]


@pytest.fixture
def variable(tmp_path) -> Path:
    """A clip of variable rate, at 25 frames per second with some left out."""
    pictures = [footage(k) for k in NUMBERS]
    return write(tmp_path / "cam.mp4", pictures, "libx264", "yuv420p", {}, [40 * k for k in NUMBERS])


def frames_of(source: CameraSource) -> list[int | None]:
    """Return which picture's mask is given at every frame; it tells by its area."""
    areas = {int(mask(k).sum()): k for k in range(14)}
    upper, lower = open_masks(source, SIZE)
    with upper, lower:
        assert upper.count == 14
        forwards = [None if (found := upper.read(k)) is None else areas[int(found.sum())] for k in range(-1, 16)]
    with upper:
        again = [None if (found := upper.read(k)) is None else areas[int(found.sum())] for k in range(15, -2, -1)]
    assert again[::-1] == forwards
    return forwards[1:-2]


def test_masks_of_a_variable_rate_are_shown_at_their_time(tmp_path, variable):
    expected = [k if k in NUMBERS else None for k in range(14)]
    masks = [mask(k) for k in NUMBERS]
    for p, image in enumerate(masks):
        cv2.imwrite(str(tmp_path / f"u{p:06d}.png"), image)
        cv2.imwrite(str(tmp_path / f"l{p:06d}.png"), image)
    same = write(tmp_path / "same.mkv", masks, "ffv1", "gray", {}, [40 * k for k in NUMBERS])
    even = write(tmp_path / "even.mkv", masks, "ffv1", "gray", {})
    for upper in (tmp_path / "u%06d.png", same, even):
        source = CameraSource(name="a", video=variable, masks={"upper": upper, "lower": tmp_path / "l%06d.png"})
        assert frames_of(source) == expected
    # An editing program makes a constant rate of it, repeating pictures.
    filled = write(tmp_path / "filled.mkv", [mask(k) for k in range(14)], "ffv1", "gray", {})
    source = CameraSource(name="a", video=variable, masks={"upper": filled, "lower": tmp_path / "l%06d.png"})
    assert frames_of(source) == list(range(14))


def test_masks_that_cannot_belong_to_a_video_are_refused(tmp_path, variable):
    short = write(tmp_path / "short.mkv", [mask(k) for k in range(9)], "ffv1", "gray", {})
    source = CameraSource(name="a", video=variable, masks={"upper": short, "lower": short, **VALUES})
    with pytest.raises(CaptureError, match=r"short\.mkv: .* 9 images, but the camera's video has 11 in 14 frames"):
        open_masks(source, SIZE)
    cv2.imwrite(str(tmp_path / "u000012.png"), mask(1))
    source = CameraSource(name="a", video=variable, masks={"labels": tmp_path / "u%06d.png", **VALUES})
    with pytest.raises(CaptureError, match=r"numbered up to 12, .* only images 0 to 10 \(in 14 frames\)"):
        open_masks(source, SIZE)


VALUES = {"upper_value": 255, "lower_value": 128}


def test_a_timeline_finds_pictures_and_gaps():
    timeline = Timeline(np.array([0.0, 0.04, 0.08, 0.2, 0.201, 0.24, 0.28]), 25.0)
    assert timeline.count == 8 and timeline.missing == 2
    assert [timeline.picture(k) for k in range(-1, 9)] == [None, 0, 1, 2, None, None, 3, 5, 6, None]
    assert Timeline(np.zeros(4), 30.0).picture(3) == 3
