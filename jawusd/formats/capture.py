"""The description of a capture: `capture.toml`, format jawusd-capture/1."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from jawusd.errors import CaptureError, FormatError, JawusdError, UnitsError
from jawusd.formats.text import read_toml
from jawusd.geometry import rigidity_defect
from jawusd.npz import check_format

FAMILY, VERSION = "jawusd-capture", 1


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)


class Scans(_Strict):
    """Name the meshes, all in one frame with the teeth in occlusion [mm]."""

    upper_teeth: Path
    lower_teeth: Path
    mandible: Path | None = None
    skull: Path | None = None
    #: Folder of the labels of the teeth scans; beside the scans if not given.
    labels: Path | None = None
    #: Whether the two scans are taken as they stand, or the lower one is moved to where the take shows the closed bite.
    registration: Literal["scan", "take"] = "scan"


class Masks(_Strict):
    """Name the teeth masks of one camera: a PNG pattern with %06d, or a video.

    A mask is white on black, or the transparency of a picture with an alpha channel. Instead of `upper` and `lower`,
    `labels` names one pattern or lossless video in which the gray value `upper_value` means upper teeth, `lower_value`
    lower teeth and 0 neither.
    """

    upper: Path
    lower: Path
    upper_value: Annotated[int, Field(ge=1, le=65535)] | None = None
    lower_value: Annotated[int, Field(ge=1, le=65535)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _one_file_for_both(cls, data: object) -> object:
        if not isinstance(data, dict) or "labels" not in data:
            return data
        rest = {key: value for key, value in data.items() if key != "labels"}
        if rest.keys() & {"upper", "lower"}:
            raise ValueError("give either labels, or upper and lower")
        return rest | {"upper": data["labels"], "lower": data["labels"]}

    @model_validator(mode="after")
    def _values_tell_the_arches(self) -> Masks:
        values = (self.upper_value, self.lower_value)
        if self.upper == self.lower and None in values:
            raise ValueError("one file for both rows needs upper_value and lower_value, their gray values")
        if self.upper != self.lower and values != (None, None):
            raise ValueError("upper_value and lower_value are for labels, one file for both rows")
        if self.upper_value is not None and self.upper_value == self.lower_value:
            raise ValueError(f"upper_value and lower_value are both {self.upper_value}")
        return self

    @property
    def labels(self) -> tuple[int, int] | None:
        """Return the gray values of upper and lower teeth in label images, None where each arch has its own file."""
        if self.upper_value is None or self.lower_value is None:
            return None
        return self.upper_value, self.lower_value

    @property
    def exchanged(self) -> Masks:
        """Return the masks with upper and lower exchanged."""
        return Masks(upper=self.lower, lower=self.upper, upper_value=self.lower_value, lower_value=self.upper_value)


class CameraSource(_Strict):
    """Name one camera's footage and masks."""

    name: Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_\-]+$")]
    video: Path | None = None
    masks: Masks | None = None

    @model_validator(mode="after")
    def _has_source(self) -> CameraSource:
        if self.video is None and self.masks is None:
            raise ValueError("needs a video or masks")
        return self


class Boards(_Strict):
    """Describe the calibration boards; counts are inner corners.

    `videos` names, per camera in camera order, a video or a pattern of numbered pictures (`%04d`); pictures of one
    number are taken as simultaneous. A ChArUco board also needs OpenCV's name of its dictionary and its marker size.
    """

    pattern: Literal["chessboard", "charuco"] = "chessboard"
    cols: Annotated[int, Field(ge=3, le=50)]
    rows: Annotated[int, Field(ge=3, le=50)]
    square_mm: Annotated[float, Field(gt=0, le=200)]
    videos: tuple[Path, ...]
    dictionary: Annotated[str, Field(pattern=r"^DICT_[4-7]X[4-7]_(50|100|250|1000)$")] | None = None
    marker_mm: Annotated[float, Field(gt=0, le=200)] | None = None

    @model_validator(mode="after")
    def _describes_markers(self) -> Boards:
        if self.pattern == "charuco" and (self.dictionary is None or self.marker_mm is None):
            raise ValueError('a "charuco" board needs dictionary (as "DICT_5X5_100") and marker_mm')
        if self.marker_mm is not None and self.marker_mm >= self.square_mm:
            raise ValueError(f"marker_mm = {self.marker_mm:g} must be smaller than square_mm = {self.square_mm:g}")
        return self


