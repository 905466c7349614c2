"""What the values of mask pictures are taken for, against masks whose values are known."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image, ImageDraw

from jawusd.base.errors import CaptureError
from jawusd.formats.capture_parts import CameraSource, Masks
from jawusd.media.checks import survey_masks
from jawusd.media.mask_levels import MOST_SOFT, MaskLevels
from jawusd.media.masks import MaskReader, open_masks

SIZE = (160, 96)
COUNT = 12
NO_LABELS = {"upper_value": None, "lower_value": None}  # one folder for both rows


def teeth(k: int, scale: int = 1) -> np.ndarray:
    """Return a row of teeth drawn by Pillow, white on black, `scale` times the size."""
    image = Image.new("L", (SIZE[0] * scale, SIZE[1] * scale))
    draw = ImageDraw.Draw(image)
    for tooth in range(6):
        x, y = 20 + 18 * tooth + k, 40 + abs(tooth - 2.5) * 4
        draw.ellipse([x * scale, y * scale, (x + 16) * scale, (y + 24) * scale], fill=255)
    return np.asarray(image)


def written(folder: Path, pictures) -> MaskReader:
    folder.mkdir(exist_ok=True)
    for k, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{k:03d}.png"), picture)
    return MaskReader(folder / "%03d.png", SIZE)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("background", "white"), [(0, 1), (0, 2), (0, 100), (20, 220), (255, 0), (1, 0), (200, 60)])
def test_two_levels_of_any_value(tmp_path, bits, background, white):
    unit = 257 if bits == 16 and white > 2 else 1
    table = np.array([background, white]) * unit
    pictures = [table[teeth(k) // 255].astype(np.uint16 if bits == 16 else np.uint8) for k in range(COUNT)]
    reader = written(tmp_path, pictures)
    for k in range(COUNT):
        assert np.array_equal(reader.read(k), teeth(k))
    assert reader.levels.inverted == (background > white) and not reader.levels.usual and reader.odd == []


def test_half_the_way_between_the_levels_stays_the_outline(tmp_path):
    sharp = [teeth(k, 4) for k in range(COUNT)]
    soft = [cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) for image in sharp]
    for background, white in ((0, 100), (255, 0), (30, 250)):
        folder = tmp_path / f"{background}_{white}"
        reader = written(folder, [np.round(background + s / 255.0 * (white - background)) for s in soft])
        for k in (0, 5):
            assert np.abs(reader.read(k).astype(int) - soft[k]).max() <= round(255 / abs(white - background))


@pytest.mark.parametrize("blur_px", [1.0, 2.0, 3.0])
def test_blurred_masks_keep_their_outline(tmp_path, blur_px):
    blurred = [cv2.GaussianBlur(teeth(k), (0, 0), blur_px) for k in range(COUNT)]
    reader = written(tmp_path, blurred)
    for k in (0, 7):
        assert ((reader.read(k) > 127) != (teeth(k) > 127)).sum() < 0.04 * (teeth(k) > 127).sum() * blur_px


@pytest.mark.parametrize("crf", [12, 23, 32])
@pytest.mark.parametrize("inverted", [False, True])
def test_lossy_video_has_flat_levels_and_true_edges(tmp_path, crf, inverted):
    path = tmp_path / "upper.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height = SIZE
        stream.pix_fmt, stream.options = "yuv420p", {"crf": str(crf)}
        for k in range(COUNT):
            mask = np.zeros(SIZE[::-1], np.uint8) if k in (0, 6) else teeth(k)
            frame = av.VideoFrame.from_ndarray(255 - mask if inverted else mask, format="gray")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    reader = MaskReader(path, SIZE)
    assert reader.read(0) is None and reader.read(6) is None
    for k in (3, 7, 11):
        found = reader.read(k)
        assert ((found > 127) != (teeth(k) > 127)).sum() < 0.05 * (teeth(k) > 0).sum()
        assert (found[:20] == 0).mean() > 0.95
    assert reader.levels.inverted == inverted


def test_what_most_pictures_hold_counts(tmp_path):
    pictures = [teeth(k) for k in range(COUNT)]
    pictures[2] = teeth(2) // 255 * 100
    pictures[3] = 255 - teeth(3)
    pictures[4] = np.full(SIZE[::-1], 255, np.uint8)
    pictures[5] = np.random.default_rng(0).integers(0, 255, SIZE[::-1]).astype(np.uint8)
    pictures[6] = teeth(6).astype(np.uint16) * 257
    pictures[7] = np.zeros(SIZE[::-1], np.uint8)
    reader = written(tmp_path, pictures)
    found = [reader.read(k) for k in range(COUNT)]
    assert [k for k in range(COUNT) if found[k] is None] == [2, 3, 4, 5, 6, 7]
    expected = [
        "002.png reaches only 100, but teeth are 255",
        "003.png shows",
        "004.png is uniformly 255",
        "005.png is not a mask",
    ]
    for line, start in zip(reader.odd, [*expected, "006.png has 16 bits per channel"], strict=True):
        assert line.startswith(start)


def test_masks_of_few_frames_are_found_among_black_ones(tmp_path):
    pictures = [np.zeros(SIZE[::-1], np.uint8)] * 60
    pictures[37] = teeth(0) // 255 * 9
    assert np.array_equal(written(tmp_path, pictures).read(37), teeth(0))


def test_a_video_cut_out_on_black_is_doubted(tmp_path):
    skin = np.tile(np.linspace(40, 255, SIZE[0]), (SIZE[1], 1)).astype(np.uint8)
    reader = written(tmp_path, [np.where(teeth(k) > 0, skin, 0) for k in range(COUNT)])
    assert reader.levels.soft > MOST_SOFT


def test_single_teeth_in_levels_of_their_own_are_refused(tmp_path):
    numbers = [cv2.connectedComponents((teeth(k) > 0).astype(np.uint8))[1].astype(np.uint8) for k in range(COUNT)]
    with pytest.raises(CaptureError, match=r"000\.png: it has the levels 0, \d, \d; expected two"):
        written(tmp_path, numbers)


def test_survey_says_what_is_taken_and_what_is_not_used(tmp_path):
    for row, factor in (("upper", 100), ("lower", 0)):
        written(tmp_path / row, [teeth(k) // 255 * factor for k in range(COUNT)])
    masks = {row: tmp_path / row / "%03d.png" for row in ("upper", "lower")}
    found = survey_masks(CameraSource(name="left", masks=masks), SIZE)
    assert [(one.kind, one.severity, one.camera) for one in found] == [
        ("masks_black", "warning", "left"),
        ("mask_levels", "note", "left"),
    ]
    assert "the masks of the lower teeth are all black" in found[0].message
    assert "have the values 0 and 100: 100 is taken as teeth" in found[1].message
    assert survey_masks(CameraSource(name="right", video="right.mp4"), SIZE)[0].kind == "camera_without_masks"


def test_survey_finds_wrong_sizes_and_missing_labels(tmp_path):
    for k in range(COUNT):
        picture = teeth(k) // 255 * 3
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), picture[::2, ::2] if k == 7 else picture)
    masks = {row: tmp_path / "%03d.png" for row in ("upper", "lower")}
    source = CameraSource.model_construct(name="a", video=None, masks=Masks.model_construct(**masks, **NO_LABELS))
    with pytest.raises(CaptureError, match=r"007\.png: the mask is 80 x 48 px, but .* images are 160 x 96 px"):
        survey_masks(source, SIZE)
    cv2.imwrite(str(tmp_path / "007.png"), teeth(7) // 255 * 3)
    labels = {"labels": tmp_path / "%03d.png", "upper_value": 3, "lower_value": 4}
    found = survey_masks(CameraSource(name="a", masks=labels), SIZE)
    assert [one.message for one in found] == ["the masks of the lower teeth are all black and are not used."]


def test_label_pictures_may_have_a_palette(tmp_path):
    for k in range(3):
        image = Image.fromarray(teeth(k) // 255 * 2)
        image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])
        image.save(tmp_path / f"{k:03d}.png")
    upper, _ = open_masks(
        CameraSource(name="a", masks={"labels": tmp_path / "%03d.png", "upper_value": 2, "lower_value": 1}), SIZE
    )
    assert np.array_equal(upper.read(1), teeth(1))


def test_light_masks_up_to_the_border_are_doubted(tmp_path):
    framed = np.full(SIZE[::-1], 255, np.uint8)
    framed[[0, -1]] = framed[:, [0, -1]] = 0
    written(tmp_path / "upper", [np.where(teeth(k) > 0, 0, framed) for k in range(COUNT)])
    masks = {row: tmp_path / "upper" / "%03d.png" for row in ("upper", "lower")}
    source = CameraSource.model_construct(name="a", video=None, masks=Masks.model_construct(**masks, **NO_LABELS))
    assert [one.kind for one in survey_masks(source, SIZE)] == ["mask_polarity"]


@pytest.mark.parametrize("tagged", ["full", "limited"])
def test_the_range_that_a_video_announces_is_not_trusted(tmp_path, tagged):
    path = tmp_path / "upper.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height = SIZE
        stream.pix_fmt, stream.options = "yuv420p", {"qp": "0"}
        stream.codec_context.color_range = 2 if tagged == "full" else 1
        for k in range(COUNT):
            frame = av.VideoFrame(*SIZE, "yuv420p")
            luma = np.where(teeth(k) > 0, 235, 16) if tagged == "full" else teeth(k)  # the other one's values
            for plane, values in zip(frame.planes, (luma, None, None), strict=True):
                rows = np.full((plane.height, plane.line_size), 128, np.uint8)
                rows[:, : plane.width] = 128 if values is None else values
                plane.update(rows.tobytes())
            frame.color_range = 2 if tagged == "full" else 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    found = MaskReader(path, SIZE).read(4)
    assert np.array_equal(found, teeth(4))


@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("lossy", [False, True])
@pytest.mark.parametrize(("background", "white"), [(0, 255), (0, 90), (30, 220), (255, 0), (200, 60)])
def test_masks_are_the_values_of_all_pixels_though_few_are_looked_at(background, white, lossy, deep):
    scale = 257 if deep else 1
    levels = MaskLevels("brightest", background * scale, white * scale, deep, lossy)
    soft = cv2.GaussianBlur(teeth(0), (0, 0), 1.5) / 255.0
    picture = np.round(scale * (background + (white - background) * soft)).astype(np.uint16 if deep else np.uint8)
    stored = picture.copy()
    mask, odd = levels.coverage(picture)
    share = np.clip((stored.astype(np.float64) / scale - background) / (white - background), 0, 1)
    if lossy:
        share = np.where(share < 0.06, 0, np.where(share > 0.94, 1, share))
    assert odd == "" and mask.shape == picture.shape
    np.testing.assert_allclose(mask, 255 * share, atol=0.5 + 1e-9)
    assert (picture == stored).all()
