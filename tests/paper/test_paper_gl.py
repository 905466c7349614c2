"""Pixel counts: CPU against numpy on unpacked images, OpenGL against CPU, and errors without OpenGL."""

import importlib
import sys

import numpy as np
import pytest

from jawusd.base.errors import MissingDependencyError
from jawusd.geometry import make_transform, se3_exp
from jawusd.meshes import raster
from jawusd.paper.energy import PaperScan, RasterCounter

moderngl = pytest.importorskip("moderngl", reason="moderngl is not installed")
gl = importlib.import_module("jawusd.paper.gl")

SIZE = (200, 130)
VIEWS = 3
EDGE_TIES_PX = 4  # pixels whose centre lies on an edge to rounding, out of about 6000


def torus(rings: int = 60, sides: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Make a closed mesh with outward winding, about 40 mm across."""
    i, j = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    a, b = i * 2 * np.pi / rings, j * 2 * np.pi / sides
    r = 15 + 5 * np.cos(b)
    vertices = np.stack([r * np.cos(a), r * np.sin(a), 5 * np.sin(b)], -1).reshape(-1, 3)
    at = lambda i, j: (i % rings) * sides + j % sides  # noqa: E731
    quads = np.stack([at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)], -1).reshape(-1, 4)
    return vertices, np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


VERTICES, FACES = torus()
IS_BOUNDARY = VERTICES[FACES[:, 0], 1] > 8
PLAIN, BOUNDARY = FACES[~IS_BOUNDARY], FACES[IS_BOUNDARY]


def scan(plain: np.ndarray = PLAIN, boundary: np.ndarray = BOUNDARY, *, cull: bool = False) -> PaperScan:
    return PaperScan(VERTICES, plain, boundary, cull, np.zeros(3))


def matrices() -> np.ndarray:
    """Make three views of the origin, 200 mm away, y down."""
    K = np.array([[700.0, 0, 99.3], [0, 720.0, 64.8], [0, 0, 1]])
    turns = [
        make_transform(np.diag([1.0, -1, -1]), [0, 0, 200.0]) @ se3_exp([0, yaw, 0, 0, 0, 0]) for yaw in (0, 0.6, -0.7)
    ]
    return np.stack([K @ T[:3] for T in turns])


def some_poses(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([se3_exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 3, 3, 3]) for _ in range(count)])


def drawn(faces: np.ndarray, matrix: np.ndarray, pose: np.ndarray) -> np.ndarray:
    points = np.empty((len(VERTICES), 3), np.float32)
    raster.project(VERTICES.astype(np.float32), (matrix @ pose).astype(np.float32), points)
    bits = np.zeros((SIZE[1], raster.words_for(SIZE[0])), np.uint64)
    raster.draw_silhouette(points, np.ascontiguousarray(faces), 0, 0, SIZE[0], False, bits)
    return raster.unpack_bits(bits, SIZE[0])


def screens() -> tuple[np.ndarray, np.ndarray]:
    """Return matrices, and masks drawn at another pose, with an area in which there is no boundary outside."""
    P = matrices()
    masks = np.stack([drawn(FACES, m, some_poses(1, seed=9)[0]) for m in P])
    masks[:, :50, :90] = True
    return P, masks


@pytest.fixture(scope="module")
def context():
    try:
        opened = gl.open_context()
    except MissingDependencyError as error:
        pytest.skip(f"no OpenGL here: {error}")
    yield opened
    opened.release()


def test_the_cpu_counts_what_numpy_counts() -> None:
    P, masks = screens()
    poses = some_poses(5)
    counter = RasterCounter(scan())
    counter.show(P, masks)
    found = counter.counts(poses)
    assert found.shape == (5, VIEWS, 2)
    for n, pose in enumerate(poses):
        for c, m in enumerate(P):
            assert found[n, c, 0] == np.count_nonzero(masks[c] & ~drawn(FACES, m, pose))
            assert found[n, c, 1] == np.count_nonzero(drawn(BOUNDARY, m, pose) & ~masks[c])
    assert (found > 0).any(axis=(0, 1)).all()


@pytest.mark.parametrize("options", [{"threads": 2}, {"threads": 3, "cull": True}, {"cull": True}])
def test_threads_and_culling_leave_the_silhouette_of_a_solid_alone(options) -> None:
    P, masks = screens()
    poses = some_poses(7)
    results = []
    for chosen in ({}, options):
        counter = RasterCounter(scan(cull=chosen.get("cull", False)), chosen.get("threads", 1))
        counter.show(P, masks)
        results.append(counter.counts(poses))
    np.testing.assert_array_equal(results[0][..., 0], results[1][..., 0])
    if "cull" not in options:  # the far side of the boundary may lie outside the mask
        np.testing.assert_array_equal(results[0], results[1])
    assert (results[1] <= results[0]).all()


@pytest.mark.parametrize("cull", [False, True])
def test_opengl_agrees_with_the_cpu(context, cull) -> None:
    P, masks = screens()
    poses = some_poses(20)
    cpu = RasterCounter(scan(cull=cull))
    cpu.show(P, masks)
    expected = cpu.counts(poses)
    counter = gl.GlCounter(context, scan(cull=cull))
    counter.show(P, masks)
    found = counter.counts(poses)
    assert np.abs(found - expected).max() <= EDGE_TIES_PX
    assert expected.max() > 100 * EDGE_TIES_PX
    assert context.error is not None  # clears it: making a framebuffer, moderngl binds the one released before
    # Counts are the same for single poses and batches.
    np.testing.assert_array_equal(np.concatenate([counter.counts(pose[None]) for pose in poses]), found)
    assert context.error == "GL_NO_ERROR"


def test_opengl_splits_what_is_too_much_for_one_drawing(context, monkeypatch) -> None:
    P, masks = screens()
    poses = some_poses(9)
    counter = gl.GlCounter(context, scan())
    counter.show(P, masks)
    whole = counter.counts(poses)
    monkeypatch.setattr(gl, "_MOST_PIXELS", 256 * 192 * 2 * VIEWS)  # two poses at a time
    np.testing.assert_array_equal(counter.counts(poses), whole)
    monkeypatch.setattr(gl, "_MOST_PIXELS", 256 * 192)
    with pytest.raises(ValueError, match="exceed the maximum size of a texture"):
        counter.show(P, masks)


def test_counters_share_a_context_and_take_pictures_of_changing_size(context) -> None:
    P, masks = screens()
    pose = some_poses(1)
    first = gl.GlCounter(context, scan())
    second = gl.GlCounter(context, scan(FACES, np.empty((0, 3), np.int32)))
    cpu = RasterCounter(scan())
    for views, width, height in ((3, 200, 130), (2, 70, 60), (1, 130, 129), (3, 200, 130)):
        part = (P[:views], masks[:views, :height, :width])
        for counter in (first, second, cpu):
            counter.show(*part)
        expected = cpu.counts(pose)
        assert np.abs(first.counts(pose) - expected).max() <= EDGE_TIES_PX
        assert np.abs(second.counts(pose)[..., 0] - expected[..., 0]).max() <= EDGE_TIES_PX
        assert not second.counts(pose)[..., 1].any()


@pytest.mark.parametrize("change", ["matrices", "masks", "empty"])
def test_wrong_shapes_are_refused(change) -> None:
    P, masks = screens()
    if change == "matrices":
        P = P[:2]
    elif change == "masks":
        masks = masks[0]
    else:
        masks = masks[:, :0]
    with pytest.raises(ValueError, match="masks must be"):
        RasterCounter(scan()).show(P, masks)


def test_no_driver_is_one_clear_error(monkeypatch) -> None:
    def broken(**_):
        raise Exception("libEGL.so.1 not loaded")

    monkeypatch.setattr(moderngl, "create_standalone_context", broken)
    with pytest.raises(MissingDependencyError, match=r"libEGL\.so\.1 not loaded.*apt-get install libegl1.*CPU backend"):
        gl.open_context()


def test_a_driver_without_layers_is_refused(monkeypatch) -> None:
    class Old:
        extensions = frozenset({"GL_ARB_compute_shader"})
        info = {"GL_RENDERER": "Old Card"}
        released = False

        def release(self):
            self.released = True

    old = Old()
    monkeypatch.setattr(moderngl, "create_standalone_context", lambda **_: old)
    with pytest.raises(MissingDependencyError, match='"Old Card" lacks GL_ARB_shader_viewport_layer_array'):
        gl.open_context()
    assert old.released


def test_without_moderngl_the_error_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "moderngl", None)
    monkeypatch.delitem(sys.modules, "jawusd.paper.gl")
    with pytest.raises(MissingDependencyError, match=r"moderngl.*pip install 'jawusd\[all\]'"):
        importlib.import_module("jawusd.paper.gl")
