"""Name a clip and how its pictures are to be read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ClipSource:
    """Hold a video or a pattern of numbered pictures, and what the files themselves may not say.

    Attributes:
        path: the file, or a pattern as in `formats.numbered`.
        fps: rate of numbered pictures; a video has its own.
        colour_space: "display", "linear", "cineon" or a name of the OpenColorIO config; None lets the files decide.
        colour_config: OpenColorIO config.
        pixel_aspect: width of a pixel over its height; None lets the file decide.
        timecode: of the first picture; "" lets the file decide.
    """

    path: Path
    fps: float | None = None
    colour_space: str | None = None
    colour_config: Path | None = None
    pixel_aspect: float | None = None
    timecode: str = ""

    @property
    def is_light(self) -> bool:
        """Tell whether the pictures are light in fractions, as only EXR holds it."""
        return self.path.suffix.lower() == ".exr"
