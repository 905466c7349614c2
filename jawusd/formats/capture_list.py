"""A list of captures: a text file with one capture per line, and optionally a name for its output.

    # comments and empty lines are skipped; paths are relative to the folder of this file
    day_1/anna/capture.toml
    day_1/ben
    day_2/ben, ben_again
    "day_2/ben, late", ben_late

The format is CSV: quote paths that contain a comma.
"""

from __future__ import annotations

import csv
import os
import re
from dataclasses import dataclass
from pathlib import Path

from jawusd.base.errors import AnyPath, FormatError, errors_name_file
from jawusd.formats.text import read_text

_MAX_BYTES = 16 << 20
_NAME = re.compile(r"[A-Za-z0-9_\-][A-Za-z0-9_\-. ]*")


@dataclass(frozen=True)
class ListedCapture:
    """One capture of a list."""

    path: Path  # absolute path of a capture.toml or its folder; may not exist
    name: str  # name of the output folder, unique in the list


@errors_name_file
def load_capture_list(path: AnyPath) -> list[ListedCapture]:
    """Read a list of captures.

    Raises:
        FormatError: the file is missing, empty or not text, a line is invalid, or two captures have the same name.
    """
    path = Path(path)
    folder, found = path.resolve().parent, []
    lines: dict[str, int] = {}
    for number, line in enumerate(read_text(path, _MAX_BYTES).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        item = _listed(line, folder, number)
        # names are compared in lower case, since some file systems are case-insensitive
        earlier = lines.setdefault(item.name.casefold(), number)
        if earlier != number:
            raise FormatError(
                f'lines {earlier} and {number} have the same output folder "{item.name}".',
                hint="Add a different name after a comma: PATH, NAME.",
            )
        found.append(item)
    if not found:
        raise FormatError("lists no captures; expected one path per line.")
    return found


def _listed(line: str, folder: Path, number: int) -> ListedCapture:
    try:
        (cells,) = csv.reader([line], strict=True, skipinitialspace=True)
    except (csv.Error, ValueError) as error:
        raise FormatError(f"line {number} is not CSV ({error}).") from error
    cells = [cell.strip() for cell in cells]
    while len(cells) > 1 and not cells[-1]:  # remove blank columns appended by spreadsheets
        cells.pop()
    if len(cells) > 2 or not cells[0] or "\0" in cells[0]:
        raise FormatError(f"line {number} must be a path, optionally followed by a comma and a name.")
    capture = Path(os.path.normpath(folder / cells[0]))
    name = cells[1] if len(cells) == 2 else _default_name(capture)
    if not _NAME.fullmatch(name) or name.endswith((".", " ")):
        raise FormatError(
            f'line {number}: "{name}" is not a valid folder name; use only letters, digits, "_", "-", "." and spaces.',
            hint="Add a name after a comma: PATH, NAME.",
        )
    return ListedCapture(capture, name)


def _default_name(capture: Path) -> str:
    if capture.suffix != ".toml":
        return capture.name
    return capture.parent.name if capture.name == "capture.toml" else capture.stem
