"""Board detection in synthetic pictures with known corners."""

from fractions import Fraction
from functools import partial

import av
import cv2
import numpy as np
import pytest
from boards import board, charuco, chessboard, corner_grid, opencv_pixels, photograph, poses, studio

from jawusd.base.errors import CalibrationError, CaptureError
from jawusd.capture.board_detection import edge_width_px
from jawusd.capture.boards import find_boards
from jawusd.formats.capture import Boards
from jawusd.media.writers import VideoWriter

CAMERAS = studio(lens=(0.0, 0.0))[:2]
NAMES = ("c0", "c1")
RNG = np.random.default_rng(0)
POSES = poses(6, RNG, tilt=0.3)


def pictures(boards, draw=chessboard, T_world_board=POSES):
    """Return the pictures of every camera."""
    texture, to_texture = draw(boards)
    return [[photograph(camera, T, texture, to_texture) for T in T_world_board] for camera in CAMERAS]


def write_clips(folder, images):
    """Write each picture twice, as a pose held for two frames."""
    paths = []
    for c, camera in enumerate(images):
        path = folder / f"c{c}.mp4"
        with VideoWriter(path, camera[0].shape[::-1], 24.0, quality_crf=10) as writer:
            for image in camera:
                writer.write(image)
                writer.write(image)
        paths.append(path)
    return tuple(paths)


def write_pictures(folder, images):
    """Write numbered PNG files."""
    for c, camera in enumerate(images):
        (folder / f"c{c}").mkdir()
        for k, image in enumerate(camera):
            cv2.imwrite(str(folder / f"c{c}" / f"board_{3 * k:04d}.png"), image)
    return tuple(folder / f"c{c}" / "board_%04d.png" for c in range(len(images)))


def quiet(done, total):
    """Ignore progress."""


def test_chessboard_corners_in_video_are_those_projected(tmp_path):
    boards = board(videos=write_clips(tmp_path, pictures(board())))
    told = []
    found = find_boards(NAMES, boards, lambda done, total: told.append((done, total)))
    assert told[0] == (0, 12) and told[-1] == (12, 12)
    assert found.corners_px.shape == (2, 6, 54, 2) and found.sizes_px == ((640, 480),) * 2 and found.notes == ()
    grid = corner_grid(boards)
    for c, camera in enumerate(CAMERAS):
        for v, T in enumerate(POSES):
            exact = opencv_pixels(camera, grid @ T[:3, :3].T + T[:3, 3])
            miss = min(np.abs(found.corners_px[c, v] - order).max() for order in (exact, exact[::-1]))
            assert miss < 0.25


