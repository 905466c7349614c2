"""A complete small capture, read back with the package's readers and with PyAV and trimesh."""

from pathlib import Path

import av
import numpy as np
import pytest
import trimesh

from jawusd.base.errors import MissingDependencyError, OutputError
from jawusd.cameras.calibration import load_calibration
from jawusd.formats.capture import Capture, load_capture
from jawusd.geometry import LANDMARKS, transform_point, transform_points
from jawusd.synthetic.capture_writer import DemoConfig, write_demo
from jawusd.synthetic.take import LEAD, TAIL

CONFIG = DemoConfig(seed=3, frames=24, size_px=(320, 180), boards=2)
FRAMES = LEAD + CONFIG.frames + TAIL


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    calls = []
    try:
        path = write_demo(folder, CONFIG, lambda done, total: calls.append((done, total)))
    except MissingDependencyError as error:
        pytest.skip(f"no OpenGL without a display here: {error}")
    assert path == folder / "capture.toml"
    assert [done for done, _ in calls] == list(range(1, len(calls) + 1))
    assert {total for _, total in calls} == {len(calls)}
    return folder


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    return load_capture(folder)


@pytest.fixture(scope="module")
def truth(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as arrays:
        return dict(arrays)


def _pictures(path: Path, pixel_format: str) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format=pixel_format) for frame in container.decode(video=0)])


def test_the_description_is_complete(capture: Capture) -> None:
    assert capture.fps == 24.0
    assert capture.frames == (LEAD, LEAD + CONFIG.frames)
    assert [camera.name for camera in capture.cameras] == ["cam0", "cam1", "cam2"]
    assert capture.boards is not None and len(capture.boards.videos) == 3
    assert capture.bootstrap is not None and len(capture.bootstrap.upper) == len(capture.bootstrap.lower) == 4
    assert capture.motion.rest_frame is not None and capture.frames[0] < capture.motion.rest_frame < capture.frames[1]
    assert capture.sync.method == "flash" and capture.reference == "cam0"


def test_scans_are_coloured_meshes_in_occlusion(capture: Capture) -> None:
    scans = capture.scans
    upper, lower = (trimesh.load(path, process=False) for path in (scans.upper_teeth, scans.lower_teeth))
    for scan in (upper, lower):
        assert len(np.unique(scan.visual.vertex_colors[:, :3], axis=0)) == 3
    assert upper.bounds[0, 1] > -0.5 and lower.bounds[1, 1] < 3.5
    for path in (scans.mandible, scans.skull):
        assert len(trimesh.load(path, process=False).faces) > 3000


def test_the_calibration_is_the_true_one(capture: Capture, truth: dict[str, np.ndarray]) -> None:
    for k, camera in enumerate(load_calibration(capture.calibration)):
        assert camera.size_px == CONFIG.size_px
        np.testing.assert_allclose(camera.K, truth["K"][k], atol=1e-9)
        np.testing.assert_allclose(camera.distortion, truth["dist"][k])
        np.testing.assert_allclose(camera.T_cam_world[:3, :3], truth["R"][k], atol=1e-9)
        np.testing.assert_allclose(camera.T_cam_world[:3, 3], truth["t"][k], atol=1e-9)


def test_the_flash_is_seen_at_the_camera_offsets(capture: Capture, truth: dict[str, np.ndarray]) -> None:
    for k, camera in enumerate(capture.cameras):
        pictures = _pictures(camera.video, "gray")
        assert pictures.shape == (FRAMES, *CONFIG.size_px[::-1])
        brightness = pictures.mean((1, 2))
        dark = np.flatnonzero(brightness < 0.6 * np.median(brightness))
        expected = np.concatenate([np.arange(*interval) for interval in truth["flash"] - truth["offsets"][k]])
        np.testing.assert_array_equal(dark, expected)


