"""Read text and tables in any encoding and locale, as written by editors, spreadsheets and other programs.

All readers share these rules:

* encoding: UTF-8, or UTF-16 and UTF-32 by the byte order mark or the first bytes;
* line ends: LF, CRLF, CR;
* separator: tab, semicolon or comma, the first that splits header and first row into the same number of cells; if there
  is none, the first that splits the header; a line `sep=;` overrides this;
* decimal separator: a point, or a comma if no number of the table has a point. Thousands separators are not supported,
  and the ambiguous `1,234` is rejected.

Blank lines, comments and blank columns at the end are skipped.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, errors_name_file
from jawusd.base.inputs import check_input

SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas"}
_AS_UTF8 = "Save it as UTF-8: editors offer the encoding under Save As."
_NAMED_SEPARATOR = re.compile(r'"?sep=(.)"?[ \t]*\n', re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?\d*,\d*(e[+-]?\d+)?", re.IGNORECASE)
_MAYBE_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")


@errors_name_file
def read_text(path: Path, most_bytes: int, encoding: str = "utf-8") -> str:
    """Return the content of a text file of at most `most_bytes`, with LF line ends.

    The encoding is used unless a byte order mark or null bytes indicate UTF-16 or UTF-32.

    Raises:
        FormatError: the file is missing, not a regular file, too large, or not text in this encoding.
    """
    check_input(path)
    try:
        size = path.stat().st_size
        if size > most_bytes:
            raise FormatError(f"is {size} bytes long; at most {most_bytes} bytes are allowed.")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FormatError("there is no such file.", hint="Check the path.") from error
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}.") from error
    found = json.detect_encoding(data)
    try:
        text = data.decode(encoding if found == "utf-8" else found)
    except UnicodeDecodeError as error:
        raise _not_text(error, found) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _not_text(error: UnicodeDecodeError, encoding: str) -> FormatError:
    if not encoding.startswith("utf-8"):
        words = f"begins as {encoding.upper()} text but has bytes that are invalid in it."
        return FormatError(words, hint=_AS_UTF8)
    line, byte = error.object[: error.start].count(b"\n") + 1, error.object[error.start]
    return FormatError(
        f"is not UTF-8 text: line {line} has the byte 0x{byte:02x}, probably an accented letter in another encoding.",
        hint=_AS_UTF8,
    )


@dataclass(frozen=True)
class TextTable:
    """A table with a header, cells as text."""

    header: list[str]  # column names, without blank ones at the end
    rows: list[list[str]]  # cells, one per column
    places: list[str]  # place of each row in the file, such as "line 3"

    def numbers(self, columns: Sequence[int], rows: Sequence[int] | None = None) -> Array:
        """Return columns and rows (default: all), given by index, as numbers, (rows, columns), with `nan` and `inf`.

        Raises:
            FormatError: a cell is not a number, or the decimal separator is ambiguous.
        """
        chosen = range(len(self.rows)) if rows is None else rows
        cells = [[self.rows[i][k] for k in columns] for i in chosen]
        return to_numbers(cells, lambda i, j: self.named(chosen[i], columns[j])).reshape(-1, len(columns))

    def named(self, row: int, column: int) -> str:
        """Return the name of a cell for messages."""
        return f'{self.places[row]}, column "{self.header[column]}"'


@errors_name_file
def read_table(path: Path, most_bytes: int, comment: str = "#", short_rows: bool = False) -> TextTable:
    """Read a table of at most `most_bytes` whose first row names the columns, without lines that begin with `comment`.

    `short_rows` allows rows to end early; the caller checks them with `check_width`.

    Raises:
        FormatError: the file is not text or not a table, or a row has more or fewer cells than the header.
    """
    found, separator = split_rows(read_text(path, most_bytes), comment)
    if not found:
        raise FormatError("is empty; the first line must name the columns.")
    header = [name.strip() for name in found[0][1]]
    while header and not header[-1]:
        header.pop()
    table = TextTable(header, [], [])
    for line, row in found[1:]:
        while len(row) > len(header) and not row[-1].strip():
            row.pop()
        table.rows.append(row)
        table.places.append(f"line {line}")
        if not short_rows:
            check_width(table, len(table.rows) - 1, separator)
    return table


def check_width(table: TextTable, index: int, separator: str = "") -> None:
    """Check that a row has as many cells as the header.

    Raises:
        FormatError: the row has more or fewer cells.
    """
    found, wanted = len(table.rows[index]), len(table.header)
    if found != wanted:
        more = separator == "," and found > wanted
        raise FormatError(
            f"{table.places[index]} has {found} values, but the header has {wanted} columns.",
            hint="Commas separate the columns here: write decimals with points." if more else "Correct that line.",
        )


def split_rows(text: str, comment: str = "#", blank_rows: bool = False) -> tuple[list[tuple[int, list[str]]], str]:
    """Return the rows of a table with their line numbers, without lines that begin with `comment`, and the separator.

    `blank_rows` keeps rows of several blank cells, except at the end.

    Raises:
        FormatError: quotes do not match.
    """
    named = _NAMED_SEPARATOR.match(text)
    above = 1 if named else 0
    try:
        separator = named[1] if named else _separator(text, comment)
        reader = csv.reader(io.StringIO(text[named.end() :] if named else text), delimiter=separator, strict=True)
        rows = [(reader.line_num + above, row) for row in reader if blank_rows and len(row) > 1 or _is_filled(row)]
    except csv.Error as error:
        raise FormatError(f"is not a CSV table ({error}).") from error
    while rows and not _is_filled(rows[-1][1]):
        rows.pop()
    return [(line, row) for line, row in rows if not row[0].lstrip().startswith(comment)], separator


def _is_filled(row: Sequence[str]) -> bool:
    return any(map(str.strip, row))


def _separator(text: str, comment: str) -> str:
    """Return the separator, determined from the first line that any separator splits, and the line after it."""
    lines = (line for line in io.StringIO(text) if line.strip() and not line.lstrip().startswith(comment))
    first = next((line for line in lines if any(sign in line for sign in SEPARATORS)), "")
    second = next(lines, "")
    widths = {sign: [len(row) for row in csv.reader([first, second], delimiter=sign)] for sign in SEPARATORS}
    splitting = [sign for sign, (width, *_) in widths.items() if width > 1]
    alike = [sign for sign in splitting if len(set(widths[sign])) == 1]
    return (alike or splitting or [","])[0]


def to_numbers(cells: Sequence[Sequence[str]], named: Callable[[int, int], str]) -> Array:
    """Return cells, in rows of equal length, as an array of numbers; `nan` and `inf` are kept.

    `named` returns the name of a cell for messages, given row and column.

    Raises:
        FormatError: a cell is not a number, or the decimal separator is ambiguous.
    """
    if any("," in cell for row in cells for cell in row):
        cells = _with_points(cells, named)
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError as error:
        for i, row in enumerate(cells):
            for j, cell in enumerate(row):
                if not is_number(cell):
                    raise FormatError(f'{named(i, j)}: "{cell:.80}" is not a number.') from error
        raise


def is_number(cell: str) -> bool:
    """Return whether a text is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _with_points(cells: Sequence[Sequence[str]], named: Callable[[int, int], str]) -> list[list[str]]:
    """Return the cells with decimal commas replaced by points."""
    flat = [(i, j, cell.strip()) for i, row in enumerate(cells) for j, cell in enumerate(row)]
    commas = [place for place in flat if "," in place[2]]
    point = next((place for place in flat if "." in place[2] and is_number(place[2].replace(",", ""))), None)
    i, j, cell = commas[0]
    if point is not None:
        raise FormatError(
            f'{named(i, j)} is "{cell}" and {named(*point[:2])} is "{point[2]}": commas and points cannot both be '
            "decimal separators, and thousands separators are not allowed.",
            hint="Write all decimals with points, without thousands separators.",
        )
    if all(_MAYBE_THOUSANDS.fullmatch(cell) for _, _, cell in commas):
        raise FormatError(
            f'{named(i, j)}: "{cell}" is ambiguous: {cell.replace(",", ".")} or {cell.replace(",", "")}.',
            hint="Write decimals with points, without thousands separators.",
        )
    return [
        [cell.replace(",", ".") if _COMMA_NUMBER.fullmatch(cell.strip()) else cell for cell in row] for row in cells
    ]