@pytest.mark.parametrize("scale", [1.5, 0.3])
def test_large_pictures_are_searched_at_half_their_size_unless_a_board_is_too_small_there(tmp_path, scale):
    """The smaller board has squares of 7 px, too small at half resolution."""
    wide, images = (960, 1280), []
    for camera in pictures(board()):
        images.append([])
        for picture in camera:
            drawn = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            images[-1].append(np.full(wide, np.median(picture), np.uint8))
            images[-1][-1][: len(drawn), : drawn.shape[1]] = drawn
    found = find_boards(NAMES, board(videos=write_pictures(tmp_path, images)), quiet)
    grid, missed = corner_grid(board()), []
    for c, camera in enumerate(CAMERAS):
        for v, number in enumerate(found.numbers.tolist()):
            T = POSES[number // 3]
            exact = (opencv_pixels(camera, grid @ T[:3, :3].T + T[:3, 3]) + 0.5) * scale - 0.5
            missed.append(min(np.abs(found.corners_px[c, v] - order).max() for order in (exact, exact[::-1])))
    assert np.isfinite(missed).sum() >= 6 and np.nanmax(missed) < 0.25 * max(scale, 1.0)


def test_charuco_in_numbered_pictures_keeps_the_numbers_of_its_corners(tmp_path):
    about = {"pattern": "charuco", "dictionary": "DICT_4X4_50", "marker_mm": 6.5, "cols": 7, "rows": 5, "square_mm": 9}
    boards = board(**about)
    images = pictures(boards, charuco)
    images[0][2][:, :330] = 110  # half of the board is hidden
    boards = board(**about, videos=write_pictures(tmp_path, images))
    found = find_boards(NAMES, boards, quiet)
    assert found.numbers.tolist() == [0, 3, 6, 9, 12, 15]
    hidden = np.isnan(found.corners_px[0, 2, :, 0])
    assert 5 < hidden.sum() < 30 and np.isfinite(found.corners_px[1, 2]).all()
    grid = corner_grid(boards)
    for c, camera in enumerate(CAMERAS):
        for v, T in enumerate(POSES):
            exact = opencv_pixels(camera, grid @ T[:3, :3].T + T[:3, 3])
            assert np.nanmax(np.abs(found.corners_px[c, v] - exact)) < 0.5


@pytest.mark.parametrize("legacy", [True, False])
@pytest.mark.parametrize(("cols", "rows"), [(7, 5), (6, 5), (4, 7), (6, 4), (7, 6)])
def test_charuco_boards_of_before_opencv_4_6_are_found(tmp_path, cols, rows, legacy):
    """Older OpenCV drew boards with an even number of rows, (7, 5), (6, 5) and (4, 7), differently."""
    about = {"pattern": "charuco", "dictionary": "DICT_4X4_50", "marker_mm": 6.5, "square_mm": 9.0}
    about |= {"cols": cols, "rows": rows}
    images = pictures(board(**about), partial(charuco, legacy=legacy), T_world_board=POSES[:3])
    images[1][1][:] = 110  # a picture without a board
    boards = board(**about, videos=write_pictures(tmp_path, images))
    found = find_boards(NAMES, boards, quiet)
    assert found.missed == {"c0": [], "c1": [3]}
    grid = corner_grid(boards)
    for c, camera in enumerate(CAMERAS):
        for v, T in enumerate(POSES[:3]):
            if (c, v) != (1, 1):
                exact = opencv_pixels(camera, grid @ T[:3, :3].T + T[:3, 3])
                assert np.abs(found.corners_px[c, v] - exact).max() < 0.5


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0])
def test_the_width_of_edges_is_that_of_the_blur(sigma):
    boards = board(square_mm=8.0)
    texture, to_texture = chessboard(boards)
    T = np.eye(4)
    T[2, 3] = 200
    image = cv2.GaussianBlur(photograph(CAMERAS[0], T, texture, to_texture), (0, 0), sigma)
    corners = opencv_pixels(CAMERAS[0], corner_grid(boards) + [0, 0, 200])
    # Rasterisation and differencing add half a pixel in quadrature; blur hides some edges at crossings.
    assert 0.95 < edge_width_px(image, corners, 9) / (2.563 * np.hypot(sigma, 0.5)) < 1.25


def test_blurred_pictures_are_refused_and_named(tmp_path):
    images = pictures(board())
    images[1][2] = cv2.GaussianBlur(images[1][2], (0, 0), 4.0)
    found = find_boards(NAMES, board(videos=write_pictures(tmp_path, images)), quiet)
    assert 6 in found.blurred["c1"] + found.missed["c1"] and found.blurred["c0"] == []
    assert np.isnan(found.corners_px[1, 2]).all() and np.isfinite(found.corners_px[0, 2]).all()


def test_the_sharper_of_two_frames_is_taken(tmp_path):
    images = pictures(board(), T_world_board=POSES[:3])
    path = tmp_path / "c0.mp4"
    with VideoWriter(path, (640, 480), 24.0, quality_crf=10) as writer:
        for image in images[0]:
            writer.write(cv2.blur(image, (9, 1)))
            writer.write(image)
    found = find_boards(("c0",), board(videos=(path,)), quiet)
    assert found.numbers.tolist() == [1, 3, 5]