def test_masks_are_black_outside_the_tracked_frames_and_binary_inside(
    capture: Capture, truth: dict[str, np.ndarray]
) -> None:
    for k, camera in enumerate(capture.cameras):
        for path in (camera.masks.upper, camera.masks.lower):
            masks = _pictures(path, "gray")
            assert len(masks) == FRAMES and set(np.unique(masks)) == {0, 255}
            drawn = np.flatnonzero(masks.any((1, 2)))
            np.testing.assert_array_equal(drawn, truth["frames"] - truth["offsets"][k])


def test_true_poses_put_the_teeth_into_their_masks(capture: Capture, truth: dict[str, np.ndarray]) -> None:
    cameras = load_calibration(capture.calibration)
    for jaw, key in (("upper", "T_world_upper"), ("lower", "T_world_lower")):
        scan = trimesh.load(getattr(capture.scans, f"{jaw}_teeth"), process=False)
        colors = np.asarray(scan.visual.vertex_colors)[:, :3].astype(int)
        teeth = np.asarray(scan.vertices)[np.ptp(colors, axis=1) > 40]
        for k, source in enumerate(capture.cameras):
            masks = _pictures(getattr(source.masks, jaw), "gray")
            for i in (0, 14, 23):
                pixels = np.rint(cameras[k].project(transform_points(truth[key][i], teeth))).astype(int)
                outline = np.zeros(CONFIG.size_px[::-1], bool)
                inside = ((pixels >= 0) & (pixels < CONFIG.size_px)).all(1)
                outline[tuple(pixels[inside].T[::-1])] = True
                # the mask contains only projected teeth, except for the pixels between vertices
                grown = np.zeros_like(outline)
                for dy in range(-3, 4):
                    for dx in range(-3, 4):
                        grown |= np.roll(outline, (dy, dx), (0, 1))
                mask = masks[truth["frames"][i] - truth["offsets"][k]] > 0
                assert mask.sum() > 150
                assert (mask & ~grown).sum() <= 0.01 * mask.sum() + 12


def test_picks_see_their_vertices(capture: Capture, truth: dict[str, np.ndarray]) -> None:
    cameras = {camera.name: camera for camera in load_calibration(capture.calibration)}
    row = int(np.flatnonzero(truth["frames"] == capture.bootstrap.frame)[0])
    for jaw, picks in (("upper", capture.bootstrap.upper), ("lower", capture.bootstrap.lower)):
        vertices = np.asarray(trimesh.load(getattr(capture.scans, f"{jaw}_teeth"), process=False).vertices)
        for pick in picks:
            point = transform_point(truth[f"T_world_{jaw}"][row], vertices[pick.vertex])
            for view in pick.views:
                assert np.abs(cameras[view.camera].project(point) - [view.x, view.y]).max() < 5.0


def test_boards_are_held_for_two_frames(capture: Capture, truth: dict[str, np.ndarray]) -> None:
    for path in capture.boards.videos:
        pictures = _pictures(path, "gray").astype(int)
        assert len(pictures) == 2 * CONFIG.boards == 2 * len(truth["board_T_world"])
        held = np.abs(np.diff(pictures, axis=0)).mean((1, 2))
        assert held[1::2].min() > 3 * held[::2].max()


def test_the_truth_is_consistent(truth: dict[str, np.ndarray]) -> None:
    np.testing.assert_allclose(truth["T_world_upper"] @ truth["T_upper_lower"], truth["T_world_lower"], atol=1e-9)
    assert truth["frames"].tolist() == list(range(LEAD, LEAD + CONFIG.frames))
    assert tuple(truth["landmark_names"]) == LANDMARKS
    assert truth["landmarks"].shape == (5, 3) and truth["controls"].shape == (CONFIG.frames, 3)


def test_bad_configurations_are_named() -> None:
    for wrong, message in (({"frames": 5}, "frames"), ({"size_px": (321, 180)}, "size_px"), ({"boards": 0}, "boards")):
        with pytest.raises(ValueError, match=message):
            DemoConfig(**wrong)


def test_a_folder_that_is_a_file_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    try:
        with pytest.raises(OutputError):
            write_demo(tmp_path / "taken", CONFIG)
    except MissingDependencyError as error:
        pytest.skip(f"no OpenGL without a display here: {error}")
