"""Write outputs atomically (temporary file, fsync, rename); pipes and devices are written in place."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import os
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jawusd.base.errors import AnyPath, OutputError, shown

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

# Name prefix of unfinished files and folders, by which leftovers of killed runs are recognised and deleted.
_UNFINISHED = ".jawusd-tmp-"
_LONGEST_SUFFIX = 16  # maximum length of a suffix kept in a temporary name [bytes]
#: Hint for files and folders that cannot be written.
ELSEWHERE = "Choose a folder where you have write access."
# Error numbers of file systems that do not support fsync or file modes.
_UNSUPPORTED = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.EPERM)


def destination(path: AnyPath) -> Path:
    """Return the file to which an output is written: the path or, for a link within its folder, the link's target.

    Raises:
        OutputError: the path is a folder, a block device, a socket, a link that leads out of its folder, or an invalid
            name.
    """
    target = Path(path)
    try:
        if is_stream(target):
            return target
        if target.is_symlink():
            target = Path(os.path.realpath(target))
            if not target.is_relative_to(os.path.realpath(Path(path).parent)):
                hint = "Delete the link, or name the file itself."
                raise OutputError(f"is a link that leads out of its folder, to {target}.", path=path, hint=hint)
        found = _mode(target)
    except (OSError, ValueError) as error:  # the name is too long or contains a null byte, or links are circular
        raise OutputError(f"cannot write here: {getattr(error, 'strerror', error)}.", path=path) from error
    if found is not None and not stat.S_ISREG(found):
        what = "a folder" if stat.S_ISDIR(found) else "something other than a file or a pipe"
        raise OutputError(f"is {what}, which is not replaced by a file.", path=path, hint="Choose another file name.")
    return target


def refuse_existing(path: Path, force: bool) -> None:
    """Check before any work that an output may be written, because it does not exist yet or `force` is set.

    Raises:
        OutputError: the output exists and `force` is not set, or `destination` rejects the path.
    """
    destination(path)
    if os.path.lexists(path) and not force and not is_stream(path):
        raise OutputError("exists already.", path=path, hint="Choose another file name, or overwrite with --force.")


def is_stream(path: Path) -> bool:
    """Return whether a path is written in place: a pipe, a device such as /dev/null, or the file of /dev/stdout."""
    found = _mode(path)
    if found is None:
        return False
    return stat.S_ISFIFO(found) or stat.S_ISCHR(found) or _standard(path) is not None


def _mode(path: Path) -> int | None:
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None


def _standard(path: Path) -> int | None:
    """Return the number of the standard stream that a link such as /dev/stdout refers to."""
    for number in (1, 2):
        with contextlib.suppress(OSError):
            if path.is_symlink() and os.path.samestat(path.stat(), os.fstat(number)):
                return number
    return None


def open_stream(path: Path) -> int:
    """Open a path for which `is_stream` holds; return a file descriptor for writing.

    Raises:
        OutputError: the path cannot be written, or is a pipe without a reader.
    """
    number = _standard(path)
    if number is not None:
        return os.dup(number)
    try:  # without this flag, opening a pipe that has no reader would block
        handle = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        why = "no program reads this pipe" if error.errno == errno.ENXIO else error.strerror
        raise OutputError(f"cannot write here: {why}.", path=path) from error
    os.set_blocking(handle, True)
    return handle


@contextlib.contextmanager
def atomic_path(path: AnyPath) -> Iterator[Path]:
    """Yield a temporary path with the same suffix, and rename it to `path` if the block succeeds.

    Missing folders are created. Links are resolved by `destination`. Pipes and devices get the finished content.

    Raises:
        OutputError: the folder cannot be written, the disk is full, or the destination is not allowed.
    """
    target = destination(path)
    stream = is_stream(target)
    suffix = target.suffix if len(os.fsencode(target.suffix)) <= _LONGEST_SUFFIX else ""
    try:
        if not stream:
            target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=None if stream else target.parent, prefix=_UNFINISHED, suffix=suffix)
        os.close(handle)
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=path, hint=ELSEWHERE) from error
    temporary = Path(name)
    try:
        yield temporary
        if stream:
            with open(temporary, "rb") as content, open(open_stream(target), "wb") as sink:
                shutil.copyfileobj(content, sink)
            return
        with open(temporary, "rb+") as written, _unless_unsupported():
            os.fsync(written.fileno())
        with _unless_unsupported():
            current = os.umask(0o022)  # the umask cannot be read without setting it
            os.umask(current)
            os.chmod(temporary, 0o666 & ~current)
        os.replace(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        after = "" if stream else " An existing file is unchanged."
        raise OutputError(f"could not be written: {error.strerror}.{after}", path=path) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _unless_unsupported() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise


@contextlib.contextmanager
def scratch_folder(beside: AnyPath) -> Iterator[Path]:
    """Yield a temporary folder beside an output file, and delete it at the end of the block.

    Raises:
        OutputError: the folder cannot be written.
    """
    target = destination(beside)
    stream = is_stream(target)
    try:
        if not stream:
            target.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=None if stream else target.parent, prefix=_UNFINISHED))
    except OSError as error:
        raise OutputError(f"cannot write here: {error.strerror}.", path=beside, hint=ELSEWHERE) from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def clear_unfinished(folder: AnyPath) -> None:
    """Delete unfinished outputs of killed runs in a folder and its subfolders; no other process may write there."""
    for left in list(Path(folder).rglob(f"{_UNFINISHED}*")):
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    # Without fsync of the folder, some file systems lose the rename in a power failure. Windows cannot open folders.
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def write_bytes_atomic(path: AnyPath, data: bytes) -> None:
    """Write bytes to a file atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text_atomic(path: AnyPath, text: str) -> None:
    """Write UTF-8 text to a file atomically.

    Raises:
        OutputError: the file cannot be written, or the text contains a name that is not UTF-8.
    """
    try:
        data = text.encode()
    except UnicodeEncodeError as error:  # surrogates stand for undecodable bytes of file names
        name = error.object[max(0, error.start - 20) : error.end + 20]
        raise OutputError(
            f'would contain a name that is not UTF-8: "{name}".', path=path, hint="Rename that file or folder."
        ) from error
    write_bytes_atomic(path, data)