@pytest.mark.parametrize(("cols", "rows"), [(8, 6), (9, 7), (10, 7), (5, 4)])
def test_a_wrong_corner_count_is_named_with_the_right_one(tmp_path, cols, rows):
    videos = write_pictures(tmp_path, pictures(board(), T_world_board=POSES[:3]))
    with pytest.raises(
        CalibrationError, match=rf"c0: the board has 9 x 6 inner corners, but \[boards\] describes {cols} x {rows}"
    ):
        find_boards(NAMES, board(cols=cols, rows=rows, videos=videos), quiet)


ABOUT_CHARUCO = {"pattern": "charuco", "dictionary": "DICT_4X4_50", "marker_mm": 6.5, "square_mm": 9.0}


@pytest.mark.parametrize(("cols", "rows", "last"), [(8, 5, 26), (6, 5, 20), (9, 5, 29), (7, 4, 19)])
def test_a_charuco_board_of_another_size_is_told_by_its_markers(tmp_path, cols, rows, last):
    shown = board(**ABOUT_CHARUCO, cols=7, rows=5)
    videos = write_pictures(tmp_path, pictures(shown, charuco, T_world_board=POSES[:3]))
    message = rf"c0: the board has markers 0 to 23, but a board of {cols} x {rows} inner corners has 0 to {last}\."
    with pytest.raises(CalibrationError, match=message):
        find_boards(NAMES, board(**ABOUT_CHARUCO, cols=cols, rows=rows, videos=videos), quiet)
    assert len(find_boards(NAMES, board(**ABOUT_CHARUCO, cols=7, rows=5, videos=videos), quiet).numbers) == 3


def test_a_chessboard_named_charuco_is_told(tmp_path):
    videos = write_pictures(tmp_path, pictures(board(), T_world_board=POSES[:3]))
    with pytest.raises(CalibrationError, match="show a chessboard of 9 x 6 inner corners without markers of"):
        find_boards(NAMES, board(**ABOUT_CHARUCO, cols=9, rows=6, videos=videos), quiet)


@pytest.mark.parametrize("sigma", [4.0, 9.0])
def test_boards_that_are_blurred_throughout_are_refused(tmp_path, sigma):
    images = pictures(board(), T_world_board=POSES[:3])
    images[1] = [cv2.GaussianBlur(image, (0, 0), sigma) for image in images[1]]
    message = (
        r"c1: all \d images of the board are blurred: its edges are \d+\.\d px wide .* limit is 8\.0 px.*in focus"
        if sigma == 4.0
        else "c1: no chessboard with 9 x 6 inner corners was found in any of 3 images.*sharp"
    )
    with pytest.raises(CalibrationError, match=message):
        find_boards(NAMES, board(videos=write_pictures(tmp_path, images)), quiet)


def test_pictures_without_a_board_are_refused(tmp_path):
    rng = np.random.default_rng(1)
    images = [[rng.integers(80, 120, (480, 640)).astype(np.uint8) for _ in range(2)] for _ in CAMERAS]
    videos = write_pictures(tmp_path, images)
    with pytest.raises(CalibrationError, match="c0: no chessboard with 9 x 6 inner corners was found in any of 2"):
        find_boards(NAMES, board(videos=videos), quiet)
    about = {"pattern": "charuco", "dictionary": "DICT_4X4_50", "marker_mm": 3.0}
    with pytest.raises(CalibrationError, match="no charuco of DICT_4X4_50"):
        find_boards(NAMES, board(**about, videos=videos), quiet)
    with pytest.raises(CalibrationError, match="of 11 x 9 inner corners has 60 markers; DICT_4X4_50 has only 50"):
        find_boards(NAMES, board(**about, cols=11, rows=9, videos=videos), quiet)


def test_a_clip_cut_short_is_used_and_said(tmp_path):
    images = pictures(board())
    images[1] = images[1][:4]
    found = find_boards(NAMES, board(videos=write_clips(tmp_path, images)), quiet)
    assert len(found.numbers) == 4
    assert "different numbers of images (c0 12, c1 8)" in found.notes[0]


