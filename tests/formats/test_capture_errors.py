"""What people get wrong in a capture.toml, and what they are told: table, key, what was found, what is allowed."""

import pytest
from capture_texts import HEAD, TABLES

from jawusd.formats.capture import Capture, capture_keys, read_capture
from jawusd.formats.capture_keys import reference_lines

GOOD = f"""{HEAD}{TABLES}[boards]
cols = 9
rows = 6
square_mm = 8.0
videos = ["left.mp4", "right.mp4"]
"""
FILES = ("u.ply", "l.ply", "left.mp4", "right.mp4")


@pytest.fixture
def told(tmp_path):
    """Return what is said of a changed file: messages without the path."""
    for name in FILES:
        (tmp_path / name).touch()

    def read(old, new, text=GOOD):
        assert old in text
        (tmp_path / "capture.toml").write_text(text.replace(old, new))
        _, problems = read_capture(tmp_path)
        assert all(problem.path == str(tmp_path / "capture.toml") for problem in problems)
        return [f"{problem.message} {problem.hint or ''}" for problem in problems]

    return read


def test_a_good_file_is_read(told):
    assert told("fps = 24.0", "fps = 24.0") == []


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('video = "left.mp4"', 'mask.upper = "a"', '[[camera]] 1 ("left"): unknown key "mask"; allowed keys: name'),
        ('video = "left.mp4"', 'mask.upper = "a"', 'Did you mean "masks"?'),
        ('video = "right.mp4"', 'vidoe = "right.mp4"', '[[camera]] 2 ("right"): unknown key "vidoe"'),
        ("fps", "FPS", 'unknown key "FPS"; allowed keys: format, units, name, fps'),
        ("[scans]", "[scan]", 'Did you mean "scans"?'),
        ("[scans]", "[scans]\nfps = 24.0", '"fps" goes at the top of the file, before the first [table]'),
        ("[scans]", "[scans]\nsquare_mm = 2.0", '"square_mm" belongs to [boards]'),
        ("fps = 24.0\n", "", "fps is missing. For example: fps = 23.976."),
        ("fps = 24.0", 'fps = "24 fps"', 'fps = "24 fps": a number is needed (frames per second)'),
        ("fps = 24.0", "fps = -24.0", "fps = -24.0 must be greater than 0"),
        ("fps = 24.0", "fps = 24.0\nframes = [9, 3]", "frames = [9, 3] is empty"),
        ("fps = 24.0", "fps = 24.0\nframes = [9]", "frames has too few entries. For example: frames = [30, 270]."),
        ("fps = 24.0", 'fps = 24.0\nframes = "all"', 'frames = "all": a list in brackets is needed'),
        ('name = "x"', 'name = "x/y"', 'name = "x/y" is empty or has characters that are not allowed'),
        ('name = "right"', 'name = "left"', "camera names must be unique (found left, left)"),
        ('lower_teeth = "l.ply"', "", "[scans] lower_teeth is missing. For example: lower_teeth"),
        ('"u.ply"', '"u.stl"', '[scans] upper_teeth = "u.stl" does not exist'),
        ('"u.ply"', '"u.stl"', "Did you mean u.ply?"),
        ('video = "left.mp4"', 'video = "Left.MP4"', "Did you mean left.mp4?"),
        ('"u.ply"', '"../u.ply"', "is outside the folder of the capture"),
        ('video = "left.mp4"', "video = 3", 'video = 3: a path in quotes is needed, such as "left.mp4"'),
        ('video = "left.mp4"', "", '[[camera]] 1 ("left"): has neither video nor masks; one is needed. For example'),
        ('video = "left.mp4"', 'masks.upper = "a.mkv"', '[[camera]] 1 ("left"), masks lower is missing'),
        ("square_mm = 8.0", 'square_mm = "8 mm"', '[boards] square_mm = "8 mm": a number is needed (mm)'),
        ("square_mm = 8.0", "square_mm = 800.0", "[boards] square_mm = 800.0 must be 200 or less (mm)"),
        ("square_mm = 8.0", "", "[boards] square_mm is missing. For example: square_mm = 8.0."),
        ("cols = 9", "columns = 9", 'Did you mean "cols"?'),
        ("cols = 9", "cols = 9.5", "[boards] cols = 9.5: a whole number is needed"),
        ("cols = 9", 'cols = 9\npattern = "charuco"', '[boards]: pattern = "charuco" also needs dictionary and'),
        ("cols = 9", 'cols = 9\npattern = "checkers"', 'pattern = "checkers" must be "chessboard" or "charuco"'),
        (', "right.mp4"]', "]", "[boards] videos lists 1 clips; 2 are needed, one per camera: left, right. List"),
        ("[boards]", '[sync]\nmethod = "clap"\n[boards]', '[sync] method = "clap" must be "flash"'),
        ("[boards]", '[sync]\nreference = "middle"\n[boards]', 'reference names camera "middle"; cameras are left'),
        ("[boards]", "[sync]\noffsets = { left = 0 }\n[boards]", "no entry for right; required: left, right."),
        ("[boards]", "[bootstrap]\nframe = -1\n[boards]", "[bootstrap] frame = -1 must be 0 or more"),
        (
            "[boards]",
            '[bootstrap]\nframe = 1\n[[bootstrap.upper]]\nvertex = 3\nviews = [{ camera = "left", x = 1 }]\n[boards]',
            "[[bootstrap.upper]] 1, views 1 y is missing",
        ),
        ('"jawusd-capture/1"', '"jawusd-capture/9"', "Update jawusd"),
        ('name = "x"', "name = x", "is not valid TOML"),
    ],
)
def test_mistakes_are_named_with_what_is_allowed(told, old, new, said):
    found = told(old, new)
    assert any(said in line for line in found), found


