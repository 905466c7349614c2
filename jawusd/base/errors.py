"""The exceptions of jawusd, with one exit code per family.

A message states the place (file, frame, camera), what was found, what is allowed with its unit, and what to do.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from functools import partial, wraps
from os import PathLike
from typing import Concatenate, ParamSpec, TypeVar

#: A path as text or as an object.
AnyPath = str | PathLike[str]

_Path = TypeVar("_Path", bound=AnyPath)
_Rest = ParamSpec("_Rest")
_Read = TypeVar("_Read")

_OF_BUILD = "PIL av cv2 jinja2 matplotlib numba onnx onnxruntime pyfqmr scipy shapely torch trimesh"
_EXTRA_OF_PACKAGE = {
    "moderngl": "demo",
    "viser": "view",
    "PyOpenColorIO": "colour",
    "ezc3d": "c3d",
    "h5py": "hdf5",
    "pythonosc": "live",
    "dask": "many",
    "distributed": "many",
    **dict.fromkeys(_OF_BUILD.split(), "build"),
}


# Control characters, direction marks, invisible characters, and undecodable bytes of file names.
_HIDDEN = re.compile(
    "[\x00-\x1f\x7f-\x9f\u00ad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    "\ud800-\udfff\U000e0000-\U000e0fff]"
)
_LISTED = "\n  "  # separates several findings in one message


def shown(text: object) -> str:
    """Return text from a file as one printable line; control characters are escaped."""
    return _HIDDEN.sub(_escape, str(text))


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a name that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return found[0].encode("unicode_escape").decode()


class JawusdError(Exception):
    """Base class of all errors: one clear sentence for the user, safe to print (see `shown`).

    Args:
        message: what was found and what is allowed, with units.
        path, camera, frame: the place, printed before the message.
        hint: what to do, printed after the message.
    """

    exit_code = 1

    def __init__(
        self,
        message: str,
        *,
        path: AnyPath | None = None,
        camera: str | None = None,
        frame: int | None = None,
        hint: str | None = None,
    ) -> None:
        self.message = message
        self.path = None if path is None else str(path)
        self.camera = camera
        self.frame = frame
        self.hint = hint
        super().__init__(message)

    def statement(self) -> str:
        """Return camera, frame and message, without path and hint."""
        camera = [] if self.camera is None else [f"camera {self.camera}"]
        frame = [] if self.frame is None else [f"frame {self.frame}"]
        where = ", ".join(camera + frame)
        message = _LISTED.join(shown(part) for part in self.message.split(_LISTED))
        return f"{shown(where)}: {message}" if where else message

    def __str__(self) -> str:
        where = f"{shown(self.path)}: " if self.path is not None else ""
        advice = f" {shown(self.hint)}" if self.hint else ""
        return f"{where}{self.statement()}{advice}"

    def __reduce__(self) -> tuple[Callable[[str], JawusdError], tuple[str]]:
        # Exceptions cross process boundaries; the default protocol loses keyword arguments.
        kind = partial(type(self), path=self.path, camera=self.camera, frame=self.frame, hint=self.hint)
        return kind, (self.message,)


class FormatError(JawusdError):
    """A file does not follow its format."""

    exit_code = 3


class VersionError(FormatError):
    """A file was written by a newer version of jawusd."""


class UnitsError(FormatError):
    """Lengths or angles are in a unit that the format does not allow."""


class MissingDependencyError(JawusdError):
    """A required optional package is not installed."""

    exit_code = 4


class CaptureError(JawusdError):
    """A capture cannot be used."""

    exit_code = 5


class CalibrationError(CaptureError):
    """The calibration of cameras is missing or wrong."""


class SyncError(CaptureError):
    """Cameras could not be synchronised."""


class TrackingError(JawusdError):
    """Teeth could not be tracked."""

    exit_code = 6


class FittingError(JawusdError):
    """No jaw model can be fitted to the poses."""

    exit_code = 7


class RigError(JawusdError):
    """A rig cannot be written or read."""

    exit_code = 8


class EvaluatorError(JawusdError):
    """A model cannot be evaluated."""

    exit_code = 9


class OutputError(JawusdError):
    """An output cannot, or must not, be written."""

    exit_code = 10


class ClusterError(JawusdError):
    """A cluster does not answer, or its workers cannot build."""

    exit_code = 11


class ResourceError(JawusdError):
    """Memory or processor time ran out, or a library crashed."""

    exit_code = 12


@contextlib.contextmanager
def naming_file(path: AnyPath) -> Iterator[None]:
    """Add a file's path to errors that have none."""
    try:
        yield
    except JawusdError as error:
        if error.path is None:
            error.path = str(path)
        raise


def errors_name_file(read: Callable[Concatenate[_Path, _Rest], _Read]) -> Callable[Concatenate[_Path, _Rest], _Read]:
    """Decorate a function of a file, its first argument: errors without a path get that of the file."""

    @wraps(read)
    def named(path: _Path, *args: _Rest.args, **options: _Rest.kwargs) -> _Read:
        with naming_file(path):
            return read(path, *args, **options)

    return named


@contextlib.contextmanager
def explain_missing_packages(extra: str | None = None) -> Iterator[None]:
    """Name the extra to install, by default that of the missing package; a context manager and decorator.

    Raises:
        MissingDependencyError: instead of the ModuleNotFoundError.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "jawusd"):
            raise
        raise MissingDependencyError(
            f'{_importing_module(error)} needs the package "{error.name}", which is not installed.',
            hint=f"Install it with: pip install 'jawusd[{extra or _EXTRA_OF_PACKAGE.get(package, 'all')}]'",
        ) from error


def _importing_module(error: ModuleNotFoundError) -> str:
    """Return the innermost jawusd module in the traceback of an import error."""
    found, step = "jawusd", error.__traceback__
    while step is not None:
        name = str(step.tb_frame.f_globals.get("__name__"))
        found, step = (name if name.startswith("jawusd.") else found), step.tb_next
    return found
