"""More than forty beginner's mistakes: each gives one message with file, key, value found, allowed values and remedy.

Parts that do not apply are empty, such as the key of a misspelt folder.
"""

import pytest
from capture_texts import HEAD, TABLES, write_media
from typer.testing import CliRunner

from jawusd.base.errors import JawusdError
from jawusd.cli.main import app

BOARDS = '[boards]\ncols = 9\nrows = 6\nsquare_mm = 8.0\nvideos = ["left.mp4", "right.mp4"]\n'
TEXT = HEAD + TABLES + BOARDS
VIEWS = '[{ camera = "left", x = 1, y = 2 }, { camera = "%s", x = 1, y = 2 }]'
PICK = f"[bootstrap]\nframe = 1\n[[bootstrap.upper]]\nvertex = 3\nviews = {VIEWS}\n[boards]"
CAMERA = (
    "size = [64, 48]\nmatrix = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]\ndistortions = []\nrotation = [0, 0, 0]\n"
    "translation = [0, 0, 400]\n"
)
CAMERAS = f'[cam_0]\nname = "left"\n{CAMERA}[cam_1]\nname = "right"\n{CAMERA}'

# The mistake; the replacement and the replaced text in capture.toml; key; found; allowed; remedy.
IN_THE_FILE = [
    ("a misspelt key", "video = ", "vidoe = ", '[[camera]] 1 ("left")', '"vidoe"', "allowed keys: name", '"video"'),
    ("a misspelt table", "[scans]", "[scan]", "", '"scan"', "fps, frames, calibration", 'mean "scans"'),
    ("capitals", "fps", "FPS", "", '"FPS"', "allowed keys: format", 'mean "fps"'),
    ("a key of another table", "cols", "square_mm = 2\ncols", "", "overwrite a value", "", ""),
    ("a key below the tables", "cols", "fps = 24.0\ncols", "[boards]", '"fps"', "pattern, cols", "top of the file"),
    ("masks that are one word", "video = ", "mask = ", '("left")', '"mask"', "video, masks", 'mean "masks"'),
    ("no rate", "fps = 24.0\n", "", "fps", "is missing", "", "fps = 23.976"),
    ("a rate with its unit", "fps = 24.0", 'fps = "24 fps"', "fps", '"24 fps"', "a number", "fps = 23.976"),
    ("a rate < 0", "fps = 24.0", "fps = -24.0", "fps", "-24.0", "greater than 0 (frames per second)", "fps = 23.976"),
    ("frames that end first", "name", "frames = [9, 3]\nname", "frames", "[9, 3]", "must be larger", "[30, 270]"),
    ("one frame", "name", "frames = [9]\nname", "frames", "too few", "", "frames = [30, 270]"),
    ("frames in words", "name", 'frames = "all"\nname', "frames", '"all"', "a list in brackets", "[30, 270]"),
    ("a name with a slash", 'name = "x"', 'name = "x/y"', "name", '"x/y"', "not allowed", 'name = "anna"'),
    ("a name twice", 'name = "right"', 'name = "left"', "[[camera]] name", "left, left", "must be unique", "its own"),
    ("no lower row", 'lower_teeth = "l.ply"', "", "lower_teeth", "is missing", "", 'lower_teeth = "scans/lower.ply"'),
    ("a scan that is not there", '"u.ply"', '"u.stl"', "[scans] upper_teeth", '"u.stl"', "does not exist", "u.ply?"),
    ("a clip that is not there", '= "left.mp4"', '= "Left.MP4"', "video", '"Left.MP4"', "does not exist", "left.mp4?"),
    ("a path out of the folder", '"u.ply"', '"../u.ply"', "upper_teeth", '"../u.ply"', "is outside", "--allow-outside"),
    ("a device for a clip", 'video = "left.mp4"', "video = 3", "video", "= 3", "a path in quotes", '"left.mp4"'),
    ("a camera without footage", 'video = "left.mp4"', "", "[[camera]] 1", "neither", "one is needed", 'video = "left'),
    ("masks of one row", 'video = "left.mp4"', 'masks.upper = "a"', "masks lower", "is missing", "", "lower = "),
    ("a square with its unit", "= 8.0", '= "8 mm"', "[boards] square_mm", '"8 mm"', "a number", "square_mm = 8.0"),
    ("a square in another unit", "= 8.0", "= 800.0", "[boards] square_mm", "800.0", "200 or less (mm)", "= 8.0"),
    ("a square that nobody measured", "square_mm = 8.0\n", "", "[boards] square_mm", "missing", "", "square_mm = 8.0"),
    ("corners called columns", "cols = 9", "columns = 9", "[boards]", '"columns"', "pattern, cols", 'mean "cols"'),
    ("half a corner", "cols = 9", "cols = 9.5", "[boards] cols", "9.5", "a whole number", "cols = 9"),
    ("a board without its markers", "cols", 'pattern = "charuco"\ncols', "[boards]", '"charuco"', "needs", "DICT_5X5"),
    ("a board of no kind", "cols", 'pattern = "dots"\ncols', "[boards] pattern", '"dots"', 'must be "chess', "or"),
    ("a board clip too few", ', "right.mp4"]', "]", "[boards] videos", "1 clips", "2 are needed", "in the order"),
    ("a way to align that is none", "[boards]", '[sync]\nmethod = "clap"\n[boards]', "method", '"clap"', '"flash"', ""),
    ("a camera that is none", "[boards]", '[sync]\nreference = "mid"\n[boards]', "reference", '"mid"', "left", "Use"),
    ("an offset too few", "[boards]", "[sync]\noffsets = { left = 0 }\n[boards]", "offsets", "right", "require", "= 0"),
    ("a pick before the take", "[boards]", "[bootstrap]\nframe = -1\n[boards]", "frame", "-1", "0 or more", "For ex"),
    ("a pick of no camera", "[boards]", PICK % "mid", "[[bootstrap.upper]] camera", '"mid"', "left, ", "Use the"),
    ("a newer file", "capture/1", "capture/9", "format", "capture/9", "up to", "Update jawusd"),
    ("centimetres", "fps", 'units = "cm"\nfps', "units", '"cm"', 'must be "mm"', "Scale to mm"),
    ("text without quotes", 'name = "x"', "name = x", "", "line 2", "TOML", "in quotes"),
    ("a video for a scan", '"u.ply"', '"left.mp4"', "[scans] upper_teeth", '"left.mp4"', "a mesh is needed", "Choose"),
    ("a scan for a clip", '= "left.mp4"', '= "u.ply"', '1 ("left") video', '"u.ply"', "a video or an image", "Choose"),
    ("calibration clip", "[scans]", 'calibration = "left.mp4"\n[scans]', "calibration", '"left', "[boards]", "Choose"),
    ("one clip for two", '= "right.mp4"', '= "left.mp4"', '2 ("right") video', '"left', "own file", '1 ("left") video'),
    ("one scan for both rows", '"l.ply"', '"u.ply"', "[scans] lower_teeth", '"u.ply"', "own file", "upper_teeth"),
    ("backslashes", '= "left.mp4"', '= "clips\\left.mp4"', "line 9", "clips\\left.mp4", "TOML", '"video/left.mp4"'),
    ("backslashes as text", '= "left.mp4"', "= 'clips\\left.mp4'", "video", "clips\\left", "separate", "video/left"),
    ("a backslash and t", '= "left.mp4"', '= "clips\\take.mp4"', "video", r"clips\take.mp4", "separate", "video/left"),
    ("a drive", '= "left.mp4"', '= "C:/anna/left.mp4"', "video", "C:/anna", "Windows", "relative to the"),
    ("curly quotes", '"u.ply"', "\u201cu.ply\u201d", "line 5", "\u201cu.ply\u201d", "TOML", "straight quotes"),
    ("an accent", 'name = "x"', 'name = "J\u00f6rg"', "name", '"J\u00f6rg"', "A-Z a-z 0-9 _ - . spaces", '"anna"'),
]
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"
# Encodings of the file: description; encoding; what is allowed; remedy.
STORED = [
    ("an accent of Windows", "cp1252", "line 2 has the byte 0xf6", "Save it as UTF-8"),
]
# Existing files with wrong contents: description; name; bytes; found; remedy.
CONTENTS = [
    ("an empty scan", "u.ply", b"", "the file is empty", "Copy it again"),
    ("an empty clip", "left.mp4", b"", "the file is empty", "Copy it again"),
    ("a scan that git has not fetched", "l.ply", LFS, "Git LFS", "git lfs pull"),
    ("a clip that git has not fetched", "left.mp4", LFS, "Git LFS", "pull"),
    ("text under the name of a scan", "u.ply", b"dear diary", "is not a PLY file", "Export it again"),
]
# Mistakes in arguments: description; arguments; file; found; allowed; remedy.
TYPED = [
    ("a folder without capture", ["check", "empty"], "empty", "no such file", "", "jawusd init"),
    ("a folder's name misspelt", ["check", "emty"], "emty", "no such file", "Did you mean empty?", "jawusd init"),
    ("a path from another folder", ["check", "shots/anna"], "shots/anna", "no such file", "the current folder", ""),
    ("a clip for a capture", ["check", "left.mp4"], "left.mp4", "is a binary file", "a folder", "jawusd init"),
    ("an output with files", ["build", ".", "-o", "full"], "full", "not empty", "", "Choose a new folder"),
    ("an output that is a file", ["build", ".", "-o", "u.ply"], "u.ply", "is a file", "needs a folder", "Choose a new"),
    ("an output out of reach", ["build", ".", "-o", "/dev/null/out"], "out", "cannot write here", "", "Choose a"),
    ("a rig for a capture", ["check", "rig"], "rig", "no such file", "", "That folder contains a rig; name"),
    ("a capture for a rig", ["info", "."], ".", "without actor.usda", "", "jawusd build"),
    ("two people in one folder", ["init", "two"], "", "anna_upper.stl, bob_upper.stl", "one subject", "name one"),
    ("a lens alone", ["cameras", "lens.nk", "-o", "a.toml"], "lens.nk", "no Camera node", "", "Export Project"),
    ("a project of a tracker", ["cameras", "shot.3de", "-o", "a.toml"], "shot.3de", "project", "not supported", "Nuke"),
    ("cameras to what is not written", ["cameras", "cal.toml", "-o", "a.fbx"], "a.fbx", '".fbx"', "", "Give a .toml"),
    ("cameras of other names", ["check", "others"], "cal.toml", "left", "contains east, west", ""),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("forty")
    write_media(folder)
    for inner in ("empty", "full", "two", "others", "rig"):
        (folder / inner).mkdir()
    (folder / "rig" / "actor.usda").touch()
    (folder / "full" / "diary.txt").touch()
    for name in ("anna_upper.stl", "bob_upper.stl", "anna_lower.stl", "bob_lower.stl"):
        (folder / "two" / name).touch()
    for name in ("u.ply", "l.ply", "left.mp4", "right.mp4"):
        (folder / "others" / name).write_bytes((folder / name).read_bytes())
    text = f'{HEAD}calibration = "cal.toml"\n{TABLES}'
    (folder / "capture.toml").write_text(text)
    (folder / "others" / "capture.toml").write_text(text)
    (folder / "cal.toml").write_text(CAMERAS)
    (folder / "others" / "cal.toml").write_text(CAMERAS.replace("left", "east").replace("right", "west"))
    (folder / "lens.nk").write_text("LD_3DE_Classic_LD_Model {\n name lens1\n}\n")
    (folder / "shot.3de").write_text("project")
    return folder


def told(words):
    """Return the program's message about a mistake, on one line."""
    done = CliRunner().invoke(app, words)
    assert done.exit_code != 0
    assert done.exception is None or isinstance(done.exception, JawusdError | SystemExit), done.exception
    said = str(done.exception) if isinstance(done.exception, JawusdError) else done.output
    return " ".join(said.split())


@pytest.mark.parametrize("row", IN_THE_FILE, ids=[row[0] for row in IN_THE_FILE])
def test_a_mistake_in_the_file(place, tmp_path, row):
    _, old, new, *parts = row
    assert old in TEXT
    errors = check_of(tmp_path, place, TEXT.replace(old, new, 1))
    assert sum(all(part in line for part in ("capture.toml", *parts)) for line in errors) == 1, errors
    assert sum("capture.toml" in line for line in errors) == 1, errors


def check_of(folder, place, text=TEXT, encoding="utf-8"):
    """Return the errors of a capture, one per line; existing files of the folder are kept."""
    for name in ("u.ply", "l.ply", "left.mp4", "right.mp4"):
        if not (folder / name).exists():
            (folder / name).write_bytes((place / name).read_bytes())
    (folder / "capture.toml").write_bytes(text.encode(encoding))
    said = CliRunner().invoke(app, ["check", str(folder)]).stdout
    return [line for line in said.splitlines() if line.startswith("error: ")]


@pytest.mark.parametrize("row", STORED, ids=[row[0] for row in STORED])
def test_a_mistake_in_how_the_file_is_stored(place, tmp_path, row):
    _, encoding, *parts = row
    (line,) = check_of(tmp_path, place, TEXT.replace('name = "x"', 'name = "J\u00f6rg"'), encoding)
    assert all(part in line for part in ("capture.toml", *parts)), line


def test_marks_and_line_ends_of_windows_are_no_mistake(place, tmp_path):
    plain = check_of(tmp_path, place)
    assert check_of(tmp_path, place, TEXT.replace("\n", "\r\n"), "utf-8-sig") == plain
    assert not any("capture.toml" in line for line in plain)


@pytest.mark.parametrize("row", CONTENTS, ids=[row[0] for row in CONTENTS])
def test_a_mistake_in_a_file(place, tmp_path, row):
    _, name, data, *parts = row
    (tmp_path / name).write_bytes(data)
    errors = check_of(tmp_path, place)
    assert sum(all(part in line for part in (name, *parts)) for line in errors) == 1, errors


def test_a_copy_of_a_clip(place, tmp_path):
    (tmp_path / "right.mp4").write_bytes((place / "left.mp4").read_bytes())
    errors = check_of(tmp_path, place)
    parts = ("right.mp4", "camera right", "is identical to left.mp4, the clip of camera left", "Copy the clip")
    assert sum(all(part in line for part in parts) for line in errors) == 1, errors


@pytest.mark.parametrize("row", TYPED, ids=[row[0] for row in TYPED])
def test_a_mistake_at_the_shell(place, monkeypatch, row):
    _, words, *parts = row
    monkeypatch.chdir(place)
    said = told(words)
    assert all(part in said for part in parts), said


def test_they_are_forty():
    assert len(IN_THE_FILE) + len(TYPED) + len(STORED) + len(CONTENTS) >= 40