class Sync(_Strict):
    """Say how the cameras are aligned in time.

    `flash` looks for light flashes and, where a clip shows none, listens to the sound; `audio` only listens.
    `offsets` gives, per camera, the whole number with: frame k of the camera shows the instant of frame k + offset of
    the reference camera.
    """

    method: Literal["flash", "audio", "offsets"] = "flash"
    reference: str | None = None
    offsets: dict[str, int] | None = None


class PickView(_Strict):
    """Give the pixel of a picked vertex in one camera (OpenCV pixels of the recorded picture)."""

    camera: str
    x: float
    y: float


class Pick(_Strict):
    """Join a vertex of a teeth scan with the pixels where it is seen."""

    vertex: Annotated[int, Field(ge=0)]
    views: Annotated[tuple[PickView, ...], Field(min_length=2)]


class Bootstrap(_Strict):
    """Give the picks that start the tracking, on one frame of the reference camera."""

    frame: Annotated[int, Field(ge=0)]
    upper: tuple[Pick, ...] = ()
    lower: tuple[Pick, ...] = ()


class MotionSection(_Strict):
    """Name a reference frame with the teeth in occlusion."""

    rest_frame: Annotated[int, Field(ge=0)] | None = None


class AnatomySection(_Strict):
    """Override what is otherwise derived from the scans."""

    T_anatomical_skull: list[list[float]] | None = None
    landmarks: dict[str, tuple[float, float, float]] | None = None

    @field_validator("T_anatomical_skull")
    @classmethod
    def _rigid(cls, value: list[list[float]] | None) -> list[list[float]] | None:
        if value is not None:
            T = np.array(value, dtype=np.float64)
            if T.shape != (4, 4) or not np.isfinite(T).all() or rigidity_defect(T) > 1e-6:
                raise ValueError("must be a rigid 4 x 4 matrix")
        return value


class Capture(_Strict):
    """Describe a capture; all paths are absolute once loaded."""

    folder: Path
    name: Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_\-. ]+$")]
    fps: Annotated[float, Field(gt=0, le=10000)]
    frames: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None = None
    calibration: Path | None = None
    #: Length of the calibration file's unit [mm]; others write metres or, from pictures alone, any unit.
    calibration_unit_mm: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    scans: Scans
    cameras: Annotated[tuple[CameraSource, ...], Field(min_length=1, max_length=64)]
    boards: Boards | None = None
    sync: Sync = Sync()
    bootstrap: Bootstrap | None = None
    motion: MotionSection = MotionSection()
    anatomy: AnatomySection = AnatomySection()

    @model_validator(mode="after")
    def _consistent(self) -> Capture:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names):
            raise ValueError(f"camera names must differ, found {', '.join(names)}")
        if self.frames is not None and self.frames[0] >= self.frames[1]:
            raise ValueError(f"frames = {list(self.frames)} is empty; the second number is one past the last frame")
        if self.boards is not None and len(self.boards.videos) != len(names):
            raise ValueError(f"[boards] names {len(self.boards.videos)} videos for {len(names)} cameras")
        mentioned = {self.sync.reference} if self.sync.reference else set()
        mentioned |= set(self.sync.offsets or {})
        for pick in (*self.bootstrap.upper, *self.bootstrap.lower) if self.bootstrap else ():
            mentioned |= {view.camera for view in pick.views}
        unknown = sorted(mentioned - set(names))
        if unknown:
            raise ValueError(f"names camera {unknown[0]}, known are {', '.join(names)}")
        if self.sync.offsets is not None and set(names) - set(self.sync.offsets):
            missing = sorted(set(names) - set(self.sync.offsets))
            raise ValueError(f"[sync] offsets has no entry for {missing[0]}; the reference camera's is 0")
        return self

    @property
    def reference(self) -> str:
        """Return the name of the reference camera, the first one unless [sync] names it."""
        return self.sync.reference or self.cameras[0].name