def write_csv_atomic(path: AnyPath, columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write a table with a header as CSV atomically; control characters in its text are escaped.

    Raises:
        OutputError: the file cannot be written.
    """
    text = io.StringIO()
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows({k: shown(v) if isinstance(v, str) else v for k, v in row.items()} for row in rows)
    write_text_atomic(path, text.getvalue())


def write_npz_atomic(path: AnyPath, arrays: Mapping[str, ArrayLike], *, packed: bool = True) -> None:
    """Write arrays in C order as an npz file, `packed` by compression, atomically; equal arrays give equal bytes.

    Raises:
        OutputError: the file cannot be written.
        ValueError: an array contains Python objects.
    """
    import numpy as np  # imported late, since commands import this module for output checks before slow modules

    buffer = io.BytesIO()
    rows = {name: np.asarray(value, order="C") for name, value in arrays.items()}
    for name, array in rows.items():
        if array.dtype.hasobject:
            raise ValueError(f"{name} contains Python objects; only plain arrays can be written")
    # numpy stamps every member with 1980-01-01, so equal content gives equal bytes.
    (np.savez_compressed if packed else np.savez)(buffer, allow_pickle=False, **rows)
    write_bytes_atomic(path, buffer.getvalue())


def write_described_npz(
    path: AnyPath, form: str, arrays: Mapping[str, ArrayLike], meta: Mapping[str, object], *, packed: bool = True
) -> None:
    """Write arrays and metadata as `base.npz.read_npz` reads them; `form` is the format, such as "jawusd-model/2".

    Raises:
        OutputError: the file cannot be written.
    """
    from jawusd.base.npz import TWIST_ORDER, UNITS  # imported late, as in `write_npz_atomic`

    text = json.dumps({"units": UNITS, "twist_order": TWIST_ORDER, **meta, "format": form}, sort_keys=True)
    write_npz_atomic(path, {**arrays, "meta": text}, packed=packed)
