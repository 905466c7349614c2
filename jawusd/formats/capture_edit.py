"""Replace the picked points in a capture.toml, and preserve everything else including comments."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError

from jawusd.base.errors import FormatError, OutputError
from jawusd.base.inputs import check_input
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.formats.capture import Bootstrap

_TABLE = "bootstrap"


def write_bootstrap(path: str | os.PathLike[str], picks: Bootstrap, expected: Bootstrap | None) -> None:
    """Replace or add `[bootstrap]` of a capture.toml, if its picked points are still the expected ones.

    Raises:
        FormatError: the file is not TOML.
        OutputError: the picked points have changed or cannot be replaced safely, or the file cannot be written.
            The file is then unchanged.
    """
    path = Path(path).resolve()  # for a link, replace its target
    check_input(path)
    try:
        data = path.read_bytes()
        encoding = json.detect_encoding(data)  # detected as in `jawusd.base.tables.read_text`, and kept on writing
        text = data.decode(encoding)
        found = tomllib.loads(text).get(_TABLE)
        there = None if found is None else Bootstrap.model_validate(found)
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror}.", path=path) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise FormatError(f"is not valid TOML: {error}.", path=path) from error
    except ValidationError as error:
        raise FormatError(f"[{_TABLE}] cannot be read: {error.errors()[0]['msg']}.", path=path) from error
    if there != expected:
        raise OutputError(
            f"[{_TABLE}] was changed by another program after the file was read.",
            path=path,
            hint="Open the capture again to load the current picks.",
        )
    try:
        changed = with_bootstrap(text, picks)
    except ValueError as error:
        raise OutputError(
            f"{error}.",
            path=path,
            hint=f"Write [{_TABLE}] as tables, [{_TABLE}] and [[{_TABLE}.upper]], or delete it.",
        ) from error
    write_bytes_atomic(path, changed.encode(encoding))


def with_bootstrap(text: str, picks: Bootstrap) -> str:
    """Return the text of a capture.toml with new picked points; comments among the old ones are kept.

    Raises:
        ValueError: the old picked points are not written as tables.
    """
    blocks = list(_blocks(text))
    newline = "\r\n" if "\r\n" in text else "\n"
    own = [number for number, (table, _) in enumerate(blocks) if table == _TABLE]
    comments = [line for number in own for line in _comments(blocks[number][1], last=number == own[-1])]
    fresh = newline.join([f"[{_TABLE}]", *comments, *_lines(picks)]) + newline
    if own:
        rest = ["".join(lines) for number, (_, lines) in enumerate(blocks) if number not in own]
        tail = "".join(_after(blocks[own[-1]][1])) or newline * (len(rest) > own[0])
        changed = "".join([*rest[: own[0]], fresh, tail, *rest[own[0] :]])
    else:
        end = "" if not text or text.endswith("\n") else newline
        changed = f"{text}{end}{newline}{fresh}"
    _check(text, changed, picks)
    return changed


def _lines(picks: Bootstrap) -> list[str]:
    lines = [f"frame = {picks.frame}"]
    for arch, picked in (("upper", picks.upper), ("lower", picks.lower)):
        for pick in picked:
            # Camera names need no escapes, since they contain no characters that TOML escapes.
            views = (f'{{ camera = "{view.camera}", x = {view.x:.2f}, y = {view.y:.2f} }}' for view in pick.views)
            lines += ["", f"[[{_TABLE}.{arch}]]", f"vertex = {pick.vertex}", f"views = [{', '.join(views)}]"]
    return lines


def _blocks(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the top-level name, header and content lines of each table; the name is "" before the first header."""
    table = ""
    lines: list[str] = []
    for statement in _statements(text):
        if statement[0].lstrip().startswith("["):
            yield table, lines
            table, lines = next(iter(tomllib.loads(statement[0]))), []
        lines += statement
    yield table, lines


def _statements(text: str) -> Iterator[list[str]]:
    """Yield the lines of each header, value, comment or blank line; values may span several lines."""
    pending: list[str] = []
    for line in text.split("\n")[: None if not text.endswith("\n") else -1]:
        pending.append(line + "\n")
        try:
            tomllib.loads("".join(pending))
        except tomllib.TOMLDecodeError:
            continue  # the value continues on the next line
        yield pending
        pending = []
    if pending:
        yield pending


def _comments(lines: list[str], last: bool) -> list[str]:
    """Return the comments of a block; a value with a trailing comment is commented out as a whole."""
    among = lines[: len(lines) - len(_after(lines))] if last else lines
    # Values of picked points contain no #, so a # starts a comment.
    return [line.strip() if line.lstrip().startswith("#") else f"# {line.strip()}" for line in among if "#" in line]


def _after(lines: list[str]) -> list[str]:
    """Return the blank lines and comments at the end of a block, which belong to the next block."""
    count = 0
    while count < len(lines) and lines[-1 - count].strip()[:1] in ("", "#"):
        count += 1
    return lines[len(lines) - count :]


def _check(before: str, after: str, picks: Bootstrap) -> None:
    """Check that two texts differ only in the picked points.

    Raises:
        ValueError: the texts differ elsewhere.
    """
    try:
        old, new = tomllib.loads(before), tomllib.loads(after)
        written = Bootstrap.model_validate(new.pop(_TABLE))
    except (tomllib.TOMLDecodeError, ValidationError) as error:
        raise ValueError(f"[{_TABLE}] is not written as separate tables") from error
    old.pop(_TABLE, None)
    rounded = Bootstrap.model_validate(tomllib.loads("\n".join(_lines(picks)).replace(f"[[{_TABLE}.", "[[")))
    if old != new or written != rounded:
        raise ValueError(f"[{_TABLE}] is not written as separate tables")
