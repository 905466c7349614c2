"""Checks of input paths: regular files, names that OpenUSD can open, and folders that stages may reference."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterable
from contextvars import ContextVar
from pathlib import Path

from jawusd.base.errors import AnyPath, FormatError, JawusdError
from jawusd.base.guard import note_input

_LFS = b"version https://git-lfs"
#: Environment variable with the folders that are allowed in every run, separated as in PATH.
SETTING = "JAWUSD_ALLOW"

_given: ContextVar[tuple[Path, ...]] = ContextVar("allowed_folders", default=())


def check_input(path: AnyPath, error: type[JawusdError] = FormatError) -> None:
    """Check that an input is a regular file, and record it for crash reports; the reader reports missing files.

    Reading an idle pipe would block, and reading a device may never end. Anonymous pipes are allowed: shells use them
    for process substitution.

    Raises:
        JawusdError: the path is a folder, a named pipe, a device or a socket; raised as an instance of `error`.
    """
    note_input(path)
    there = Path(os.path.realpath(path))  # an anonymous pipe becomes "pipe:[1234]", a path that does not exist
    try:
        wrong = there.exists() and not there.is_file()
    except OSError:  # the name is too long; the reader reports it
        return
    if wrong:
        raise error("is not a regular file.", path=path, hint="Give a file, not a folder, pipe or device.")


def why_unreadable(path: AnyPath) -> tuple[str, str] | None:
    """Return message and hint for a file that is empty or a Git LFS pointer; None for other files."""
    with open(path, "rb") as file:
        head = file.read(len(_LFS))
    if not head:
        return "the file is empty.", "Copy it again."
    if head == _LFS:
        return "is a Git LFS pointer, not the file itself.", "Fetch it: git lfs pull."
    return None


def check_path(path: AnyPath, error: type[JawusdError]) -> None:
    """Check that OpenUSD can open a path, which must be UTF-8 without control characters.

    Raises:
        JawusdError: OpenUSD cannot open it; raised as an instance of `error`.
    """
    if any(unicodedata.category(letter) == "Cc" for letter in os.path.abspath(path)):
        raise error(
            "the path contains a line break or another control character; OpenUSD cannot open it.",
            path=path,
            hint="Rename the folder, or use another one.",
        )
    try:
        os.path.abspath(path).encode()
    except UnicodeEncodeError:  # Python represents undecodable bytes as lone surrogates
        raise error(
            "the path is not UTF-8, or has characters that this locale lacks; OpenUSD cannot open it.",
            path=path,
            hint="Rename the folder; if its name is UTF-8, set PYTHONUTF8=1.",
        ) from None


def allow_folders(folders: Iterable[AnyPath]) -> None:
    """Allow stages to reference files in these folders and those of the environment variable, subfolders included.

    The folders of earlier calls are replaced.
    """
    _given.set(tuple(Path(folder).resolve() for folder in folders))


def allowed_folders() -> list[Path]:
    """Return the allowed folders, with symbolic links resolved."""
    named = [Path(folder).resolve() for folder in os.environ.get(SETTING, "").split(os.pathsep) if folder]
    return [*_given.get(), *named]


def is_allowed(path: Path) -> bool:
    """Return whether a file lies in an allowed folder, with symbolic links resolved."""
    return any(path.resolve().is_relative_to(folder) for folder in allowed_folders())
