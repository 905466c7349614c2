"""The files that a capture names: scans, masks, cameras and calibration boards."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from jawusd.formats.capture_keys import Key
from jawusd.formats.clips import ClipSource


class Strict(BaseModel):
    """Refuse keys that are not known, and changes."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True, populate_by_name=True)


class Scans(Strict):
    """Name the meshes, all in one frame with the teeth in occlusion [mm]."""

    upper_teeth: Annotated[
        Path, Key("Scan of the upper teeth: PLY, STL, OBJ or (with jawusd[dcm]) 3Shape DCM.", '"scans/upper.ply"', "mm")
    ]
    lower_teeth: Annotated[
        Path,
        Key("Scan of the lower teeth, in the frame of the upper one, teeth in occlusion.", '"scans/lower.ply"', "mm"),
    ]
    mandible: Annotated[
        Path | None, Key("Mesh of the whole mandible, same frame; without it a placeholder.", '"mandible.ply"', "mm")
    ] = None
    skull: Annotated[Path | None, Key("Mesh of the skull, same frame.", '"scans/skull.ply"', "mm")] = None
    labels: Annotated[
        Path | None, Key("Folder of the labels of crown and gum; beside the scans if not given.", '"labels"')
    ] = None
    registration: Annotated[
        Literal["scan", "take"],
        Key(
            '"scan": both scans stay as they are; "take": the lower one moves to where the take shows the closed bite.'
        ),
    ] = "scan"


class Masks(Strict):
    """Name the teeth masks of one camera: a PNG pattern with %06d, or a video.

    A mask is white on black, or the transparency of a picture with an alpha channel. Instead of `upper` and `lower`,
    `labels` names one pattern or lossless video in which the gray value `upper_value` means upper teeth, `lower_value`
    lower teeth and 0 neither.
    """

    upper: Annotated[
        Path,
        Key(
            "Masks of the upper teeth: PNG files with their number as %06d, or a video.", '"masks/left/upper/%06d.png"'
        ),
    ]
    lower: Annotated[Path, Key("The same of the lower teeth.", '"masks/left/lower/%06d.png"')]
    upper_value: Annotated[
        Annotated[int, Field(ge=1, le=65535)] | None,
        Key("With `labels`, one file for both rows: the gray value of the upper teeth.", "1"),
    ] = None
    lower_value: Annotated[Annotated[int, Field(ge=1, le=65535)] | None, Key("The same of the lower teeth.", "2")] = (
        None
    )

    @model_validator(mode="before")
    @classmethod
    def _one_file_for_both(cls, data: object) -> object:
        if not isinstance(data, dict) or "labels" not in data:
            return data
        rest = {key: value for key, value in data.items() if key != "labels"}
        if rest.keys() & {"upper", "lower"}:
            raise ValueError("has labels beside upper or lower, allowed is one kind. Take out the other")
        return rest | {"upper": data["labels"], "lower": data["labels"]}

    @model_validator(mode="after")
    def _values_tell_the_arches(self) -> Masks:
        values = (self.upper_value, self.lower_value)
        if self.upper == self.lower and None in values:
            raise ValueError(
                "upper and lower are one file, which needs upper_value and lower_value, the gray values of the rows. "
                "Write them as upper_value = 1 and lower_value = 2"
            )
        if self.upper != self.lower and values != (None, None):
            raise ValueError("upper_value and lower_value are for labels, one file for both rows. Take them out")
        if self.upper_value is not None and self.upper_value == self.lower_value:
            raise ValueError(
                f"upper_value and lower_value are both {self.upper_value}, they must differ. "
                "Write each row's own gray value"
            )
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


