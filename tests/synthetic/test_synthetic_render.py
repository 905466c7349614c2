"""Rendered pictures compared with another rasteriser, OpenCV's lens model and geometric optics."""

import contextlib
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

from jawusd.base.errors import MissingDependencyError
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera, make_transform, so3_exp, transform_points
from jawusd.meshes import raster
from jawusd.synthetic import render
from jawusd.synthetic.anatomy import Surface, build_anatomy
from jawusd.synthetic.person import Person
from jawusd.synthetic.take import (
    BOARD_COLUMNS,
    BOARD_ROWS,
    SQUARE_MM,
    Scene,
    board,
    board_poses,
    build_cameras,
    perform,
)

SIZE = (480, 270)


Studio = Callable[..., tuple[render.Renderer, list[Camera]]]


@pytest.fixture
def studio() -> Iterator[Studio]:
    """Open a renderer with the three cameras; skip without EGL."""
    with contextlib.ExitStack() as stack:

        def open_studio(size: tuple[int, int] = SIZE) -> tuple[render.Renderer, list[Camera]]:
            cameras = build_cameras(size)
            try:
                renderer = render.Renderer(cameras)
            except MissingDependencyError as error:
                pytest.skip(f"no OpenGL without a display here: {error}")
            return stack.enter_context(renderer), cameras

        yield open_studio


def test_cameras_look_at_the_mouth_from_about_200_mm() -> None:
    cameras = build_cameras(SIZE)
    np.testing.assert_array_equal(cameras[0].T_cam_world, np.eye(4))
    for camera in cameras:
        mouth = np.array([0.0, 0.0, 206.0])
        assert 170 < np.linalg.norm(camera.centre_world() - mouth) < 240
        pixel = camera.project(mouth)
        assert (np.abs(pixel - np.array(SIZE) / 2) < np.array(SIZE) * 0.2).all()
    right_of_subject = cameras[2].centre_world()
    assert right_of_subject[0] < -60 < 60 < cameras[1].centre_world()[0]


def _square(half_mm: float, color: float) -> Surface:
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]]) * [half_mm, half_mm, 0.0]
    plain = np.zeros(4)
    return Surface(vertices, np.array([[0, 2, 1], [1, 2, 3]], np.int32), np.full((4, 3), color), plain, plain, plain)


def test_a_square_lands_where_opencv_projects_it(studio: Studio) -> None:
    renderer, cameras = studio()
    renderer.add("square", _square(9.0, 0.5), render.UPPER_TEETH)
    corners = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0.0]])
    edges = np.concatenate([np.linspace(a, b, 50) for a, b in zip(corners, np.roll(corners, -1, 0))])
    rng = np.random.default_rng(0)
    misses = []
    for _ in range(8):
        place = [rng.uniform(-25, 25), rng.uniform(-12, 12), 205.0]
        T = make_transform(so3_exp(rng.normal(0.0, 0.3, 3)), place)
        for k, camera in enumerate(cameras):
            picture = renderer.render(k, {"square": T}, np.eye(4))
            assert picture.lower.max() == 0
            rotation, _ = cv2.Rodrigues(camera.T_cam_world[:3, :3])
            outline, _ = cv2.projectPoints(
                transform_points(T, edges), rotation, camera.T_cam_world[:3, 3], camera.K, camera.distortion
            )
            misses.append(_miss(outline[:, 0], picture.upper / 255.0))
    misses = np.array(misses)
    assert np.abs(misses).max() < 0.25
    np.testing.assert_allclose(misses.mean(0), 0.0, atol=0.04)


def _miss(outline: np.ndarray, share: np.ndarray) -> list[float]:
    """Compare coverage with the area of an outline: shift right, shift down, outward offset [px]."""
    x, y = outline.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y  # shoelace formulas
    area = cross.sum() / 2
    centre = [((c + np.roll(c, -1)) * cross).sum() / (6 * area) for c in (x, y)]
    v, u = np.mgrid[: share.shape[0], : share.shape[1]]
    length = np.linalg.norm(np.diff(outline, axis=0), axis=1).sum()
    shift = [(share * c).sum() / share.sum() - middle for c, middle in zip((u, v), centre)]
    return [*shift, (share.sum() - abs(area)) / length]


def test_nearer_surfaces_hide_teeth_and_jitter_moves_outlines(studio: Studio) -> None:
    renderer, cameras = studio()
    renderer.add("tooth", _square(9.0, 0.5), render.LOWER_TEETH)
    renderer.add("lip", _square(5.0, 0.5))
    far, near = np.eye(4), np.eye(4)
    far[2, 3], near[2, 3] = 210.0, 200.0
    alone = renderer.render(0, {"tooth": far}, np.eye(4)).lower / 255.0
    hidden = renderer.render(0, {"tooth": far, "lip": near}, np.eye(4)).lower / 255.0
    behind = renderer.render(0, {"tooth": near, "lip": far}, np.eye(4)).lower / 255.0
    focal = cameras[0].K[0, 0]
    assert alone.sum() - hidden.sum() == pytest.approx((10 * focal / 200) ** 2, rel=0.02)
    assert behind.sum() == pytest.approx((18 * focal / 200) ** 2, rel=0.02)
    shift = np.broadcast_to([3.0, 0.0], (4, 4, 2))
    moved = renderer.render(0, {"tooth": far}, np.eye(4), jitter_px=(np.zeros((2, 2, 2)), shift)).lower / 255.0
    np.testing.assert_allclose(moved[:, :-3], alone[:, 3:], atol=0.01)


