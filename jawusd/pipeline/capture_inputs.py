"""Open a capture, and list and hash the files behind its parts."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from jawusd.errors import CaptureError
from jawusd.formats.camera_files import calibration_files
from jawusd.formats.capture import Capture, load_capture
from jawusd.formats.numbered import is_pattern, numbered_files
from jawusd.formats.scan_labels import labels_path
from jawusd.pipeline.meshes import BONES
from jawusd.pipeline.scan_labels import TEETH
from jawusd.pipeline.state import hash_files, hash_value


def open_capture(capture: Capture | str | os.PathLike[str], *, allow_outside: bool = False) -> Capture:
    """Return a capture, read if it is given as capture.toml or its folder; see `formats.capture.load_capture`.

    Args:
        allow_outside: let paths in the capture leave its folder.
    """
    return capture if isinstance(capture, Capture) else load_capture(capture, allow_outside=allow_outside)


def input_files(capture: Capture, names: Iterable[str]) -> dict[str, list[Path]]:
    """Return the files behind parts of a capture, for hashing, by the part they play.

    Args:
        names: any of "teeth", "mandible", "skull", "boards", "calibration", "masks", "videos".
    """
    parts: dict[str, list[Path]] = {}
    for name in names:
        if name == "teeth":
            scans = {key: getattr(capture.scans, key) for key in TEETH.values()}
            parts |= {key: [path] for key, path in scans.items()}
            parts |= {f"{key} labels": [labels_path(path, capture.scans.labels)] for key, path in scans.items()}
        elif name in BONES and (path := getattr(capture.scans, name)) is not None:
            parts[name] = [path]
        elif name == "calibration" and capture.calibration is not None:
            parts[name] = calibration_files(capture.calibration)
        elif name == "boards" and capture.boards is not None:
            parts |= {f"boards {k}": _sequence_files(path) for k, path in enumerate(capture.boards.videos)}
        elif name == "videos":
            clips = {camera.name: camera.video for camera in capture.cameras if camera.video is not None}
            parts |= {f"video {camera}": _sequence_files(path) for camera, path in clips.items()}
        elif name == "masks":
            for camera in capture.cameras:
                arches = {camera.masks.upper: "upper", camera.masks.lower: "lower"} if camera.masks else {}
                parts |= {f"masks {camera.name} {arch}": _sequence_files(path) for path, arch in arches.items()}
    return {part: [path for path in files if path.is_file()] for part, files in parts.items()}


def input_hashes(capture: Capture, names: Iterable[str]) -> dict[str, str]:
    """Return the content hashes of parts of a capture; see `input_files`.

    Raises:
        CaptureError: a file cannot be read.
    """
    try:
        names = list(names)
        found = {part: hash_files(files) for part, files in input_files(capture, names).items()}
    except OSError as error:
        raise CaptureError(f"cannot be read: {error.strerror}.", path=error.filename) from error
    if "videos" in names:  # how footage is read is part of what it shows
        keys = {"timecode", "start_frame", "fps", "colour_space", "pixel_aspect"}
        found["footage as read"] = hash_value([camera.model_dump(include=keys) for camera in capture.cameras])
        if capture.colour_config is not None:
            found["colour config"] = hash_files([capture.colour_config])
    return found


def _sequence_files(path: Path) -> list[Path]:
    """Return a video as it is, and the numbered files of a picture pattern; others may lie beside them."""
    if not is_pattern(path):
        return [path]
    try:
        return list(numbered_files(path).values())
    except CaptureError:  # its reader says so
        return []
