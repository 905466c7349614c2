"""`jawusd init`: what it finds from names and clips of a folder, and what it reports as missing."""

import numpy as np
import pytest
from boards import board, charuco, chessboard, photograph, poses, studio
from typer.testing import CliRunner

from jawusd.base.errors import CaptureError
from jawusd.cli.main import app
from jawusd.cli.text_capture import start_lines
from jawusd.formats.capture import read_capture
from jawusd.media.writers import VideoWriter
from jawusd.pipeline.folder_files import camera_names, find_files, pair
from jawusd.pipeline.start_capture import start_capture, write_start


def quiet(stage, done, total):
    pass


def clip(path, pictures=6, fps=24.0):
    path.parent.mkdir(parents=True, exist_ok=True)
    with VideoWriter(path, (64, 48), fps) as writer:
        for k in range(pictures):
            writer.write(np.full((48, 64), 20 * k, np.uint8))


def board_clip(path, camera):
    texture, to_texture = chessboard(board())
    path.parent.mkdir(parents=True, exist_ok=True)
    with VideoWriter(path, (640, 480), 24.0, quality_crf=8) as writer:
        for T in poses(6, np.random.default_rng(0), tilt=0.3):
            writer.write(photograph(camera, T, texture, to_texture))


@pytest.fixture
def folder(tmp_path):
    """Return a typical folder: natural names, no description."""
    cameras = studio(lens=(0.0, 0.0))
    for name, camera in zip(("left", "right"), cameras):
        clip(tmp_path / f"{name}.mp4", fps=24000 / 1001)
        board_clip(tmp_path / f"board_{name}.mp4", camera)
    for name in ("upper.stl", "lower.stl"):
        (tmp_path / name).touch()
    return tmp_path


def test_a_bare_folder_becomes_a_capture_but_for_the_squares(folder):
    start = start_capture(folder, None, None, quiet)
    assert [line.split(",")[0] for line in start.missing] == ["[boards] square_mm"]
    write_start(start)
    _, problems = read_capture(folder)
    assert [problem.message for problem in problems] == ["[boards] square_mm is missing."]


@pytest.mark.slow
def test_a_charuco_board_is_told_by_its_markers_and_the_rest_asked_for(folder):
    about = board("charuco", cols=7, rows=5, square_mm=9, dictionary="DICT_5X5_50", marker_mm=6.5)
    texture, to_texture = charuco(about)
    for name, camera in zip(("left", "right"), studio(lens=(0.0, 0.0))):
        with VideoWriter(folder / f"board_{name}.mp4", (640, 480), 24.0, quality_crf=8) as writer:
            for T in poses(6, np.random.default_rng(0), tilt=0.3):
                writer.write(photograph(camera, T, texture, to_texture))
    start = start_capture(folder, 9.0, None, quiet)
    (line,) = start.missing
    assert "cols and rows, one less than the squares of the ChArUco board" in line and "marker_mm" in line
    write_start(start)
    text = (folder / "capture.toml").read_text()
    assert 'dictionary = "DICT_5X5_50"' in text and "FILL IN: cols" in text


@pytest.mark.slow
def test_with_the_squares_it_can_be_read(folder):
    start = start_capture(folder, 8.0, None, quiet)
    assert start.missing == [] and start.notes == []
    write_start(start)
    capture, problems = read_capture(folder)
    assert problems == [] and capture.fps == pytest.approx(24000 / 1001, abs=1e-4)
    assert [camera.name for camera in capture.cameras] == ["left", "right"]
    assert [path.name for path in capture.boards.videos] == ["board_left.mp4", "board_right.mp4"]
    wanted = board()
    assert {capture.boards.cols, capture.boards.rows} == {wanted.cols, wanted.rows}
    assert capture.scans.upper_teeth.name == "upper.stl"
    assert start_lines(start)[-1] == f"next: jawusd check {folder}"


def test_what_is_missing_is_said(tmp_path):
    clip(tmp_path / "front.mp4")
    start = start_capture(tmp_path, None, None, quiet)
    said = "\n".join(start.missing)
    for words in ("upper_teeth", "lower_teeth", "footage of at least two cameras", "a calibration of the cameras"):
        assert words in said
    write_start(start)  # a template nevertheless
    text = (tmp_path / "capture.toml").read_text()
    assert text.count("# FILL IN:") == 3 and 'video = "front.mp4"' in text


