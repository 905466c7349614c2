"""Files to read are files: pipes that nobody writes to and devices would be waited for, or read, for ever."""

from __future__ import annotations

import os
from pathlib import Path

from jawusd.errors import FormatError, JawusdError


def check_input(path: str | os.PathLike[str], error: type[JawusdError] = FormatError) -> None:
    """Check that something to read is a file. What is missing is left to its reader, which says so.

    Pipes without a name are allowed: shells hand over what another program writes in that way.

    Raises:
        JawusdError: of the given class; it is a folder, a named pipe, a device or a socket.
    """
    there = Path(os.path.realpath(path))  # of a pipe without a name "pipe:[1234]", which does not exist
    try:
        wrong = there.exists() and not there.is_file()
    except OSError:  # of a name that is too long: its reader says so
        return
    if wrong:
        raise error("is not a file.", path=path)
