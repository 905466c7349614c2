"""Overlays of a small capture: the decoded videos must be tinted where OpenCV projects the scans."""

import av
import cv2
import numpy as np
import pytest
import trimesh
from run_jawusd import program

from jawusd.base.errors import CalibrationError, CaptureError, OutputError
from jawusd.cameras.calibration import save_calibration
from jawusd.formats.performance import STATE_COLOURS, SolvedJaw, SolveState
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera, make_transform, relative_pose
from jawusd.media.writers import VideoWriter
from jawusd.pipeline.pictures import TILE_PX, overlay_files, write_overlay
from jawusd.pipeline.workspace import open_capture

SIZE = (240, 180)
K = np.array([[300.0, 0, 120], [0, 300, 90], [0, 0, 1]])
CAMERAS = [
    Camera("left", SIZE, K, np.array([-0.2, 0, 0, 0, 0.0]), make_transform(np.eye(3), [-6, 0, 150.0])),
    Camera("right", SIZE, K, np.zeros(5), make_transform(np.eye(3), [6, 0, 150.0])),
]
FRAMES = np.arange(3, 9)
OFFSETS = {"left": 0, "right": 4}  # the right camera began four frames later: it misses reference frame 3
GREY = 100
SHADES = 10  # brightness step per frame, which identifies each picture


def scan(path, y_mm):
    """Write a painted box of 50 x 10 x 6 mm."""
    box = trimesh.creation.box((50, 10, 6)).subdivide().subdivide()
    box.apply_translation([0, y_mm, 0])
    box.visual.vertex_colors = np.tile([215, 45, 40, 255], (len(box.vertices), 1))
    box.export(path)


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    folder.mkdir()
    scan(folder / "upper.ply", -9)
    scan(folder / "lower.ply", 9)
    save_calibration(folder / "calibration.toml", CAMERAS)
    for camera in CAMERAS:
        with VideoWriter(folder / f"{camera.name}.mp4", SIZE, 25.0) as out:
            for k in range(12):
                out.write(np.full((SIZE[1], SIZE[0], 3), GREY + SHADES * k, np.uint8))
    cameras = "".join(f'[[camera]]\nname = "{c.name}"\nvideo = "{c.name}.mp4"\n' for c in CAMERAS)
    (folder / "capture.toml").write_text(
        'format = "jawusd-capture/1"\nname = "boxes"\nunits = "mm"\nfps = 25.0\ncalibration = "calibration.toml"\n'
        '[scans]\nupper_teeth = "upper.ply"\nlower_teeth = "lower.ply"\n' + cameras
    )
    return folder


def some_tracks() -> Tracks:
    """Move both boxes to the right by 2 mm per frame; the lower one is lost in the last frame."""
    count = len(FRAMES)
    upper = np.stack([make_transform(np.eye(3), [2.0 * k, 0, 0]) for k in range(count)])
    lower = upper.copy()
    lower[-1] = np.nan
    unknown, two, five = (np.full((count, *shape), np.nan) for shape in ((6, 6), (2,), (5,)))
    return Tracks(
        FRAMES, upper, lower, relative_pose(upper, lower), upper, lower, relative_pose(upper, lower),
        np.array([[1, 1]] * (count - 1) + [[1, 0]], np.int8), np.zeros(count, bool), np.full((count, 2, 2), np.nan),
        np.ones((count, 2, 2), bool),
        unknown, unknown, unknown, five, two, two,
        ("left", "right"),
    )  # fmt: skip


def decoded(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264" and float(stream.average_rate) == 25.0
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(stream)])


def pixel(camera: Camera, point) -> tuple[int, int]:
    seen = cv2.projectPoints(
        np.array([point]), cv2.Rodrigues(camera.T_cam_world[:3, :3])[0], camera.T_cam_world[:3, 3], K, camera.distortion
    )[0].ravel()
    return int(round(seen[1])), int(round(seen[0]))


def quiet(stage, done, total):
    """Ignore progress."""


