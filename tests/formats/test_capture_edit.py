"""Picks are put into a capture file, and nothing else in it changes or is lost."""

import stat
import tomllib

import pytest

from jawusd.base.errors import FormatError, OutputError
from jawusd.formats.capture import Bootstrap, Pick, PickView
from jawusd.formats.capture_writing import with_bootstrap, write_bootstrap


def picks(frame=20, count=3, shift=0.0):
    """Return made-up picks."""

    def row(first):
        return tuple(
            Pick(
                vertex=first + k,
                views=(PickView(camera="cam0", x=10.5 + k + shift, y=20.25), PickView(camera="cam_1-b", x=3.0, y=4.0)),
            )
            for k in range(count)
        )

    return Bootstrap(frame=frame, upper=row(100), lower=row(200))


BEFORE = """# my capture
format = "jawusd-capture/1"   # do not touch
name = "a # b"
frames = [
  20,  # first
  320,
]

[scans]
upper_teeth = "[bootstrap]"
note = '''
[bootstrap]
frame = 3
'''
"""
OLD = """
[bootstrap]  # made by hand
# by Ada
frame = 7

[[bootstrap.upper]]
vertex = 1  # the cusp
views = [{ camera = "cam0", x = 1, y = 2 },
         { camera = "cam1", x = 1, y = 2 }]  # blurred

"""
AFTER = """# about the motion
[motion]
rest_frame = 36 # closed
"""


@pytest.mark.parametrize("old", ["", OLD])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_everything_else_stays(old, newline):
    text = (BEFORE + old + AFTER).replace("\n", newline)
    changed = with_bootstrap(text, picks())
    data, was = tomllib.loads(changed), tomllib.loads(text)
    assert Bootstrap.model_validate(data.pop("bootstrap")) == picks()
    was.pop("bootstrap", None)
    assert data == was
    assert BEFORE.replace("\n", newline) in changed and AFTER.replace("\n", newline) in changed
    assert changed.count("\n") == changed.count(newline)
    for comment in ("# by Ada", "# made by hand", "# the cusp", "# blurred") if old else ():
        assert comment in changed
    assert with_bootstrap(changed, picks()) == changed  # and again: nothing grows


def test_picks_between_and_without_a_last_line_end():
    text = "[bootstrap]\nframe = 1\n[motion]\nrest_frame = 3\n[[bootstrap.lower]]\nvertex = 1\n"
    text += 'views = [{camera = "a", x = 1, y = 1}, {camera = "b", x = 1, y = 1}]'
    changed = with_bootstrap(text, picks())
    assert tomllib.loads(changed)["motion"] == {"rest_frame": 3}
    assert Bootstrap.model_validate(tomllib.loads(changed)["bootstrap"]) == picks()


@pytest.mark.parametrize(
    "form",
    ["bootstrap.frame = 3\n", "bootstrap = { frame = 3 }\n", "'bootstrap' = { frame = 3 }\n[motion]\nrest_frame = 1\n"],
)
def test_forms_that_cannot_be_replaced_are_refused_and_the_file_is_untouched(tmp_path, form):
    path = tmp_path / "capture.toml"
    path.write_text(form)
    with pytest.raises(OutputError, match="not written as separate tables"):
        write_bootstrap(path, picks(), Bootstrap(frame=3))
    assert path.read_text() == form and [p.name for p in tmp_path.iterdir()] == ["capture.toml"]


def test_picks_somebody_else_wrote_meanwhile_are_not_overwritten(tmp_path):
    path = tmp_path / "capture.toml"
    path.write_text(BEFORE)
    write_bootstrap(path, picks(), None)
    with pytest.raises(OutputError, match="changed by another program"):
        write_bootstrap(path, picks(shift=1.0), None)
    write_bootstrap(path, picks(shift=1.0), picks())
    assert Bootstrap.model_validate(tomllib.loads(path.read_text())["bootstrap"]) == picks(shift=1.0)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_the_encoding_of_the_file_stays(tmp_path, encoding):
    path = tmp_path / "capture.toml"
    path.write_bytes((BEFORE + "# Zähne\r\n").encode(encoding))
    write_bootstrap(path, picks(), None)
    assert path.read_bytes().startswith("\ufeff".encode("utf-16-le" if encoding == "utf-16" else "utf-8"))
    text = path.read_bytes().decode(encoding)
    assert "# Zähne\r\n" in text and Bootstrap.model_validate(tomllib.loads(text)["bootstrap"]) == picks()


def test_a_link_stays_a_link(tmp_path):
    real = tmp_path / "real.toml"
    real.write_text(BEFORE)
    link = tmp_path / "capture.toml"
    link.symlink_to(real)
    write_bootstrap(link, picks(), None)
    assert link.is_symlink() and "[bootstrap]" in real.read_text().splitlines()


def test_damaged_files_and_folders_that_cannot_be_written_are_clear_errors(tmp_path, monkeypatch):
    path = tmp_path / "capture.toml"
    with pytest.raises(OutputError, match="cannot be read"):
        write_bootstrap(path, picks(), None)
    path.write_text("a = [")
    with pytest.raises(FormatError, match="not valid TOML"):
        write_bootstrap(path, picks(), None)
    path.write_text("[bootstrap]\nframe = -1\n")
    with pytest.raises(FormatError, match="bootstrap"):
        write_bootstrap(path, picks(), None)
    path.write_text(BEFORE)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OutputError, match="No space left"):
        write_bootstrap(path, picks(), None)
    assert path.read_text() == BEFORE and stat.S_ISREG(path.stat().st_mode)
