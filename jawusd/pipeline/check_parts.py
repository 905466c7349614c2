"""The parts of a capture as its checks read them, each loaded once."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal

from jawusd.base.errors import JawusdError
from jawusd.formats.capture import CameraSource, Capture
from jawusd.formats.file_names import is_pattern
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.geometry import Camera

if TYPE_CHECKING:
    from jawusd.media.clip import Clip
    from jawusd.media.mask_survey import MaskSamples
    from jawusd.tracking.contour.scan import Scan

Size = tuple[int, int]


@dataclass
class Parts:
    """Hold what checks have read so far; what is empty could not be read. A context manager: closes the masks."""

    capture: Capture | None
    out: Path  # folder whose disk the rig will fill
    allow_outside: bool
    meshes: dict[str, Mesh] = field(default_factory=dict)
    scans: tuple[Scan, ...] = ()  # upper and lower, if both can be used
    videos: dict[str, Clip] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    samples: dict[str, MaskSamples] = field(default_factory=dict)
    open_files: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    @property
    def description(self) -> str:
        """Return the path of capture.toml."""
        return str(self.given.folder / "capture.toml")

    @property
    def given(self) -> Capture:
        """Return the capture, for checks that need it.

        Raises:
            ValueError: it could not be read.
        """
        if self.capture is None:
            raise ValueError("there is no capture")
        return self.capture

    def usable(self, path: Path) -> bool:
        """Tell whether a file may be opened: it exists, or its folder does, and lies where it may."""
        place = path.parent if is_pattern(path) else path
        try:
            inside = self.allow_outside or place.resolve().is_relative_to(self.given.folder)
            return inside and place.exists()
        except (OSError, ValueError, RuntimeError):
            return False

    def clip_read(self, camera: CameraSource) -> bool:
        """Tell whether a camera has no clip, or one that could be opened."""
        return camera.video is None or camera.name in self.videos

    def offsets(self) -> Mapping[str, int] | None:
        """Return the frame offsets where they need no look at the clips, as `sync_cameras` takes them; else None."""
        capture = self.given
        if capture.sync.offsets is not None:
            return capture.sync.offsets
        if len(capture.cameras) == 1 or any(camera.video is None for camera in capture.cameras):
            return {camera.name: 0 for camera in capture.cameras}
        return None

    def offset_guesses(self) -> list[Mapping[str, int]]:
        """Return the offsets, or what they may be: none, and those at which the masks of all cameras begin together."""
        if (known := self.offsets()) is not None:
            return [known]
        capture = self.given
        guesses: list[Mapping[str, int]] = [{camera.name: 0 for camera in capture.cameras}]
        first = {name: sample.first_frame for name, sample in self.samples.items()}
        begin = first.get(capture.reference)
        if begin is not None:
            guesses.append({name: begin - own for name, own in first.items() if own is not None})
        return guesses

    def __enter__(self) -> Parts:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.open_files.close()


def found_error(kind: str, error: JawusdError, severity: Literal["error", "warning"] = "error") -> Finding:
    """Return an exception as a finding."""
    return Finding(
        kind, severity, error.message, path=error.path, camera=error.camera, frame=error.frame, hint=error.hint
    )