def test_each_camera_gets_a_video_with_the_scans_where_they_are_seen(capture, tmp_path):
    told = []
    opened = open_capture(capture)
    files = write_overlay(opened, OFFSETS, some_tracks(), tmp_path / "new" / "out", lambda *a: told.append(a))
    assert files == [tmp_path / "new" / "out" / name for name in ("left.mp4", "right.mp4", "contact_sheet.png")]
    assert files == overlay_files(opened, tmp_path / "new" / "out") and all(path.is_file() for path in files)
    assert told == [("overlay", k, 12) for k in range(1, 13)]
    for camera, path in zip(CAMERAS, files):
        pictures = decoded(path)
        assert pictures.shape == (len(FRAMES), SIZE[1], SIZE[0], 3)
        for k, frame in enumerate(FRAMES):
            own = frame - OFFSETS[camera.name]
            if own < 0:
                assert np.abs(pictures[k].astype(int) - 60).max() < 8  # gray, nothing drawn
                continue
            footage = GREY + SHADES * own
            assert np.abs(pictures[k, :20].astype(int) - footage).max() < 8
            for y_mm, lost in ((-9, False), (9, frame == FRAMES[-1])):
                # 5 mm inside the right end of the box, and 5 mm beyond its left end.
                inside = pictures[k][pixel(camera, [2.0 * k + 20, y_mm, -3.0])].astype(int)
                beyond = pictures[k][pixel(camera, [2.0 * k - 30, y_mm, -3.0])].astype(int)
                assert np.abs(beyond - footage).max() < 8
                assert (np.ptp(inside) > 20) == (not lost)
                if not lost:
                    warm = inside[0] > inside[2]
                    assert warm == (y_mm < 0)  # the upper arch is orange, the lower one blue
    sheet = cv2.imread(str(files[-1]))
    assert sheet.shape[1] == 2 * 480 and sheet.std() > 10


def test_scans_are_drawn_as_the_corrected_cameras_see_them(capture, tmp_path):
    """The tracks correct the position of the left camera by 8 mm to the side."""
    tracks, moved = some_tracks(), CAMERAS[0].T_cam_world.copy()
    moved[0, 3] += 8.0
    tracks.meta["extrinsics"] = {"T_cam_world": {"left": moved.tolist()}}
    drawn = []
    for name, given in (("plain", some_tracks()), ("corrected", tracks)):
        drawn.append(decoded(write_overlay(open_capture(capture), OFFSETS, given, tmp_path / name, quiet)[0])[0])
    shift = round(8.0 * K[0, 0] / (150.0 - 3.0))
    row = pixel(CAMERAS[0], [0, -9, -3.0])[0]
    warm = [np.flatnonzero(p[row, :, 0].astype(int) - p[row, :, 2] > 20) for p in drawn]
    assert warm[1].min() - warm[0].min() == pytest.approx(shift, abs=2)


def test_odd_sides_lose_a_line(capture, tmp_path):
    """Common H.264 needs even sizes; footage in other formats may have odd ones."""
    size = (SIZE[0] + 1, SIZE[1] + 1)
    with VideoWriter(capture / "left.mkv", size, 25.0, lossless=True) as out:
        for _ in range(12):
            out.write(np.full(size[::-1], 90, np.uint8))
    save_calibration(capture / "calibration.toml", [CAMERAS[0].cropped(0, 0, size), CAMERAS[1]])
    text = (capture / "capture.toml").read_text().replace("left.mp4", "left.mkv")
    (capture / "capture.toml").write_text(text)
    files = write_overlay(open_capture(capture), OFFSETS, some_tracks(), tmp_path / "out", quiet)
    assert decoded(files[0]).shape[1:3] == SIZE[::-1]


def test_what_cannot_be_drawn_is_refused(capture, tmp_path):
    opened = open_capture(capture)
    blind = opened.model_copy(update={"cameras": tuple(c.model_copy(update={"video": None}) for c in opened.cameras)})
    with pytest.raises(CaptureError, match="no camera has a video"):
        write_overlay(blind, OFFSETS, some_tracks(), tmp_path / "out", quiet)
    with pytest.raises(OutputError, match="cannot write here"):
        (tmp_path / "file").write_text("")
        write_overlay(opened, OFFSETS, some_tracks(), tmp_path / "file" / "out", quiet)
    save_calibration(capture / "calibration.toml", [CAMERAS[0].scaled((480, 300)), CAMERAS[1]])
    with pytest.raises(CalibrationError, match="camera left: calibrated for .* the aspect ratios differ"):
        write_overlay(open_capture(capture), OFFSETS, some_tracks(), tmp_path / "out", quiet)
    assert not (tmp_path / "out").exists()