class CameraSource(Strict):
    """Name one camera's footage and masks."""

    name: Annotated[
        str,
        Field(min_length=1, pattern=r"^[A-Za-z0-9_\-]+$"),
        Key("Name of the camera, as the calibration calls it: letters, digits, _ and -.", '"left"'),
    ]
    video: Annotated[
        Path | None,
        Key(
            "Footage of the camera: a video, or numbered pictures (PNG, TIFF, EXR, DPX, JPEG) as left.%04d.exr, "
            "left.####.exr or left.*.exr.",
            '"left.mp4"',
        ),
    ] = None
    masks: Masks | None = None
    timecode: Annotated[
        str,
        Key(
            'Of the first picture, where the file has none; ";" before the frames if numbers are dropped.',
            '"10:24:03:12"',
        ),
    ] = ""
    start_frame: Annotated[
        Annotated[int, Field(ge=0)] | None,
        Key('Number of the first picture for [sync] method = "numbers"; that of the file if not given.', "1001"),
    ] = None
    fps: Annotated[
        Annotated[float, Field(gt=0, le=10000)] | None,
        Key("Rate of numbered pictures; that of the capture if not given.", "23.976", "frames per second"),
    ] = None
    colour_space: Annotated[
        str | None,
        Key(
            '"display", "linear" or "cineon", or a name of the OpenColorIO config; by the files if not given (EXR: '
            "linear, all others: display).",
            '"linear"',
        ),
    ] = None
    colour_config: Annotated[
        Path | None, Key("OpenColorIO config of this camera; that of the capture if not given.", '"config.ocio"')
    ] = None
    pixel_aspect: Annotated[
        Annotated[float, Field(ge=0.1, le=10)] | None,
        Key(
            "Width of a pixel over its height; by the file if not given. For calibrations of the widened picture.",
            "2.0",
        ),
    ] = None

    @model_validator(mode="after")
    def _has_source(self) -> CameraSource:
        if self.video is None and self.masks is None:
            raise ValueError('has neither video nor masks, one is needed. For example: video = "left.mp4"')
        return self

    @property
    def clip(self) -> ClipSource | None:
        """Return the footage and how it is read, None without any."""
        if self.video is None:
            return None
        return ClipSource(self.video, self.fps, self.colour_space, self.colour_config, self.pixel_aspect, self.timecode)


class Boards(Strict):
    """Describe the calibration boards; counts are inner corners.

    `videos` names, per camera in camera order, a video or a pattern of numbered pictures (`%04d`); pictures of one
    number are taken as simultaneous. A ChArUco board also needs OpenCV's name of its dictionary and its marker size.
    """

    pattern: Annotated[Literal["chessboard", "charuco"], Key("Kind of board.")] = "chessboard"
    cols: Annotated[
        int, Field(ge=3, le=50), Key("Inner corners along a row: one less than squares. 3 to 50.", "9", "corners")
    ]
    rows: Annotated[int, Field(ge=3, le=50), Key("Inner corners along a column.", "6", "corners")]
    square_mm: Annotated[
        float, Field(gt=0, le=200), Key("Side of a square, measured on the printed board. Up to 200.", "8.0", "mm")
    ]
    videos: Annotated[
        tuple[Path, ...],
        Key(
            "Clip of the board per camera, in the order of the cameras: videos, or numbered pictures as %04d.",
            '["board_left.mp4", "board_right.mp4"]',
        ),
    ]
    dictionary: Annotated[
        Annotated[str, Field(pattern=r"^DICT_[4-7]X[4-7]_(50|100|250|1000)$")] | None,
        Key("Of a ChArUco board: OpenCV's name of its markers.", '"DICT_5X5_100"'),
    ] = None
    marker_mm: Annotated[
        Annotated[float, Field(gt=0, le=200)] | None, Key("Of a ChArUco board: side of a marker.", "6.0", "mm")
    ] = None

    @model_validator(mode="after")
    def _describes_markers(self) -> Boards:
        if self.pattern == "charuco" and (self.dictionary is None or self.marker_mm is None):
            lacking = [key for key in ("dictionary", "marker_mm") if getattr(self, key) is None]
            raise ValueError(
                f'pattern = "charuco" needs {" and ".join(lacking)} too. '
                'Write dictionary = "DICT_5X5_100", or whichever is printed, and marker_mm = 6.0, the side of a marker'
            )
        if self.marker_mm is not None and self.marker_mm >= self.square_mm:
            raise ValueError(
                f"marker_mm = {self.marker_mm:g} must be smaller than square_mm = {self.square_mm:g}. "
                "Measure both on the printed board"
            )
        return self
