"""The rasteriser against brute force, analytic planes and OpenCV's projection."""

import threading

import cv2
import numpy as np
import pytest

from jawusd.meshes import raster

SIZE = (150, 90)


def torus(rings: int = 36, sides: int = 18) -> tuple[np.ndarray, np.ndarray]:
    """Make a closed, non-convex mesh with outward winding, about 40 mm across."""
    a = np.arange(rings) * 2 * np.pi / rings
    b = np.arange(sides) * 2 * np.pi / sides
    aa, bb = np.meshgrid(a, b, indexing="ij")
    r = 15 + 5 * np.cos(bb)
    vertices = np.stack([r * np.cos(aa), r * np.sin(aa), 5 * np.sin(bb)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    at = lambda i, j: (i % rings) * sides + j % sides  # noqa: E731
    quads = np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)], -1).reshape(-1, 4)
    return vertices, np.ascontiguousarray(np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def matrix_at(rng: np.random.Generator, depth_mm: float = 200.0, focal_px: float = 500.0) -> np.ndarray:
    """Make a random view of the mesh: K [R | t]."""
    rotation = cv2.Rodrigues(rng.normal(size=3))[0]
    translation = np.array([rng.normal() * 3, rng.normal() * 3, depth_mm])
    K = np.array([[focal_px, 0, SIZE[0] / 2 + 0.3], [0, focal_px * 1.1, SIZE[1] / 2 - 0.2], [0, 0, 1]])
    return K @ np.c_[rotation, translation]


def brute_force(uv: np.ndarray, faces: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Test every pixel centre against every triangle in float64 with half-planes; borders count as inside."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    covered = np.zeros((size[1], size[0]), bool)
    for a, b, c in uv[faces]:
        side = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        covered |= (np.min(side, 0) >= 0) | (np.max(side, 0) <= 0)
    return covered


def exact_uv(vertices: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    h = vertices @ matrix[:, :3].T + matrix[:, 3]
    return h[:, :2] / h[:, 2:]


def projected(vertices: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    points = np.empty((len(vertices), 3), np.float32)
    raster.project(vertices.astype(np.float32), matrix.astype(np.float32), points)
    return points


def silhouette(
    vertices: np.ndarray, faces: np.ndarray, matrix: np.ndarray, size: tuple[int, int], cull: bool = False
) -> np.ndarray:
    bits = np.zeros((size[1], raster.words_for(size[0])), np.uint64)
    raster.draw_silhouette(projected(vertices, matrix), faces.astype(np.int32), 0, 0, size[0], cull, bits)
    return raster.unpack_bits(bits, size[0])


def draw_depth(points: np.ndarray, faces: np.ndarray, x0: int, y0: int, cull: bool, buffer: np.ndarray) -> None:
    raster.draw_depth_labels(points, faces, x0, y0, cull, buffer, np.zeros((0, 0), np.uint8), 0)


def inverse_depth(
    vertices: np.ndarray, faces: np.ndarray, matrix: np.ndarray, size: tuple[int, int], cull: bool = False
) -> np.ndarray:
    buffer = np.zeros(size[::-1], np.float32)
    draw_depth(projected(vertices, matrix), faces.astype(np.int32), 0, 0, cull, buffer)
    return buffer


def test_project_agrees_with_opencv() -> None:
    rng = np.random.default_rng(1)
    vertices, _ = torus()
    rvec, tvec = rng.normal(size=3), np.array([2.0, -3.0, 210.0])
    K = np.array([[2400.0, 0, 481.3], [0, 2390.0, 268.9], [0, 0, 1]])
    expected = cv2.projectPoints(vertices, rvec, tvec, K, None)[0][:, 0]
    rotation = cv2.Rodrigues(rvec)[0]
    points = np.empty((len(vertices), 3), np.float32)
    raster.project(vertices.astype(np.float32), (K @ np.c_[rotation, tvec]).astype(np.float32), points)
    assert np.abs(points[:, :2] - expected).max() < 2e-3
    assert np.allclose(points[:, 2], (vertices @ rotation.T + tvec)[:, 2], rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_silhouette_agrees_with_brute_force(seed: int) -> None:
    vertices, faces = torus()
    matrix = matrix_at(np.random.default_rng(seed))
    expected = brute_force(exact_uv(vertices, matrix), faces, SIZE)
    assert 2000 < expected.sum() < 9000
    found = silhouette(vertices, faces, matrix, SIZE)
    assert (found != expected).sum() <= 2  # float32 ties on the outline
    # A closed mesh with outward winding covers the same pixels without its far side.
    assert (silhouette(vertices, faces, matrix, SIZE, cull=True) != expected).sum() <= 2


def test_culling_removes_the_faces_turned_away() -> None:
    vertices = np.array([[-10.0, -10, 0], [10, -10, 0], [0, 10, 0]])
    matrix = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]) @ np.c_[np.eye(3), [0, 0, 50]]
    # Seen from -z with y down, (0, 1, 2) has positive signed area: its normal (+z) points away from the camera.
    away, towards = np.array([[0, 1, 2]]), np.array([[0, 2, 1]])
    assert not silhouette(vertices, away, matrix, (100, 80), cull=True).any()
    assert silhouette(vertices, towards, matrix, (100, 80), cull=True).any()
    assert silhouette(vertices, away, matrix, (100, 80)).any()
    assert not inverse_depth(vertices, away, matrix, (100, 80), cull=True).any()


def test_border_rule_covers_centres_on_edges() -> None:
    # Corners at pixel centres: the closed square 2..6 x 3..5 and nothing else, from two triangles sharing a diagonal.
    points = np.array([[2, 3, 10], [6, 3, 10], [6, 5, 10], [2, 5, 10]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    bits = np.zeros((9, 1), np.uint64)
    raster.draw_silhouette(points, faces, 0, 0, 12, False, bits)
    expected = np.zeros((9, 12), bool)
    expected[3:6, 2:7] = True
    assert np.array_equal(raster.unpack_bits(bits, 12), expected)
    assert raster.count_bits(bits) == 15


def test_shared_edges_leave_no_cracks() -> None:
    rng = np.random.default_rng(7)
    grid = np.stack(np.meshgrid(np.linspace(-5, 155, 23), np.linspace(-5, 95, 17)), -1)
    grid += rng.uniform(-2, 2, grid.shape)
    points = np.concatenate([grid.reshape(-1, 2), np.full((grid[..., 0].size, 1), 50)], 1).astype(np.float32)
    i, j = np.meshgrid(np.arange(16), np.arange(22), indexing="ij")
    k = (i * 23 + j).ravel()
    faces = np.concatenate([np.c_[k, k + 1, k + 24], np.c_[k, k + 24, k + 23]]).astype(np.int32)
    bits = np.zeros((80, 3), np.uint64)
    raster.draw_silhouette(points, faces, 0, 0, 140, False, bits)
    assert raster.unpack_bits(bits, 140).all()
    assert raster.count_bits(bits) == 80 * 140  # nothing beyond the width


def test_region_equals_the_part_of_the_whole_picture() -> None:
    vertices, faces = torus()
    matrix = matrix_at(np.random.default_rng(3))
    whole = silhouette(vertices, faces, matrix, SIZE)
    depth = inverse_depth(vertices, faces, matrix, SIZE)
    points = np.empty((len(vertices), 3), np.float32)
    raster.project(vertices.astype(np.float32), matrix.astype(np.float32), points)
    x0, y0, w, h = 37, 21, 71, 40
    bits = np.zeros((h, raster.words_for(w)), np.uint64)
    raster.draw_silhouette(points, faces.astype(np.int32), x0, y0, w, False, bits)
    assert np.array_equal(raster.unpack_bits(bits, w), whole[y0 : y0 + h, x0 : x0 + w])
    part = np.zeros((h, w), np.float32)
    draw_depth(points, faces.astype(np.int32), x0, y0, False, part)
    assert np.array_equal(part, depth[y0 : y0 + h, x0 : x0 + w])
    assert np.array_equal(depth > 0, whole)


def test_depth_of_a_slanted_plane_is_exact() -> None:
    # n . X = d, seen through the ray of each pixel: z = d / (n . ray).
    n, d = np.array([0.2, -0.3, 1.0]), 180.0
    K = np.array([[400.0, 0, 70], [0, 420, 44], [0, 0, 1]])
    corners = np.array([[-60.0, -45, 0], [60, -45, 0], [60, 45, 0], [-60, 45, 0]])
    corners[:, 2] = d - corners[:, :2] @ n[:2]
    buffer = inverse_depth(corners, np.array([[0, 1, 2], [0, 2, 3]]), K @ np.eye(3, 4), SIZE)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([(x - 70) / 400, (y - 44) / 420, np.ones(x.shape)], -1)
    expected = rays @ n / d
    assert (buffer > 0).all()
    assert np.abs(buffer / expected - 1).max() < 1e-6


def test_nearest_surface_and_its_label_win_in_any_order() -> None:
    plane = np.array([[-90.0, -60, 0], [90, -60, 0], [90, 60, 0], [-90, 60, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    K = np.array([[400.0, 0, 70], [0, 420, 44], [0, 0, 1]])
    near = plane + [0, 0, 200]
    near[:, 2] += 0.5 * plane[:, 0]  # tilted: nearer than 200 mm on the left only
    far = plane + [0, 0, 200]
    results = []
    for order in ((1, 2), (2, 1)):
        depth, labels = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.uint8)
        for label in order:
            points = np.empty((4, 3), np.float32)
            raster.project((near if label == 1 else far).astype(np.float32), (K @ np.eye(3, 4)).astype("f4"), points)
            raster.draw_depth_labels(points, faces, 0, 0, False, depth, labels, label)
        results.append(labels)
    assert (results[0][:, :69] == 1).all() and (results[0][:, 72:] == 2).all()
    assert np.array_equal(np.delete(results[0], 70, 1), np.delete(results[1], 70, 1))  # column 70: the tie


def test_slivers_cannot_put_depth_spikes() -> None:
    rng = np.random.default_rng(11)
    a = rng.uniform([0, 0, 100], [149, 89, 300], (400, 3))
    b = rng.uniform([0, 0, 100], [149, 89, 300], (400, 3))
    c = (a + b) / 2 + rng.normal(size=(400, 3)) * 1e-4
    points = np.concatenate([a, b, c]).astype(np.float32)
    faces = np.arange(1200, dtype=np.int32).reshape(3, 400).T.copy()
    buffer = np.zeros(SIZE[::-1], np.float32)
    draw_depth(points, faces, 0, 0, False, buffer)
    assert (buffer > 0).any()
    assert buffer.max() <= 1 / 100 and buffer[buffer > 0].min() >= np.float32(1 / 300.1)


def test_broken_and_behind_camera_triangles_are_left_out() -> None:
    points = np.array(
        [[10, 10, 50], [60, 10, 50], [30, 60, -1], [np.nan, 5, 50], [1e30, 20, 50], [-1e30, 70, 50], [30, 60, 50]],
        np.float32,
    )
    bits = np.zeros((90, 3), np.uint64)
    for face in ([0, 1, 2], [0, 1, 3]):
        raster.draw_silhouette(points, np.array([face], np.int32), 0, 0, 150, False, bits)
    assert raster.count_bits(bits) == 0
    raster.draw_silhouette(points, np.array([[0, 4, 5]], np.int32), 0, 0, 150, False, bits)  # huge, but clipped
    assert not raster.unpack_bits(bits, 192)[:, 150:].any()
    assert raster.count_bits(bits) > 0


def test_packing_round_trip_and_counts() -> None:
    rng = np.random.default_rng(5)
    for width in (1, 63, 64, 65, 150):
        first, second = rng.random((2, 11, width)) < 0.4
        a, b = raster.pack_bits(first), raster.pack_bits(second.astype(np.uint8) * 255)
        assert a.shape == (11, raster.words_for(width)) and a.dtype == np.uint64
        assert np.array_equal(raster.unpack_bits(a, width), first)
        assert raster.count_bits(a) == first.sum()
        assert raster.count_and_not(a, b) == (first & ~second).sum()


def test_wrong_buffers_are_refused() -> None:
    points, faces = np.zeros((3, 3), np.float32), np.zeros((1, 3), np.int32)
    with pytest.raises(ValueError, match="width"):
        raster.draw_silhouette(points, faces, 0, 0, 65, False, np.zeros((4, 1), np.uint64))
    with pytest.raises(ValueError, match="labels"):
        raster.draw_depth_labels(points, faces, 0, 0, False, np.zeros((4, 4), "f4"), np.zeros((3, 4), "u1"), 1)
    with pytest.raises(ValueError, match="shape"):
        raster.count_and_not(np.zeros((4, 1), np.uint64), np.zeros((4, 2), np.uint64))
    with pytest.raises(TypeError):
        raster.draw_silhouette(points.astype(float), faces, 0, 0, 64, False, np.zeros((4, 1), np.uint64))
    with pytest.raises(ValueError, match="h, w"):
        raster.pack_bits(np.zeros(4))
    with pytest.raises(ValueError, match="bits"):
        raster.unpack_bits(np.zeros((4, 1), np.uint64), 65)


def test_threads_give_the_same_picture() -> None:
    vertices, faces = torus()
    matrices = [matrix_at(np.random.default_rng(seed)) for seed in range(8)]
    alone = [silhouette(vertices, faces, m, SIZE) for m in matrices]
    together: list = [None] * 8

    def work(k: int) -> None:
        for _ in range(20):
            together[k] = silhouette(vertices, faces, matrices[k], SIZE)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(a, b) for a, b in zip(alone, together, strict=True))