def test_the_command_guards_its_options_and_outputs(capture, tmp_path):
    result = program("track", capture, "-o", tmp_path / "t.npz", "--backend", "gl")
    assert result.returncode == 2 and "--solver paper" in result.stderr
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "right.mp4").write_text("precious")
    result = program("track", capture, "-o", tmp_path / "t.npz", "--overlay", tmp_path / "out")
    assert result.returncode == OutputError.exit_code and "right.mp4" in result.stderr and "--force" in result.stderr
    assert (tmp_path / "out" / "right.mp4").read_text() == "precious"
    result = program("track", capture, "-o", tmp_path / "t.npz", "--solver", "guess")
    assert result.returncode == 2 and "contour" in result.stderr


def solved_tracks() -> Tracks:
    """Return the tracks above as written by a solve: the lower arch is occluded in frame 5 and lost in frame 8."""
    tracks = some_tracks()
    count = len(FRAMES)
    tracks.T_world_lower[-1] = tracks.T_world_upper[-1]
    tracks.status[2, 1] = 0
    state = np.ones(count, np.int8)
    state[2], state[-1] = 2, 0
    tracks.solved = SolvedJaw(np.ones((count, 3)), np.ones((count, 3)), np.ones(count), state, np.ones(count, bool))
    return tracks


def colours_in(image):
    """Return the solve states drawn in a picture."""
    return {
        state
        for state, colour in STATE_COLOURS.items()
        if np.count_nonzero(np.abs(image.astype(int) - colour).max(axis=2) < 60) > 100
    }


def test_one_video_shows_all_cameras_side_by_side_coloured_by_state(capture, tmp_path):
    told = []
    path = tmp_path / "new" / "take.mp4"
    assert write_overlay(open_capture(capture), OFFSETS, solved_tracks(), path, lambda *a: told.append(a)) == [path]
    assert told == [("overlay", k, len(FRAMES)) for k in range(1, len(FRAMES) + 1)]
    pictures = decoded(path)
    width, height = TILE_PX
    assert len(pictures) == len(FRAMES) and pictures.shape[2] == 2 * width
    left, right, bar = pictures[:, :height, :width], pictures[:, 30:height, width:], pictures[:, height + 22 :]
    solved = {SolveState.SOLVED}
    assert [colours_in(image) for image in left] == [
        solved, solved, solved | {SolveState.CARRIED}, solved, solved, solved | {SolveState.LOST}
    ]  # fmt: skip
    assert colours_in(right[0]) == set() and colours_in(right[1]) == solved  # the right camera began one frame later
    assert all((image > 200).any() for image in bar) and np.abs(bar[0].astype(int) - bar[1]).max() > 50


def test_cameras_without_footage_show_their_masks(capture, tmp_path):
    """Masks at OpenCV's projections of the boxes, which the outlines must enclose."""
    opened = open_capture(capture)
    for camera in CAMERAS:
        for arch, y_mm in (("upper", -9.0), ("lower", 9.0)):
            with VideoWriter(capture / f"{camera.name}_{arch}.mkv", SIZE, 25.0, lossless=True) as out:
                for own in range(9):
                    mask = np.zeros(SIZE[::-1], np.uint8)
                    x_mm = 2.0 * (own + OFFSETS[camera.name] - FRAMES[0])
                    row, low = pixel(camera, [x_mm - 15, y_mm, -3.0])
                    mask[row - 2 : row + 3, low : pixel(camera, [x_mm + 15, y_mm, -3.0])[1]] = 255
                    out.write(mask)
    text = (capture / "capture.toml").read_text()
    for camera in CAMERAS:
        named = f'masks.upper = "{camera.name}_upper.mkv"\nmasks.lower = "{camera.name}_lower.mkv"\n'
        text = text.replace(f'video = "{camera.name}.mp4"\n', named)
    (capture / "capture.toml").write_text(text)
    opened = open_capture(capture)
    assert all(camera.video is None for camera in opened.cameras)
    write_overlay(opened, OFFSETS, solved_tracks(), tmp_path / "take.mp4", quiet)
    for picture in decoded(tmp_path / "take.mp4")[:2]:
        tile = picture[: TILE_PX[1], : TILE_PX[0]].astype(int)
        gray = (np.ptp(tile, axis=2) < 60) & (tile.mean(axis=2) > 85)
        assert colours_in(tile) == {SolveState.SOLVED} and np.count_nonzero(gray[30:]) > 2000
    blind = opened.model_copy(update={"cameras": tuple(c.model_copy(update={"masks": None}) for c in opened.cameras)})
    with pytest.raises(CaptureError, match="no camera has a video or masks"):
        write_overlay(blind, OFFSETS, solved_tracks(), tmp_path / "none.mp4", quiet)
