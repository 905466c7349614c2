"""Overlays against points projected by OpenCV, hidden surfaces, and the contact sheet's layout."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from jawusd.formats.capture import CameraSource
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera, make_transform
from jawusd.media import overlay
from jawusd.media.overlay import Backdrop
from jawusd.media.writers import VideoWriter

SIZE = (160, 120)
K = np.array([[160.0, 0, 80], [0, 160, 60], [0, 0, 1]])
CAMERA = Camera("cam", SIZE, K, np.array([-0.3, 0.1, 0.001, 0.002, 0.0]), make_transform(np.eye(3), [0, 0, 100.0]))
RED, GRAY = (215, 45, 40), (150, 150, 150)


def patch(half_mm: float, depth_mm: float = 0.0, colour: tuple[int, int, int] = RED, steps: int = 24) -> Mesh:
    """Make a finely divided square facing the camera."""
    side = np.linspace(-half_mm, half_mm, steps)
    x, y = np.meshgrid(side, side)
    k = (np.arange(steps - 1)[:, None] * steps + np.arange(steps - 1)).ravel()
    faces = np.concatenate([np.c_[k, k + steps, k + 1], np.c_[k + 1, k + steps, k + steps + 1]])
    vertices = np.c_[x.ravel(), y.ravel(), np.full(x.size, depth_mm)]
    return Mesh(vertices, faces, np.tile(np.uint8(colour), (len(vertices), 1)))


def outline(half_mm: float) -> np.ndarray:
    """Paint the square's outline as OpenCV projects it through the lens."""
    t = np.linspace(-half_mm, half_mm, 100)
    h = np.full(100, half_mm)
    ring = np.concatenate([np.c_[t, -h], np.c_[h, t], np.c_[-t, h], np.c_[-h, -t]])
    ring = np.c_[ring, np.zeros(400)]
    seen = cv2.projectPoints(ring, np.zeros(3), np.array([0, 0, 100.0]), K, CAMERA.distortion)[0]
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillPoly(mask, [np.round(seen * 256).astype(np.int32)], 1, shift=8)
    return mask > 0


def changed(image: np.ndarray, background: int = 100) -> np.ndarray:
    return (image != background).any(axis=2)


def picture() -> np.ndarray:
    return np.full((120, 160, 3), 100, np.uint8)


def test_the_overlay_covers_what_the_lens_shows() -> None:
    scan = overlay.PlacedScan(patch(25), np.eye(4), (255, 0, 0))
    drawn = overlay.draw_overlay(picture(), CAMERA, [scan], fill=0.5)
    expected = outline(25)
    assert np.count_nonzero(changed(drawn) != expected) < 0.03 * np.count_nonzero(expected)  # OpenCV paints the border
    assert drawn[60, 80].tolist() == [178, 50, 50]
    edge = np.flatnonzero((drawn[60] == (255, 0, 0)).all(axis=1))
    assert len(edge) == 4 and edge[1] - edge[0] == 1 and edge[3] - edge[2] == 1  # two px on either side
    moved = make_transform(np.eye(3), [10.0, 0, 0])
    shifted = overlay.draw_overlay(picture(), CAMERA, [overlay.PlacedScan(patch(25), moved, (255, 0, 0))])
    assert np.flatnonzero(changed(shifted)[60])[0] == pytest.approx(np.flatnonzero(expected[60])[0] + 16, abs=2)


def test_nearer_scans_and_gum_hide_farther_ones() -> None:
    far = overlay.PlacedScan(patch(25), np.eye(4), (255, 0, 0))
    near = overlay.PlacedScan(patch(8, -20), np.eye(4), (0, 0, 255))
    for scans in ([far, near], [near, far]):
        assert overlay.draw_overlay(picture(), CAMERA, scans, fill=1)[60, 80].tolist() == [0, 0, 255]
    mixed = patch(25)
    colors = mixed.colors.copy()
    colors[np.abs(mixed.vertices[:, :2]).max(axis=1) < 10] = GRAY
    drawn = overlay.draw_overlay(
        picture(), CAMERA, [overlay.PlacedScan(Mesh(mixed.vertices, mixed.faces, colors), np.eye(4), (255, 0, 0))]
    )
    assert drawn[60, 80].tolist() == [100, 100, 100] and changed(drawn)[60].any()


