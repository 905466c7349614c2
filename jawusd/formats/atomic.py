"""Write files so that a reader never meets half of one: temporary file, fsync, rename."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jawusd.errors import OutputError

# Prefix of every unfinished file and folder, by which what a killed run leaves behind is recognised and deleted.
_UNFINISHED = ".jawusd-tmp-"
#: What to do where a file or folder cannot be written.
ELSEWHERE = "Name a place where you may write."


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`, of the same suffix, and rename it to `path` when the block ends well.

    A missing folder is made.

    Raises:
        OutputError: the folder cannot be written, or the disk is full.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f"{_UNFINISHED}{target.stem}-", suffix=target.suffix)
        os.close(handle)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=target, hint=ELSEWHERE) from error
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb+") as written:
            os.fsync(written.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        raise OutputError(
            f"could not be written: {error.strerror}. What was there before is untouched.", path=target
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def scratch_folder(beside: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary folder beside a file that is going to be written, and delete it at the end of the block.

    Raises:
        OutputError: the folder cannot be written.
    """
    target = Path(beside)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=target.parent, prefix=_UNFINISHED))
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=target, hint=ELSEWHERE) from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def clear_unfinished(folder: str | os.PathLike[str]) -> None:
    """Delete what runs that were killed left unfinished in a folder and below; nobody else may be writing there."""
    for left in list(Path(folder).rglob(f"{_UNFINISHED}*")):
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)


def _umask() -> int:
    # The umask can only be read by setting it.
    current = os.umask(0o022)
    os.umask(current)
    return current


def _sync_folder(folder: Path) -> None:
    # Without this a power cut may lose the rename on some file systems; Windows cannot open folders.
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_bytes_atomic(path: str | os.PathLike[str], data: bytes) -> None:
    """Write bytes to a file atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write UTF-8 text to a file atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    write_bytes_atomic(path, text.encode())


def write_npz_atomic(path: str | os.PathLike[str], arrays: Mapping[str, ArrayLike], *, packed: bool = True) -> None:
    """Write an npz atomically, compressed unless it must be quick, byte for byte the same for the same arrays.

    Every array is written row by row: simple readers take no other order.

    Raises:
        OutputError: the file cannot be written.
        ValueError: an array would need a pickle.
    """
    buffer = io.BytesIO()
    rows = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    for name, array in rows.items():
        if array.dtype.hasobject:
            raise ValueError(f"{name} holds Python objects; files carry plain arrays only")
    # numpy stamps every member with 1980-01-01, so equal content gives equal bytes.
    (np.savez_compressed if packed else np.savez)(buffer, allow_pickle=False, **rows)
    write_bytes_atomic(path, buffer.getvalue())