@pytest.mark.slow
def test_scans_of_two_people_are_not_guessed(folder):
    (folder / "bob_upper.stl").touch()
    start = start_capture(folder, 8.0, None, quiet)
    assert len(start.missing) == 1 and "bob_upper.stl, upper.stl are all candidates" in start.missing[0]


@pytest.mark.slow
def test_a_calibration_gives_the_cameras_their_names(folder):
    from jawusd.cameras.calibration import save_calibration

    cameras = studio(lens=(0.0, 0.0))[:2]
    from dataclasses import replace

    save_calibration(folder / "cal.toml", [replace(c, name=n) for c, n in zip(cameras, ("left", "right"))])
    start = start_capture(folder, None, None, quiet)
    assert start.missing == [] and str(start.sketch.calibration) == "cal.toml"
    save_calibration(folder / "cal.toml", [replace(c, name=n) for c, n in zip(cameras, ("A", "B"))])
    start = start_capture(folder, None, None, quiet)
    assert len(start.missing) == 1 and "the calibration has A, B" in start.missing[0]


@pytest.mark.slow
def test_the_command_refuses_to_overwrite_and_says_what_is_missing_by_its_exit_code(folder):
    run = CliRunner()
    assert run.invoke(app, ["init", str(folder), "--square-mm", "8"]).exit_code == 0
    again = run.invoke(app, ["init", str(folder)])
    assert again.exit_code != 0 and "exists already" in str(again.exception)
    found = run.invoke(app, ["init", str(folder), "--force"])
    assert found.exit_code == 1 and "missing: [boards] square_mm" in found.stdout
    assert run.invoke(app, ["init"]).exit_code == 2
    listed = run.invoke(app, ["init", "--reference"])
    assert listed.exit_code == 0 and "[[camera]]" in listed.stdout


def test_no_folder(tmp_path):
    with pytest.raises(CaptureError, match="no such folder"):
        start_capture(tmp_path / "none", None, None, quiet)
    (tmp_path / "file").touch()
    with pytest.raises(CaptureError, match="is a file"):
        start_capture(tmp_path / "file", None, None, quiet)


LAYOUTS = [
    (["left.mp4", "right.mp4"], ["board_left.mp4", "board_right.mp4"], ["left", "right"]),
    (["take3_camA.mov", "take3_camB.mov"], ["calib/camB.mov", "calib/camA.mov"], ["camA", "camB"]),
    (["A/take.mp4", "B/take.mp4"], ["A/chessboard.mp4", "B/chessboard.mp4"], ["a", "b"]),
    (["video/cam0.mp4", "video/cam1.mp4"], ["boards/cam0.mp4", "boards/cam1.mp4"], ["cam0", "cam1"]),
]


@pytest.mark.parametrize(("clips", "boards", "names"), LAYOUTS)
def test_clips_and_boards_find_one_another_by_name(tmp_path, clips, boards, names):
    for path in (*clips, *boards):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).touch()
    found = find_files(tmp_path)
    assert sorted(map(str, found.clips)) == sorted(clips) and sorted(map(str, found.boards)) == sorted(boards)
    named = camera_names(found.clips)
    pairs, by_name = pair(named, found.boards)
    assert by_name and len(pairs) == len(clips)
    for path, other in pairs.items():
        assert set(named[path].lower()) & set(str(other).lower())
    if names[0] != "camA":
        assert [named[path] for path in found.clips] == names