def test_lost_scans_are_left_out_and_the_picture_is_not_touched() -> None:
    image = picture()
    lost = overlay.PlacedScan(patch(25), np.full((4, 4), np.nan), (255, 0, 0))
    assert np.array_equal(overlay.draw_overlay(image, CAMERA, [lost]), image)
    overlay.draw_overlay(image, CAMERA, [overlay.PlacedScan(patch(25), np.eye(4), (255, 0, 0))])
    assert not changed(image).any()
    with pytest.raises(ValueError, match="160, 120"):
        overlay.draw_overlay(image[:50], CAMERA, [lost])


def tracks(count: int) -> Tracks:
    pose = np.tile(np.eye(4), (count, 1, 1))
    lower = pose.copy()
    lower[:, 1, 3] = 30
    lower[1] = np.nan
    zeros = {
        name: np.zeros(shape)
        for name, shape in {
            "status": (count, 2), "coverage_error": (count, 2, 1), "masks_used": (count, 2, 1),
            "covariance_upper": (count, 6, 6),
            "covariance_lower": (count, 6, 6), "covariance_relative": (count, 6, 6), "sigma_mm": (count, 5),
            "residual_px": (count, 2), "matched_px": (count, 2),
        }.items()
    }  # fmt: skip
    return Tracks(
        frames=np.arange(10, 10 + count),
        T_world_upper=pose, T_world_lower=lower, T_upper_lower=lower,
        raw_T_world_upper=pose, raw_T_world_lower=lower, raw_T_upper_lower=lower,
        prior_aided=np.zeros(count, bool), camera_names=("cam",), **zeros,
    )  # fmt: skip


def test_tracking_sheet_shows_rows_of_frames_and_columns_of_cameras(tmp_path: Path) -> None:
    path = tmp_path / "cam.mp4"
    with VideoWriter(path, SIZE, 24) as out:
        for k in range(3):
            out.write(np.full((120, 160, 3), 80 + 40 * k, np.uint8))
    behind = {"cam": Backdrop(CameraSource(name="cam", video=path), 10)}
    sheet = overlay.tracking_sheet(tracks(4), [10, 11, 13], [CAMERA], behind, patch(12), patch(12), tile_px=(96, 64))
    assert sheet.shape == (3 * (64 + 22), 96, 3)
    first, second, third = np.split(sheet, 3)

    def has(tile: np.ndarray, colour: tuple[int, int, int]) -> bool:
        return bool((np.abs(tile[22:].astype(int) - colour).max(axis=2) < 30).any())

    assert has(first, overlay.UPPER_COLOUR) and has(first, overlay.LOWER_COLOUR)
    assert has(second, overlay.UPPER_COLOUR) and not has(second, overlay.LOWER_COLOUR)  # the lower jaw was lost
    assert (third[22:] == 60).all()  # the camera had stopped
    assert all((tile[:22] == 255).any() for tile in (first, second, third))
    with pytest.raises(ValueError, match="frame 99 is not in the tracks"):
        overlay.tracking_sheet(tracks(4), [99], [CAMERA], behind, patch(12), patch(12))
    overlay.save_png(tmp_path / "sheet.png", sheet)
    assert np.array_equal(cv2.imread(str(tmp_path / "sheet.png"))[..., ::-1], sheet)


def test_contact_sheet_layout() -> None:
    tiles = [np.full((4, 6, 3), k, np.uint8) for k in (1, 2, 3)]
    sheet = overlay.contact_sheet(tiles, 2)
    assert sheet[::4, ::6, 0].tolist() == [[1, 2], [3, 0]]
    for bad in ([], [tiles[0], tiles[1][:2]]):
        with pytest.raises(ValueError, match="equal sizes"):
            overlay.contact_sheet(bad, 2)