def test_boards_are_found_where_they_are_held(studio: Studio) -> None:
    renderer, cameras = studio((960, 540))
    renderer.add("board", board())
    cell = np.stack(np.meshgrid(np.arange(BOARD_COLUMNS), np.arange(BOARD_ROWS)), -1).reshape(-1, 2)
    middle = [(BOARD_COLUMNS - 1) / 2, (BOARD_ROWS - 1) / 2]
    corners = np.concatenate([(cell - middle) * SQUARE_MM, np.zeros((len(cell), 1))], 1)
    found = 0
    for T in board_poses(4, np.random.default_rng(1)):
        for k, camera in enumerate(cameras):
            gray = cv2.cvtColor(renderer.render(k, {"board": T}, T).color, cv2.COLOR_RGB2GRAY)
            ok, seen = cv2.findChessboardCornersSB(gray, (BOARD_COLUMNS, BOARD_ROWS))
            if not ok:
                continue
            found += 1
            expected = camera.project(transform_points(T, corners))
            seen = seen.reshape(-1, 2)
            error = min(np.abs(seen - expected).max(), np.abs(seen[::-1] - expected).max())
            assert error < 0.35
    assert found >= 11


def test_masks_of_the_mouth_agree_with_the_cpu_rasteriser(studio: Studio) -> None:
    renderer, cameras = studio((960, 540))
    person = Person(0)
    anatomy = build_anatomy(person)
    scene = Scene(person, anatomy, renderer)
    take = perform(person, anatomy.occlusion, 60, (0,), 0)
    for row in (24, 60):
        poses = scene.pose(take, row)
        for k in (0, 2):
            picture = scene.draw(k, take, row, poses, None)
            _, upper, lower, face, tongue = (None, *scene.occluders(take, row))
            visible = _visible(cameras[k], [upper, lower, face, tongue], [anatomy.upper.tooth, anatomy.lower.tooth])
            for label, coverage in ((1, picture.upper), (2, picture.lower)):
                drawn, expected = coverage > 127, visible == label
                assert expected.sum() > 3000
                outline = cv2.morphologyEx(expected.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
                # a tenth of a pixel along the outline, whose length is about half of its morphological gradient
                assert abs(int(drawn.sum()) - int(expected.sum())) < 0.1 * outline.sum() / 2
                assert (drawn != expected).sum() < 0.15 * outline.sum()


def _visible(camera: Camera, meshes: list[Mesh], teeth: list[np.ndarray]) -> np.ndarray:
    """Return the visible label per pixel: rasterise a finer pinhole picture, then apply OpenCV's lens."""
    fine = 3
    scaled = camera.scaled((fine * camera.size_px[0], fine * camera.size_px[1]))
    width, height = scaled.size_px
    depth, labels = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    for i, mesh in enumerate(meshes):
        points = np.empty(mesh.vertices.shape, np.float32)
        raster.project(mesh.vertices.astype(np.float32), scaled.projection_matrix().astype(np.float32), points)
        is_tooth = teeth[i][mesh.faces[:, 0]] != 0 if i < 2 else np.zeros(len(mesh.faces), bool)
        for kind, label in ((~is_tooth, 9), (is_tooth, i + 1)):
            if kind.any():
                faces = np.ascontiguousarray(mesh.faces[kind])
                raster.draw_depth_labels(points, faces, 0, 0, False, depth, labels, label)
    v, u = np.mgrid[: camera.size_px[1], : camera.size_px[0]].astype(np.float64)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(pixels, camera.K, camera.distortion, P=camera.K).reshape(-1, 2)
    at = fine * (ideal + 0.5) - 0.5
    votes = np.zeros((len(at), 10), np.uint8)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            x = np.clip(np.rint(at[:, 0] + dx), 0, width - 1).astype(int)
            y = np.clip(np.rint(at[:, 1] + dy), 0, height - 1).astype(int)
            votes[np.arange(len(at)), labels[y, x]] += 1
    out = np.zeros(len(at), np.uint8)
    for label in (1, 2):
        out[votes[:, label] >= 5] = label
    return out.reshape(camera.size_px[1], camera.size_px[0])


def test_the_light_goes_off(studio: Studio) -> None:
    renderer, _ = studio()
    renderer.add("square", _square(20.0, 0.6))
    T = np.eye(4)
    T[2, 3] = 200.0
    bright = renderer.render(0, {"square": T}, np.eye(4), light=1.0).color.mean()
    dark = renderer.render(0, {"square": T}, np.eye(4), light=0.05).color.mean()
    assert dark < 0.4 * bright


def test_missing_egl_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(**_: object) -> None:
        raise Exception("libEGL.so.1 not loaded")

    monkeypatch.setattr(render.moderngl, "create_standalone_context", broken)
    with pytest.raises(MissingDependencyError, match="libEGL.so.1 not loaded.*libegl1"):
        render.Renderer(build_cameras(SIZE))


def test_cameras_of_different_size_are_refused() -> None:
    with pytest.raises(ValueError, match="the same image size"):
        render.Renderer([*build_cameras(SIZE)[:1], *build_cameras((640, 360))[1:]])