def load_capture(path: str | os.PathLike[str], *, allow_outside: bool = False) -> Capture:
    """Read `capture.toml`, given itself or by its folder; the paths of the capture are absolute.

    Raises:
        FormatError: not such a file; the message names the key.
        UnitsError: lengths not in mm.
        VersionError: written for a newer jawusd.
        CaptureError: a file it names does not exist, or lies outside its folder.
    """
    capture, problems = read_capture(path, allow_outside=allow_outside)
    if capture is None or problems:
        raise problems[0]
    return capture


def read_capture(
    path: str | os.PathLike[str], *, allow_outside: bool = False
) -> tuple[Capture | None, list[JawusdError]]:
    """Read a capture as `load_capture` does, and return everything that is wrong with it instead of raising.

    The capture is None if values are missing or wrong; if it names files that do not exist, it still names them.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "capture.toml"
    try:
        data = read_toml(path)
        check_format(data.pop("format", None), FAMILY, VERSION, path)
    except JawusdError as error:
        return None, [error]
    units = data.pop("units", "mm")
    if units != "mm":
        return None, [UnitsError(f'units are "{units}", allowed is "mm".', path=path)]
    folder = path.resolve().parent
    data["folder"] = folder
    if "camera" in data:
        data["cameras"] = data.pop("camera")
    try:
        capture = Capture.model_validate(data)
    except ValidationError as error:
        return None, [FormatError(problem, path=path) for problem in _problems(error)]
    except RecursionError:
        return None, [FormatError("is nested too deeply.", path=path)]
    problems: list[JawusdError] = []
    return _resolve(capture, folder, path, allow_outside, problems), problems


def _problems(error: ValidationError) -> list[str]:
    out = []
    # A misspelt key also makes the right one missing; the misspelling is the cause.
    for problem in sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden"):
        where = ".".join("camera" if part == "cameras" else str(part) for part in problem["loc"])
        found = problem.get("input")
        shown = "" if isinstance(found, dict | list | tuple) or problem["type"] == "missing" else f' (found "{found}")'
        out.append(f"{where or 'the file'}: {problem['msg']}{shown}.")
    return out


def _resolve(capture: Capture, folder: Path, source: Path, allow_outside: bool, problems: list[JawusdError]) -> Capture:
    """Make every path absolute, and add to the problems each that leads out of the folder or does not exist."""

    def absolute(value: Path, key: str) -> Path:
        full = Path(os.path.normpath(folder / value))
        # Resolve links as well: a link may lead out of the folder though its name does not.
        anchor = full.parent if "%" in full.name else full
        try:
            inside, exists = anchor.resolve().is_relative_to(folder), anchor.exists()
        except (OSError, ValueError, RuntimeError) as error:  # too long, a null byte, links in a circle
            problems.append(CaptureError(f"{key} is no path that can be followed ({error!s:.100}).", path=source))
            return full
        if not allow_outside and not inside:
            problems.append(
                CaptureError(
                    f'{key} = "{value}" leads out of the folder of the capture.',
                    path=source,
                    hint="Move the file inside, or allow it with --allow-outside.",
                )
            )
        elif not exists:
            kind = "folder" if "%" in full.name else "file"
            message = f"{key}: there is no {kind} {anchor}."
            problems.append(CaptureError(message, path=source, hint="Check the path in the file."))
        return full

    def walk(value: object, key: str) -> object:
        if isinstance(value, BaseModel):
            changed = {
                name: walk(getattr(value, name), f"{key}.{name}" if key else name)
                for name in type(value).model_fields
                if name != "folder"
            }
            return value.model_copy(update=changed)
        if isinstance(value, tuple):
            return tuple(walk(item, f"{key}[{i}]") for i, item in enumerate(value))
        return absolute(value, key) if isinstance(value, Path) else value

    resolved = walk(capture, "")
    if not isinstance(resolved, Capture):
        raise TypeError("resolving a capture must give a capture")
    return resolved
