"""Read captures from `capture.toml`, format jawusd-capture/1."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from jawusd.base.errors import AnyPath, FormatError, JawusdError, UnitsError
from jawusd.base.npz import check_format
from jawusd.formats.capture_keys import FrameNumber, FrameRate, Key, KeyEntry, entries, key, problems_of
from jawusd.formats.capture_parts import Boards, CameraSource, Scans, resolve_paths, similar_names
from jawusd.formats.text import Strict, read_toml
from jawusd.geometry import rigidity_defect

FAMILY, VERSION = "jawusd-capture", 1
_MOST_PICKS = 200  # maximum number of picked vertices per arch; tracking tries all triples of them


class Sync(Strict):
    """Synchronisation of the cameras.

    Method `flash` uses light flashes or, if a clip has none, the sound; `audio` uses only the sound. `timecode`
    compares the time codes of the clips, `numbers` the frame numbers of image sequences. `offsets` sets one integer per
    camera: frame k of the camera is simultaneous with frame k + offset of the reference camera.
    """

    method: Annotated[
        Literal["flash", "audio", "timecode", "numbers", "offsets"],
        key(
            '"flash": light flashes, or sound if there are none; "audio": sound only; "timecode": time codes of the '
            'clips; "numbers": frame numbers of image sequences; "offsets": as given.'
        ),
    ] = "flash"
    reference: Annotated[
        str | None, key("Reference camera, whose frames are counted; default: the first.", '"left"')
    ] = None
    offsets: Annotated[
        dict[str, int] | None,
        key(
            "Per camera: its frame k is simultaneous with frame k + offset of the reference camera.",
            "{ left = 0, right = 5 }",
            "frames",
        ),
    ] = None


class PickView(Strict):
    """Pixel of a picked vertex in the recorded image of one camera (OpenCV coordinates)."""

    camera: Annotated[str, key("Name of the camera.", '"left"')]
    x: Annotated[float, key("Pixel column; the centre of the first pixel is 0.", "651.5", "px")]
    y: Annotated[float, key("Pixel row.", "250.4", "px")]


class Pick(Strict):
    """Picked vertex of a teeth scan, and its pixels in the images of several cameras."""

    vertex: Annotated[
        int, key("Index of a vertex of the scan, from 0 in file order; `jawusd view` writes it.", "0"), Field(ge=0)
    ]
    views: Annotated[
        tuple[PickView, ...],
        key(
            "Where it is seen, in two or more cameras.",
            '[{ camera = "left", x = 651.5, y = 250.4 }, { camera = "right", x = 663.2, y = 290.4 }]',
            "px",
        ),
        Field(min_length=2),
    ]


class Bootstrap(Strict):
    """Picked vertices that initialise tracking, in one frame of the reference camera."""

    frame: Annotated[FrameNumber, key("Frame of the reference camera in which the points are picked.", "120")]
    upper: tuple[Pick, ...] = Field((), max_length=_MOST_PICKS)
    lower: tuple[Pick, ...] = Field((), max_length=_MOST_PICKS)


class MotionSection(Strict):
    """Rest frame: the video frame in which the teeth are in occlusion."""

    rest_frame: Annotated[
        FrameNumber | None,
        key("A frame with the teeth together; default: frames in occlusion are found automatically.", "46"),
    ] = None


class AnatomySection(Strict):
    """Values that replace those derived from the scans."""

    T_anatomical_skull: Annotated[
        list[list[float]] | None,
        key("4 x 4 matrix from the scans' frame to the anatomical one (x left, y up, z forward).", unit="mm"),
    ] = None
    landmarks: Annotated[
        dict[str, tuple[float, float, float]] | None,
        key(
            "Points of mandible and ears (tragion_left, tragion_right) in the scans' frame, by name.",
            "{ lower_incisor = [0.0, -1.0, 2.0] }",
            "mm",
        ),
    ] = None

    @field_validator("T_anatomical_skull")
    @classmethod
    def _rigid(cls, value: list[list[float]] | None) -> list[list[float]] | None:
        if value is not None:
            T = np.array(value, dtype=np.float64)
            if T.shape != (4, 4) or not np.isfinite(T).all() or rigidity_defect(T) > 1e-6:
                raise ValueError("must be a rigid 4 x 4 matrix")
        return value


class Capture(Strict):
    """Content of a capture.toml; paths are absolute after loading."""

    folder: Path
    name: Annotated[
        str,
        key("Name of the subject or take: letters, digits, spaces, _ - and dots.", '"anna"'),
        Field(min_length=1, pattern=r"^[A-Za-z0-9_\-. ]+$"),
    ]
    fps: Annotated[FrameRate, key("Frame rate of the clips.", "23.976", "frames per second")]
    frames: Annotated[
        tuple[FrameNumber, FrameNumber] | None,
        key("First frame, and one past the last, of the reference camera; default: all.", "[30, 270]", "frames"),
    ] = None
    calibration: Annotated[
        Path | None, key("Calibration of the cameras; default: calibrated from [boards].", '"calibration.toml"')
    ] = None
    calibration_unit_mm: Annotated[
        float,
        key("Length of the calibration's unit: 1000 if it is in metres.", "1000.0", "mm"),
        Field(gt=0, le=1e6),
    ] = 1.0
    colour_config: Annotated[
        Path | None, key("OpenColorIO config that defines named colour spaces of the footage.", '"config.ocio"')
    ] = None
    scans: Scans
    cameras: tuple[CameraSource, ...] = Field(min_length=1, max_length=64, alias="camera")
    boards: Boards | None = None
    sync: Sync = Sync()
    bootstrap: Bootstrap | None = None
    motion: MotionSection = MotionSection()
    anatomy: AnatomySection = AnatomySection()

    @model_validator(mode="after")
    def _consistent(self) -> Capture:
        own = {"fps": self.fps, "colour_config": self.colour_config}
        cameras = tuple(
            camera.model_copy(update={name: value for name, value in own.items() if getattr(camera, name) is None})
            for camera in self.cameras
        )
        object.__setattr__(self, "cameras", cameras)  # a frozen model rejects plain assignment
        names = [camera.name for camera in self.cameras]
        listed = ", ".join(names)
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise ValueError(
                f'[[camera]] name = "{twice[0]}" is used {len(twice)} times; camera names must be unique '
                f"(found {listed}). Give each camera its own name"
            )
        if self.frames is not None and self.frames[0] >= self.frames[1]:
            raise ValueError(
                f"frames = {list(self.frames)} is empty; the second number must be larger: it is one past the last "
                "frame. For example: frames = [30, 270]"
            )
        if self.boards is not None and len(self.boards.videos) != len(names):
            raise ValueError(
                f"[boards] videos lists {len(self.boards.videos)} clips; {len(names)} are needed, one per camera: "
                f"{listed}. List them in the order of the cameras"
            )
        self._check_names_of_cameras(names)
        return self

    def _check_names_of_cameras(self, names: list[str]) -> None:
        listed = ", ".join(names)
        mentioned = {"[sync] reference": [self.sync.reference] if self.sync.reference else []}
        mentioned["[sync] offsets"] = list(self.sync.offsets or {})
        if self.bootstrap is not None:
            for row in ("upper", "lower"):
                picks = getattr(self.bootstrap, row)
                mentioned[f"[[bootstrap.{row}]] camera"] = [view.camera for pick in picks for view in pick.views]
        for place, found in mentioned.items():
            unknown = [name for name in found if name not in names]
            if unknown:
                raise ValueError(
                    f'{place} names camera "{unknown[0]}"; cameras are {listed}. Use the name from its [[camera]] table'
                )
        missing = [name for name in names if self.sync.offsets is not None and name not in self.sync.offsets]
        if missing:
            raise ValueError(
                f"[sync] offsets has no entry for {missing[0]}; required: {listed}. "
                f"Add it as {missing[0]} = 0, in frames; the offset of the reference camera is 0"
            )

    @property
    def file(self) -> Path:
        """Return the path of capture.toml."""
        return self.folder / "capture.toml"

    @property
    def reference(self) -> str:
        """Return the name of the reference camera: the one in [sync], otherwise the first camera."""
        return self.sync.reference or self.cameras[0].name


_MOST_LOOKED_AT = 4096  # number of leading bytes that are searched for null bytes


def _refuse_other_files(path: Path) -> None:
    """Raise FormatError, with a hint, for a path that cannot be a capture.toml: it is missing, or not text."""
    if not path.exists():
        hint = f"There is no folder {path.parent} either."
        if not path.is_absolute():
            hint = f"Paths are relative to the current folder, {Path.cwd()}."
        if path.parent.is_dir():
            hint = f"`jawusd init {path.parent}` creates one from the footage and scans in that folder."
            if (path.parent / "actor.usda").exists():
                hint = "That folder contains a rig; name the capture it was built from."
            elif close := similar_names(path):
                hint = f"Did you mean {close}? Otherwise, {hint}"
        raise FormatError("there is no such file.", path=path, hint=hint)
    if path.is_file() and path.suffix.lower() != ".toml":
        with open(path, "rb") as file:
            is_text = b"\0" not in file.read(_MOST_LOOKED_AT)
        if not is_text:
            raise FormatError(
                "is a binary file; a capture is a folder with a capture.toml.",
                path=path,
                hint=f"Create one for this footage: jawusd init {path.parent}",
            )


#: Keys that are checked before the models are validated.
_BEFORE = (
    KeyEntry("", "format", "text", "", Key("Format and version of the file.", f'"{FAMILY}/{VERSION}"')),
    KeyEntry("", "units", '"mm"', '"mm"', Key("Unit of all lengths.", '"mm"')),
)
_LABELS = Key("Instead of `upper` and `lower`: one label image per frame, with gray values.", '"labels/%06d.png"')


def capture_keys() -> list[KeyEntry]:
    """Return all keys of a capture.toml, in file order."""
    out = list(_BEFORE)
    for entry in entries(Capture, skipped=("folder",)):
        out.append(entry)
        if entry.name == "masks.lower":
            out.append(KeyEntry(entry.table, "masks.labels", "path", "none", _LABELS))
    return out


def load_capture(path: AnyPath, *, allow_outside: bool = False) -> Capture:
    """Read a `capture.toml`, given its path or folder; paths in the result are absolute.

    Raises:
        FormatError: the file is not a capture.toml; the message names the wrong key.
        UnitsError: lengths are not in mm.
        VersionError: the file was written for a newer version of jawusd.
        CaptureError: a file named in the capture does not exist, or is outside the capture's folder.
    """
    capture, problems = read_capture(path, allow_outside=allow_outside)
    if capture is None or problems:
        raise problems[0]
    return capture


def read_capture(path: AnyPath, *, allow_outside: bool = False) -> tuple[Capture | None, list[JawusdError]]:
    """Read a capture like `load_capture`, but return all problems instead of raising the first; None without values."""
    path = Path(path)
    if path.is_dir():
        path = path / "capture.toml"
    try:
        _refuse_other_files(path)
        data = read_toml(path)
        check_format(data.pop("format", None), FAMILY, VERSION, path)
    except JawusdError as error:
        return None, [error]
    units = data.pop("units", "mm")
    if units != "mm":
        return None, [
            UnitsError(
                f'units are "{units}"; they must be "mm".', path=path, hint='Scale to mm, and write units = "mm".'
            )
        ]
    folder = path.resolve().parent
    data["folder"] = folder
    try:
        capture = Capture.model_validate(data)
    except ValidationError as error:
        return None, [FormatError(text, path=path, hint=hint) for text, hint in problems_of(error, Capture, data)]
    except RecursionError:
        return None, [FormatError("is nested too deeply.", path=path)]
    resolved, problems = resolve_paths(capture, path, data, allow_outside=allow_outside)
    return resolved.model_copy(update={"folder": folder}), problems
