"""Resolve the paths in a capture.toml, and report files that are missing or outside the capture's folder."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from jawusd.base.errors import CaptureError, JawusdError
from jawusd.formats.capture_keys import Location, place
from jawusd.formats.file_names import is_pattern, wrong_kind

M = TypeVar("M", bound=BaseModel)
_MOVE = "Move the file into that folder, or allow it with --allow-outside."
_SHOWN = 3  # maximum number of suggested names
_DRIVE = re.compile(r"[A-Za-z]:[\\/]")  # drive letter at the start of a Windows path
_NO_NAME = re.compile(r"[\x00-\x1f]")  # control characters that TOML escapes produce, such as \t in videos\take.mp4
_RELATIVE = "Write it relative to the capture's folder, with slashes, such as video/left.mp4."


def resolve_paths(
    model: M, source: Path, data: Mapping[str, object], *, allow_outside: bool
) -> tuple[M, list[JawusdError]]:
    """Return a model with absolute paths, and an error for each path that is missing or outside the folder.

    Args:
        model: a model that was read from a file.
        source: the file of the model; paths are relative to its folder.
        data: content of the file, for the names of tables in messages.
        allow_outside: whether paths outside the folder are allowed.

    Raises:
        TypeError: the argument is not a model.
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
            changed = {}
            for name, field in type(value).model_fields.items():
                changed[name] = walk(getattr(value, name), (*location, field.alias or name))
            return value.model_copy(update=changed)
        if isinstance(value, tuple):
            return tuple(walk(item, (*location, i)) for i, item in enumerate(value))
        return absolute(value, location) if isinstance(value, Path) and location != ("folder",) else value

    resolved = walk(model, ())
    if not isinstance(resolved, type(model)):
        raise TypeError("only pydantic models can be resolved")
    return resolved, problems


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
