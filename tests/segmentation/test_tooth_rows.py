"""Rows of teeth in synthetic pictures of mouths, compared with their true masks."""

import cv2
import numpy as np
import pytest

from jawusd.segmentation.rows import tooth_rows

SKIN, LIP, DARK, TOOTH, GREY = (190, 140, 115), (150, 80, 75), (25, 12, 12), (225, 215, 195), (70, 80, 90)


def mouth(opening_px, *, size=(360, 640), tint=(1.0, 1.0, 1.0), chin=SKIN, teeth=10, aside_px=0):
    """Return a drawn mouth, shape (H, W, 3), and the masks of both rows, shape (2, H, W).

    The lower row is moved to the right by `aside_px`.
    """
    height, width = size
    picture = np.full((height, width, 3), SKIN, np.uint8)
    picture[:, : width // 8] = GREY
    x, y = width // 2, height // 2
    cv2.ellipse(picture, (x, y), (150, 62 + opening_px // 2), 0, 0, 360, LIP, -1)
    cv2.ellipse(picture, (x, y), (128, 42 + opening_px // 2), 0, 0, 360, DARK, -1)
    cv2.circle(picture, (x, y + 120), 25, chin, -1)
    masks = np.zeros((2, height, width), np.uint8)
    for row, top in enumerate((y - opening_px // 2 - 26, y + opening_px // 2)):
        for tooth in range(-(teeth // 2), teeth // 2):
            left = x + tooth * 20 + row * aside_px
            cv2.rectangle(masks[row], (left + 1, top), (left + 18, top + 25), 255, -1)
    picture[(masks > 0).any(0)] = TOOTH
    noise = np.random.default_rng(3).normal(0, 4, picture.shape)
    return np.clip(picture * np.array(tint) + noise, 0, 255).astype(np.uint8), masks


def overlap(one, other):
    return ((one > 0) & (other > 0)).sum() / ((one > 0) | (other > 0)).sum()


@pytest.mark.parametrize("opening_px", [8, 25, 70])
@pytest.mark.parametrize("tint", [(1.0, 1.0, 1.0), (0.5, 0.45, 0.4), (1.0, 0.9, 0.7)])
def test_rows_apart_are_told_from_one_another(opening_px, tint):
    picture, masks = mouth(opening_px, tint=tint, chin=(215, 170, 150))
    found = tooth_rows(picture)
    assert found is not None and found.bridged < 0.1
    assert overlap(found.masks[0], masks[0]) > 0.75 and overlap(found.masks[1], masks[1]) > 0.75


def test_narrow_rows_of_a_wide_open_mouth_belong_together():
    """From the side, the mouth is taller than the visible teeth are wide, and the chin moves backwards."""
    picture, masks = mouth(160, teeth=6, aside_px=40)
    found = tooth_rows(picture)
    assert found is not None and found.bridged < 0.1
    assert overlap(found.masks[0], masks[0]) > 0.75 and overlap(found.masks[1], masks[1]) > 0.75


def test_closed_rows_are_said_to_be_bridged():
    found = tooth_rows(mouth(0)[0])
    assert found is None or found.bridged > 0.15


def test_a_face_without_teeth_has_no_rows():
    """Grey walls and bright skin are not teeth."""
    picture = mouth(20)[0]
    picture[(picture > 180).all(2)] = DARK
    assert tooth_rows(picture) is None


def test_masks_have_the_size_of_the_picture():
    picture, masks = mouth(20)
    large = cv2.resize(picture, (1601, 901))
    found = tooth_rows(large)
    assert found is not None and found.masks.shape == (2, 901, 1601)
    wanted = cv2.resize(masks[0], (1601, 901), interpolation=cv2.INTER_NEAREST)
    assert overlap(found.masks[0], wanted) > 0.75
