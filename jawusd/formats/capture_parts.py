"""Parts of a capture: scans, masks, cameras and calibration boards; and the paths in them."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, TypeVar, cast

from pydantic import BaseModel, Field, model_validator

from jawusd.base.errors import CaptureError, JawusdError
from jawusd.formats.capture_keys import FrameNumber, FrameRate, Location, key, place
from jawusd.formats.clips import ClipSource
from jawusd.formats.file_names import is_pattern, wrong_kind
from jawusd.formats.text import Strict

_GrayValue = Annotated[int, Field(ge=1, le=65535)]
_Corners = Annotated[int, Field(ge=3, le=50)]
_Side = Annotated[float, Field(gt=0, le=200)]


class Scans(Strict):
    """The meshes, in a common frame with the teeth in occlusion [mm]."""

    upper_teeth: Annotated[
        Path, key("Scan of the upper teeth: PLY, STL, OBJ or (with jawusd[dcm]) 3Shape DCM.", '"scans/upper.ply"', "mm")
    ]
    lower_teeth: Annotated[
        Path,
        key("Scan of the lower teeth, in the frame of the upper one, teeth in occlusion.", '"scans/lower.ply"', "mm"),
    ]
    mandible: Annotated[
        Path | None, key("Mesh of the whole mandible, same frame; default: a placeholder.", '"mandible.ply"', "mm")
    ] = None
    skull: Annotated[Path | None, key("Mesh of the skull, same frame.", '"scans/skull.ply"', "mm")] = None
    labels: Annotated[Path | None, key("Folder of crown and gum labels; default: beside the scans.", '"labels"')] = None
    registration: Annotated[
        Literal["scan", "take"],
        key('"scan": keep both scans as given; "take": move the lower scan to the closed bite found in the take.'),
    ] = "scan"


class Masks(Strict):
    """The teeth masks of one camera: a PNG pattern with %06d, or a video.

    A mask is white on black, or the alpha channel of an image. Instead of `upper` and `lower`, `labels` may name one
    pattern or lossless video in which the gray value `upper_value` labels upper teeth, `lower_value` lower teeth, and
    0 neither.
    """

    upper: Annotated[
        Path, key("Masks of the upper teeth: PNG files numbered as %06d, or a video.", '"masks/left/upper/%06d.png"')
    ]
    lower: Annotated[Path, key("Masks of the lower teeth.", '"masks/left/lower/%06d.png"')]
    upper_value: Annotated[_GrayValue | None, key("With `labels`: gray value of the upper teeth.", "1")] = None
    lower_value: Annotated[_GrayValue | None, key("With `labels`: gray value of the lower teeth.", "2")] = None

    @model_validator(mode="before")
    @classmethod
    def _one_file_for_both(cls, data: object) -> object:
        if not isinstance(data, dict) or "labels" not in data:
            return data
        rest = {key: value for key, value in data.items() if key != "labels"}
        if rest.keys() & {"upper", "lower"}:
            raise ValueError("has both labels and upper or lower; only one of these is allowed. Remove the others")
        return rest | {"upper": data["labels"], "lower": data["labels"]}

    @model_validator(mode="after")
    def _check_label_values(self) -> Masks:
        values = (self.upper_value, self.lower_value)
        if self.upper == self.lower and None in values:
            raise ValueError(
                "upper and lower are the same file, which needs upper_value and lower_value, the gray values of the "
                "arches. For example: upper_value = 1 and lower_value = 2"
            )
        if self.upper != self.lower and values != (None, None):
            raise ValueError(
                "upper_value and lower_value apply only to label images, which hold both arches in one file. "
                "Remove them"
            )
        if self.upper_value is not None and self.upper_value == self.lower_value:
            raise ValueError(
                f"upper_value and lower_value are both {self.upper_value}; they must differ. "
                "Give each arch its own gray value"
            )
        return self

    @property
    def labels(self) -> tuple[int, int] | None:
        """Return the gray values of upper and lower teeth in label images; None if each arch has its own file."""
        if self.upper_value is None or self.lower_value is None:
            return None
        return self.upper_value, self.lower_value

    @property
    def exchanged(self) -> Masks:
        """Return the masks with upper and lower teeth swapped."""
        return Masks(upper=self.lower, lower=self.upper, upper_value=self.lower_value, lower_value=self.upper_value)


class CameraSource(Strict):
    """The footage and masks of one camera."""

    name: Annotated[
        str,
        key("Name of the camera, as in the calibration: letters, digits, _ and -.", '"left"'),
        Field(min_length=1, pattern=r"^[A-Za-z0-9_\-]+$"),
    ]
    video: Annotated[
        Path | None,
        key(
            "Footage of the camera: a video, or an image sequence (PNG, TIFF, EXR, DPX, JPEG) such as left.%04d.exr, "
            "left.####.exr or left.*.exr.",
            '"left.mp4"',
        ),
    ] = None
    masks: Masks | None = None
    timecode: Annotated[
        str,
        key(
            'Time code of the first frame, if the file has none; ";" before the frames for drop-frame counting.',
            '"10:24:03:12"',
        ),
    ] = ""
    start_frame: Annotated[
        FrameNumber | None,
        key('Number of the first frame for [sync] method = "numbers"; default: from the file name.', "1001"),
    ] = None
    fps: Annotated[
        FrameRate | None,
        key("Frame rate of an image sequence; default: that of the capture.", "23.976", "frames per second"),
    ] = None
    colour_space: Annotated[
        str | None,
        key(
            '"display", "linear" or "cineon", or a name in the OpenColorIO config; default: by file type (EXR: linear, '
            "others: display).",
            '"linear"',
        ),
    ] = None
    colour_config: Annotated[
        Path | None, key("OpenColorIO config of this camera; default: that of the capture.", '"config.ocio"')
    ] = None
    pixel_aspect: Annotated[
        float | None,
        key(
            "Pixel aspect ratio, width over height; default: from the file. Used with calibrations of desqueezed "
            "images.",
            "2.0",
        ),
        Field(ge=0.1, le=10),
    ] = None

    @model_validator(mode="after")
    def _has_source(self) -> CameraSource:
        if self.video is None and self.masks is None:
            raise ValueError('has neither video nor masks; one is needed. For example: video = "left.mp4"')
        return self

    @property
    def clip(self) -> ClipSource | None:
        """Return the footage and the properties that determine how it is read, or None if there is no footage."""
        if self.video is None:
            return None
        return ClipSource(self.video, self.fps, self.colour_space, self.colour_config, self.pixel_aspect, self.timecode)


class Boards(Strict):
    """The calibration board and its clips; columns and rows count inner corners.

    `videos` lists one video or image sequence (`%04d`) per camera, in camera order; images with the same number count
    as simultaneous. A ChArUco board also needs OpenCV's name of its marker dictionary, and the marker size.
    """

    pattern: Annotated[Literal["chessboard", "charuco"], key("Type of board.")] = "chessboard"
    cols: Annotated[_Corners, key("Inner corners along a row: number of squares less one. 3 to 50.", "9", "corners")]
    rows: Annotated[_Corners, key("Inner corners along a column.", "6", "corners")]
    square_mm: Annotated[_Side, key("Side of a square, measured on the printed board. Up to 200.", "8.0", "mm")]
    videos: Annotated[
        tuple[Path, ...],
        key(
            "Clip of the board per camera, in the order of the cameras: videos, or image sequences as %04d.",
            '["board_left.mp4", "board_right.mp4"]',
        ),
    ]
    dictionary: Annotated[
        str | None,
        key("ChArUco boards: OpenCV's name of the marker dictionary.", '"DICT_5X5_100"'),
        Field(pattern=r"^DICT_[4-7]X[4-7]_(50|100|250|1000)$"),
    ] = None
    marker_mm: Annotated[_Side | None, key("ChArUco boards: side of a marker.", "6.0", "mm")] = None

    @model_validator(mode="after")
    def _describes_markers(self) -> Boards:
        if self.pattern == "charuco" and (self.dictionary is None or self.marker_mm is None):
            lacking = [key for key in ("dictionary", "marker_mm") if getattr(self, key) is None]
            raise ValueError(
                f'pattern = "charuco" also needs {" and ".join(lacking)}. '
                'For example: dictionary = "DICT_5X5_100" (as on the board) and marker_mm = 6.0 (side of a marker)'
            )
        if self.marker_mm is not None and self.marker_mm >= self.square_mm:
            raise ValueError(
                f"marker_mm = {self.marker_mm:g} must be smaller than square_mm = {self.square_mm:g}. "
                "Measure both on the printed board"
            )
        return self


M = TypeVar("M", bound=BaseModel)
_MOVE = "Move the file into that folder, or allow it with --allow-outside."
_SHOWN = 3  # maximum number of suggested names
_DRIVE = re.compile(r"[A-Za-z]:[\\/]")  # drive letter at the start of a Windows path
_NO_NAME = re.compile(r"[\x00-\x1f]")  # control characters that TOML escapes produce, such as \t in videos\take.mp4
_RELATIVE = "Write it relative to the capture's folder, with slashes, such as video/left.mp4."


def resolve_paths(
    model: M, source: Path, data: Mapping[str, object], *, allow_outside: bool
) -> tuple[M, list[JawusdError]]:
    """Return a model with absolute paths, and an error for each path that is missing or outside the folder of `source`.

    `data` is the content of the file, for the names of tables in messages.
    """
    folder = source.resolve().parent
    problems: list[JawusdError] = []
    named: dict[tuple[str, Path], Location] = {}

    def absolute(value: Path, location: Location) -> Path:
        full = Path(os.path.normpath(folder / value))
        try:
            problem = _problem(value, full, folder, allow_outside) or _misnamed(location, full)
            problem = problem or _named_twice(location, full, named, data)
        # The path is too long, contains a null byte, or has a circular link.
        except (OSError, ValueError, RuntimeError) as error:
            problem = f"is not a valid path ({error!s:.100}).", None
        if problem is not None:
            text, hint = problem
            where = _where(location, data)
            problems.append(CaptureError(f'{where} = "{value!s:.200}" {text}', path=source, hint=hint))
        return full

    def walk(value: object, location: Location) -> object:
        if isinstance(value, BaseModel):
            fields = type(value).model_fields.items()
            changed = {name: walk(getattr(value, name), (*location, field.alias or name)) for name, field in fields}
            return value.model_copy(update=changed)
        if isinstance(value, tuple):
            return tuple(walk(item, (*location, i)) for i, item in enumerate(value))
        return absolute(value, location) if isinstance(value, Path) and location != ("folder",) else value

    return cast(M, walk(model, ())), problems


def _where(location: Location, data: Mapping[str, object]) -> str:
    """Return the table and key of a path, such as `[[camera]] 2 ("left") video`."""
    keys = len(location) - 1
    while keys > 0 and isinstance(location[keys], int):
        keys -= 1
    table = place(location[:keys], data)
    number = "".join(f"[{part}]" for part in location[keys + 1 :])
    return f"{table} {location[keys]}{number}".strip()


def _problem(value: Path, full: Path, folder: Path, allow_outside: bool) -> tuple[str, str | None] | None:
    """Return a description of what is wrong with a path, and a hint; None if nothing is wrong."""
    if os.name != "nt" and _DRIVE.match(str(value)):
        return "is a Windows path, which does not exist on this system.", _RELATIVE
    # Links are resolved because a link inside the folder may point outside.
    anchor = full.parent if is_pattern(full) else full
    inside, exists = anchor.resolve().is_relative_to(folder), anchor.exists()
    if not allow_outside and not inside:
        return "is outside the folder of the capture.", _MOVE
    if not allow_outside and (link := _link_out(anchor, folder)) is not None:
        return f"is not safe: the link {link} leads outside the folder of the capture.", _MOVE
    if exists:
        return None
    if "\\" in str(value) or _NO_NAME.search(str(value)):
        return "does not exist; backslashes do not separate folders here.", _RELATIVE
    kind = "folder" if is_pattern(full) else "file"
    return f"does not exist: there is no {kind} {anchor}.", _similar(anchor)


def _misnamed(location: Location, full: Path) -> tuple[str, str | None] | None:
    """Return what is wrong with the type of a file, and a hint; None if nothing is wrong."""
    key = next((str(part) for part in reversed(location) if isinstance(part, str)), "")
    kind = wrong_kind(key, full)
    return None if kind is None else (kind, f"Choose another file for {key}.")


def _named_twice(
    location: Location, full: Path, named: dict[tuple[str, Path], Location], data: Mapping[str, object]
) -> tuple[str, str | None] | None:
    """Return what is wrong if another key also names a scan, clip or mask, and a hint; otherwise record its use."""
    group = next((str(part) for part in location if part in ("scans", "masks", "video", "videos")), "")
    other = named.setdefault((group, full), location)
    # One label file may contain both arches of a camera.
    if not group or other == location or (group == "masks" and other[:2] == location[:2]):
        return None
    return f"is already used by {_where(other, data)}; each key needs its own file.", "Correct one of the two."


def _link_out(place: Path, folder: Path) -> str | None:
    """Return a link in a folder of images or labels that points outside the capture's folder, or None."""
    if not place.is_dir():
        return None
    with os.scandir(place) as entries:
        links = sorted(entry.path for entry in entries if entry.is_symlink())
    return next((link for link in links if not Path(os.path.realpath(link)).is_relative_to(folder)), None)


def _similar(path: Path) -> str:
    """Return a hint that suggests similar names."""
    if not path.parent.is_dir():
        return f"There is no folder {path.parent} either."
    found = similar_names(path)
    return f"Did you mean {found}?" if found else "Check the path in the file."


def similar_names(path: Path) -> str:
    """Return similar names in the folder of a path, such as "left.mp4 or left.mov"; "" if there are none."""
    names = sorted(entry.name for entry in path.parent.iterdir() if not entry.name.startswith("."))
    lower = {name.lower(): name for name in names}
    close = [lower[found] for found in difflib.get_close_matches(path.name.lower(), lower, n=_SHOWN)]
    stems = [name for name in names if Path(name).stem == path.stem and name not in close]
    return " or ".join([*stems, *close][:_SHOWN])
