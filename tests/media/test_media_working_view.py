"""The working picture against full-size undistortion and against projected points."""

import cv2
import numpy as np
import pytest

from jawusd.geometry import make_transform
from jawusd.geometry.camera import Camera
from jawusd.media.working_view import WorkingView

LENSES = {
    "none": np.zeros(5),
    "long": np.array([-0.1, 0.05, 0.001, -0.0005, 0.0]),
    "barrel": np.array([-0.32, 0.12, 0.002, 0.001, -0.02]),
    "pincushion": np.array([0.25, 0.05, -0.001, 0.002, 0.0]),
}


def camera(lens: str, size: tuple[int, int] = (640, 360), focal_px: float = 700.0) -> Camera:
    K = np.array([[focal_px, 0, size[0] / 2 + 7.3], [0, focal_px * 1.02, size[1] / 2 - 5.1], [0, 0, 1]])
    rotation = cv2.Rodrigues(np.array([0.1, -0.3, 0.05]))[0]
    return Camera("cam", size, K, LENSES[lens], make_transform(rotation, np.array([3.0, -2.0, 200.0])))


def reference(source: Camera, mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Undistort at full size, then average areas."""
    maps = cv2.initUndistortRectifyMap(source.K, source.distortion, None, source.K, source.size_px, cv2.CV_32FC1)
    return cv2.resize(cv2.remap(mask, *maps, cv2.INTER_LINEAR), size, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("size", [(320, 180), (160, 90), (640, 360)])
def test_masks_anywhere_equal_full_size_undistortion(lens: str, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(len(lens))
    source = camera(lens)
    view = WorkingView(source, size)
    places = [(0, 0), (639, 359), (0, 359), (320, 0), *rng.integers(0, [640, 360], (8, 2)).tolist()]
    for x, y in places:
        mask = np.zeros((360, 640), np.uint8)
        cv2.ellipse(mask, (x, y), tuple(rng.integers(1, 90, 2).tolist()), float(rng.uniform(0, 180)), 0, 360, 255, -1)
        found, expected = view.mask(mask), reference(source, mask, size)
        assert found.dtype == np.uint8 and np.abs(found.astype(int) - expected).max() <= 1
        assert np.array_equal(found, view.picture(mask))
    assert not view.mask(np.zeros((360, 640), np.uint8)).any()


def test_a_single_pixel_is_found_wherever_it_is() -> None:
    source = camera("barrel")
    view = WorkingView(source, (320, 180))
    for x, y in np.random.default_rng(3).integers(0, [640, 360], (60, 2)):
        mask = np.zeros((360, 640), np.uint8)
        mask[y, x] = 255
        assert np.array_equal(view.mask(mask), view.picture(mask))


@pytest.mark.parametrize("size", [(480, 270), (427, 240)])  # reductions by 4 / 3 and, uneven, by about 3 / 2
def test_edges_lie_where_points_project(size: tuple[int, int]) -> None:
    for lens, fine in (("long", 8), ("barrel", 8)):
        source = camera(lens)
        angle = np.linspace(0, 2 * np.pi, 721)[:-1]
        ring = np.stack([30 * np.cos(angle), 18 * np.sin(angle), 4 * np.sin(3 * angle)], -1)
        rotation, translation = source.T_cam_world[:3, :3], source.T_cam_world[:3, 3]
        seen = cv2.projectPoints(ring, cv2.Rodrigues(rotation)[0], translation, source.K, source.distortion)[0][:, 0]
        # Paint the outline at 8 times the size (OpenCV takes 1/256 px) and average down: an exact soft mask.
        canvas = np.zeros((360 * fine, 640 * fine), np.uint8)
        corners = np.round(((seen + 0.5) * fine - 0.5) * 256).astype(np.int32)
        cv2.fillPoly(canvas, [corners], 255, cv2.LINE_AA, 8)
        mask = cv2.resize(canvas, (640, 360), interpolation=cv2.INTER_AREA)
        view = WorkingView(source, size)
        working = view.mask(mask)
        expected = view.camera.project_pinhole(ring)
        inward = expected.mean(0) - expected
        inward /= np.linalg.norm(inward, axis=1, keepdims=True)
        # Find the half-covered place along each normal-ish ray through the projected point.
        offsets = np.linspace(-2, 2, 81)
        where = (expected[:, None] + offsets[:, None] * inward[:, None]).astype(np.float32)
        profile = cv2.remap(working.astype(np.float32), where, None, cv2.INTER_LINEAR)
        crossing = offsets[np.argmax(profile >= 127.5, axis=1)]
        assert abs(crossing.mean()) < 0.05  # a half-pixel mistake would show as 0.12 to 0.25 on one side
        cos, sin = np.cos(angle), np.sin(angle)
        assert abs((crossing * cos).mean() * 2) < 0.04 and abs((crossing * sin).mean() * 2) < 0.04
        assert np.abs(crossing).max() < 0.3


def test_working_camera_is_the_scaled_pinhole() -> None:
    source = camera("barrel")
    view = WorkingView(source, (320, 180))
    assert view.camera.distortion.size == 0 and view.camera.size_px == (320, 180)
    assert np.allclose(view.camera.K, source.scaled((320, 180)).K)
    points = np.random.default_rng(0).normal(size=(50, 3)) * 15
    full = source.undistort_pixels(source.project(points))
    assert np.allclose(view.camera.project(points), (full + 0.5) / 2 - 0.5, atol=1e-6)


def test_colour_pictures_and_wrong_pictures() -> None:
    view = WorkingView(camera("long"), (320, 180))
    image = np.random.default_rng(1).integers(0, 256, (360, 640, 3), dtype=np.uint8)
    working = view.picture(image)
    assert working.shape == (180, 320, 3)
    assert np.array_equal(working[..., 1], view.picture(np.ascontiguousarray(image[..., 1])))
    for bad in (image[:180], image.astype(np.float32)):
        with pytest.raises(ValueError, match="640, 360"):
            view.picture(bad)
    for size in ((1280, 720), (0, 180)):
        with pytest.raises(ValueError, match="working size"):
            WorkingView(camera("long"), size)