def test_one_mistake_is_one_message(told):
    """Not also what follows from it."""
    for old, new in (
        ('upper_teeth = "u.ply"', 'upper_teet = "u.ply"'),
        ("[scans]", "[scan]"),
        ('name = "left"', 'name = "left one"'),
        ("cols = 9", "columns = 9"),
        ('video = "left.mp4"', "video = 3"),
    ):
        assert len(told(old, new)) == 1, told(old, new)
    assert len(told("[scans]", "[scans")) == 1


def test_one_camera_as_a_single_table(told):
    one = GOOD[: GOOD.index("[[camera]]")] + '[camera]\nname = "left"\nvideo = "left.mp4"\n'
    assert told("[camera]", "[camera]", one) == [
        "[camera] is a single table; write [[camera]], with double brackets, for each one. "
    ]


def test_a_video_is_no_capture(tmp_path):
    (tmp_path / "take.mp4").write_bytes(b"\0\xff\0ftyp")
    assert "is a binary file; a capture is a folder" in read_capture(tmp_path / "take.mp4")[1][0].message
    assert f"jawusd init {tmp_path}" in str(read_capture(tmp_path / "take.mp4")[1][0])
    assert f"jawusd init {tmp_path}" in str(read_capture(tmp_path)[1][0])
    away = tmp_path / "none"
    assert read_capture(away / "capture.toml")[1][0].hint == f"There is no folder {away} either."


def test_every_key_is_in_the_reference_with_what_it_means(tmp_path):
    keys = capture_keys()
    assert all(entry.key.meaning for entry in keys)
    assert {(entry.table, entry.name) for entry in keys} >= {
        ("", "units"),
        ("[[camera]]", "masks.labels"),
        ("[boards]", "square_mm"),
        ("[[bootstrap.upper]]", "views"),
        ("[sync]", "offsets"),
    }
    assert not any("pydantic" in line or "Annotated" in line for line in reference_lines(keys))
    assert max(map(len, reference_lines(keys, 80))) < 130


def test_the_examples_of_the_reference_can_be_read():
    """What the reference shows is put together to one file, which the models must take."""
    import tomllib

    tables: dict[str, list[str]] = {}
    left_out = {"masks.upper", "masks.lower", "T_anatomical_skull"}
    for entry in capture_keys():
        if entry.key.example and entry.name not in left_out:
            tables.setdefault(entry.table, []).append(f"{entry.name} = {entry.key.example}")
    text = "\n".join("\n".join([table, *lines]) for table, lines in tables.items())
    data = tomllib.loads(text + '\n[[camera]]\nname = "right"\nvideo = "right.mp4"\n')
    for key in ("format", "units"):
        del data[key]
    capture = Capture.model_validate({**data, "folder": "."})
    assert capture.boards.square_mm == 8.0 and capture.cameras[0].masks.labels == (1, 2)


def test_more_picks_than_can_be_tried_are_refused(told):
    views = ", ".join(f'{{ camera = "{name}", x = 1, y = 1 }}' for name in ("left", "right"))
    pick = f"[[bootstrap.upper]]\nvertex = 1\nviews = [{views}]\n"
    (problem,) = told("[boards]", f"[bootstrap]\nframe = 1\n{201 * pick}[boards]")
    assert "has 201 entries; at most 200 are allowed" in problem
    assert told("[boards]", f"[bootstrap]\nframe = 1\n{200 * pick}[boards]") == []
