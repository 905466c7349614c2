"""Which paths may be used: regular files as inputs, names that OpenUSD can open, and allowed folders for stages."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Iterable
from contextvars import ContextVar
from pathlib import Path

from jawusd.base.errors import FormatError, JawusdError
from jawusd.base.guard import take_in_hand

_LFS = b"version https://git-lfs"
#: Environment variable that allows folders in every run, separated as in PATH.
SETTING = "JAWUSD_ALLOW"

_given: ContextVar[tuple[Path, ...]] = ContextVar("allowed_folders", default=())


def check_input(path: str | os.PathLike[str], error: type[JawusdError] = FormatError) -> None:
    """Check that something to read is a file, and note that it is read. What is missing is left to its reader.

    Pipes that nobody writes to would be waited for, and devices read, for ever.

    Pipes without a name are allowed: shells hand over what another program writes in that way.

    Raises:
        JawusdError: of the given class; it is a folder, a named pipe, a device or a socket.
    """
    take_in_hand(path)
    there = Path(os.path.realpath(path))  # of a pipe without a name "pipe:[1234]", which does not exist
    try:
        wrong = there.exists() and not there.is_file()
    except OSError:  # of a name that is too long: its reader says so
        return
    if wrong:
        raise error("is not a file.", path=path)


def why_unreadable(path: str | os.PathLike[str]) -> tuple[str, str] | None:
    """Return why a file of any kind cannot be read, and what to do; None if neither length nor beginning says it."""
    with open(path, "rb") as file:
        beginning = file.read(len(_LFS))
    if not beginning:
        return "the file is empty.", "Copy it again."
    if beginning == _LFS:
        return "is a pointer of Git LFS, not the file itself.", "Fetch it: git lfs pull."
    return None


def check_path(path: str | os.PathLike[str], error: type[JawusdError]) -> None:
    """Check that OpenUSD can follow a path: it allows UTF-8 without line breaks and other control characters.

    Raises:
        JawusdError: of the given class; it cannot.
    """
    if any(unicodedata.category(letter) == "Cc" for letter in os.path.abspath(path)):
        raise error(
            "a line break or another control character is in the path; OpenUSD cannot follow it.",
            path=path,
            hint="Rename the folder, or name another one.",
        )
    try:
        os.path.abspath(path).encode()
    except UnicodeEncodeError:  # Python stands for such bytes by lone surrogates
        raise error(
            "the path is not UTF-8, or holds letters that this locale lacks; OpenUSD cannot follow it.",
            path=path,
            hint="Rename the folder; where its name is UTF-8, set PYTHONUTF8=1.",
        ) from None


def allow_folders(folders: Iterable[str | os.PathLike[str]]) -> None:
    """Allow folders, and those below them, instead of any allowed before; those of the setting stay allowed."""
    _given.set(tuple(Path(folder).resolve() for folder in folders))


def allowed_folders() -> list[Path]:
    """Return the folders that are allowed, links resolved."""
    named = [Path(folder).resolve() for folder in os.environ.get(SETTING, "").split(os.pathsep) if folder]
    return [*_given.get(), *named]


def is_allowed(path: Path) -> bool:
    """Tell whether a file lies in an allowed folder, with links resolved."""
    return any(path.resolve().is_relative_to(folder) for folder in allowed_folders())