def write_woven(folder, images, order):
    """Write interlaced pictures, with the next pose in odd rows."""
    paths = []
    for c, camera in enumerate(images):
        path = folder / f"c{c}.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=25, options={"crf": "10", "x264-params": f"{order}=1"})
            stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
            for image, later in zip(camera, [*camera[1:], camera[-1]]):
                picture = image.copy()
                picture[1::2] = later[1::2]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray")))
            container.mux(stream.encode(None))
        paths.append(path)
    return tuple(paths)


@pytest.mark.parametrize("order", ["tff", "bff"])
def test_the_board_is_not_blamed_for_woven_pictures(tmp_path, order):
    videos = write_woven(tmp_path, pictures(board()), order)
    with pytest.raises(CalibrationError, match=r"marked as interlaced: each combines two fields") as error:
        find_boards(NAMES, board(videos=videos), quiet)
    assert "boards" not in str(error.value) and "bwdif" in error.value.hint


def test_boards_held_still_in_interlaced_clips_are_used_and_named(tmp_path):
    still = [[camera[0]] * 6 for camera in pictures(board(), T_world_board=POSES[:1])]
    found = find_boards(NAMES, board(videos=write_woven(tmp_path, still, "tff")), quiet)
    assert len(found.notes) == 2 and all("combines two fields" in note for note in found.notes)


def test_clips_of_variable_rate_are_matched_by_time(tmp_path):
    images = pictures(board())
    paths = []
    for c, dropped in enumerate(((), (2, 3))):  # the second camera lost a pose
        path = tmp_path / f"c{c}.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=1000)
            stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
            stream.codec_context.time_base = Fraction(1, 1000)
            stream.options = {"crf": "10"}
            for k in (k for k in range(12) if k not in dropped):
                frame = av.VideoFrame.from_ndarray(images[c][k // 2], format="gray")
                frame.pts, frame.time_base = 40 * k, Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        paths.append(path)
    found = find_boards(NAMES, board(videos=tuple(paths)), quiet)
    assert len(found.numbers) == 5 and "(c0 12, c1 10): 10 images with equal number or time" in found.notes[0]
    grid = corner_grid(board())
    for c, camera in enumerate(CAMERAS):
        for v, number in enumerate(found.numbers):
            T = POSES[number // 2]
            exact = opencv_pixels(camera, grid @ T[:3, :3].T + T[:3, 3])
            assert min(np.abs(found.corners_px[c, v] - order).max() for order in (exact, exact[::-1])) < 0.25


def test_pictures_that_cannot_be_read_are_named(tmp_path):
    videos = write_pictures(tmp_path, pictures(board(), T_world_board=POSES[:2]))
    (tmp_path / "c0" / "board_0003.png").write_bytes(b"no picture")
    with pytest.raises(CaptureError, match=r"board_0003\.png: is not a readable image"):
        find_boards(NAMES, board(videos=videos), quiet)
    with pytest.raises(CaptureError, match="no file in the folder matches"):
        find_boards(("c0",), board(videos=(tmp_path / "c1" / "bord_%04d.png",)), quiet)
    cv2.imwrite(str(tmp_path / "c0" / "board_0003.png"), np.zeros((100, 100), np.uint8))
    with pytest.raises(CalibrationError, match="is 100 x 100 px, but the first image is 640 x 480"):
        find_boards(NAMES, board(videos=videos), quiet)


def test_a_charuco_board_must_be_described():
    with pytest.raises(ValueError, match="needs dictionary"):
        Boards(pattern="charuco", cols=9, rows=6, square_mm=5, videos=("a",))
    with pytest.raises(ValueError, match="must be smaller than square_mm"):
        board(pattern="charuco", dictionary="DICT_4X4_50", marker_mm=5.0)
    with pytest.raises(ValueError, match="dictionary"):
        board(pattern="charuco", dictionary="DICT_9X9_50", marker_mm=3.0)