def test_scans_are_told_by_name(tmp_path):
    for name in ("OK.stl", "UK.stl", "skull.ply", "jaw/mandible.obj"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = {key: [str(path) for path in paths] for key, paths in find_files(tmp_path).scans.items()}
    assert found == {
        "upper_teeth": ["OK.stl"],
        "lower_teeth": ["UK.stl"],
        "skull": ["skull.ply"],
        "mandible": ["jaw/mandible.obj"],
    }
    other = tmp_path / "other"
    other.mkdir()
    for name in ("maxilla.stl", "mandible.stl"):
        (other / name).touch()
    pair_of = find_files(other).scans
    assert str(pair_of["upper_teeth"][0]) == "maxilla.stl" and str(pair_of["lower_teeth"][0]) == "mandible.stl"


# File names of programs and laboratories -> upper teeth, lower teeth, mandible, skull, not assigned.
ARCHES = {
    "one word": (["4711-upperjaw.ply", "4711-lowerjaw.ply"], "01"),
    "3Shape": (["a_UpperJawScan.stl", "a_LowerJawScan.stl"], "01"),
    "capitals": (["UPPERJAWSCAN.STL", "LOWERJAWSCAN.STL"], "01"),
    "adjectives": (["maxillaryscan.stl", "mandibularscan.stl"], "01"),
    "arches": (["x_upperarch.obj", "x_lowerarch.obj"], "01"),
    "numbered": (["upperjaw1.ply", "lowerjaw1.ply"], "01"),
    "teeth": (["upperteeth.ply", "lowerteeth.ply"], "01"),
    "Medit": (["case-maxilla.stl", "case-mandible.stl"], "01"),
    "Medit, one word": (["maxillascan.ply", "mandiblescan.ply"], "01"),
    "iTero": (["77_shell_occlusion_u.stl", "77_shell_occlusion_l.stl"], "01"),
    "German": (["Oberkieferscan.stl", "Unterkieferscan.stl"], "01"),
    "German, short": (["Muster_OK.stl", "Muster_UK.stl"], "01"),
    "German, one letter": (["O_scan.stl", "U_scan.stl"], "01"),
    "English, one letter": (["U_scan.stl", "L_scan.stl"], "01"),
    "abbreviated": (["max.stl", "mand.stl"], "01"),
    "abbreviated, one word": (["maxscan.stl", "mandscan.stl"], "01"),
    "Spanish": (["arcada_superior.stl", "arcada_inferior.stl"], "01"),
    "bones": (["upper.ply", "lower.ply", "lowerjawbone.ply", "skull.ply"], "0123"),
    "an upper bone is not the skull": (["upper.ply", "lower.ply", "upperjawbone.ply"], "01-"),
    "someone called Max": (["max_lower.stl", "max_upper.stl"], "10"),
    "Max alone": (["max.stl", "lower.stl"], "-1"),
    "left and right": (["scan_l.stl", "scan_r.stl"], "--"),
    "three letters": (["o.stl", "u.stl", "l.stl"], "---"),
    "both in one": (["upperlowerscan.stl", "a.stl"], "--"),
    "okay": (["scan_ok.stl", "scan_bad.stl"], "--"),
}  # fmt: skip


@pytest.mark.parametrize("name", ARCHES)
def test_arches_by_the_names_that_laboratories_use(tmp_path, name):
    files, wanted = ARCHES[name]
    for file in files:
        (tmp_path / file).touch()
    found = {str(path): key for key, paths in find_files(tmp_path).scans.items() for path in paths}
    keys = {"upper_teeth": "0", "lower_teeth": "1", "mandible": "2", "skull": "3", "": "-"}
    assert "".join(keys[found[file]] for file in files) == wanted


def test_masks_of_a_camera_called_l_are_of_the_row_that_the_folder_says(tmp_path):
    for camera in ("l", "r"):
        for row in ("upper", "lower"):
            (tmp_path / "masks" / camera / row).mkdir(parents=True)
            for k in range(6):
                (tmp_path / "masks" / camera / row / f"{k:06d}.png").touch()
    masks = find_files(tmp_path).masks
    assert len(masks) == 4 and all(path.parts[2] == row for path, row in masks.items())


def test_masks_are_told_by_camera_and_row(tmp_path):
    clip(tmp_path / "left.mp4")
    clip(tmp_path / "right.mp4")
    for camera in ("left", "right"):
        for row in ("upper", "lower"):
            place = tmp_path / "masks" / camera / row
            place.mkdir(parents=True)
            for k in range(6):
                (place / f"{k:06d}.png").touch()
    start = start_capture(tmp_path, None, None, quiet)
    assert {str(path) for path in start.sketch.cameras[0].masks.values()} == {
        "masks/left/upper/%06d.png",
        "masks/left/lower/%06d.png",
    }
