"""File names: file types by suffix, and numbered files such as image sequences.

The last part of a path may be a pattern: `%06d` or `%d` as in printf, `####` with one # per digit, or a glob with `*`
or `?`, for which the last digits of a file name are its number. Subfolders are not searched.
"""

from __future__ import annotations

import fnmatch
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePath

from jawusd.base.errors import CaptureError, errors_name_file

_PRINTF = re.compile(r"%(?:0(\d+))?d")
_HASHES = re.compile(r"#+")
_DIGITS = re.compile(r"(\d+)(?=\D*$)")
_GAPS_SHOWN = 4
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mxf", ".mts", ".mpg", ".y4m")
PICTURES = (".png", ".tif", ".tiff", ".exr", ".dpx", ".jpg", ".jpeg")
MESHES = (".ply", ".stl", ".obj", ".dcm")

_VIDEO, _PICTURE, _MESH = ("a video", VIDEOS), ("a picture", PICTURES), ("a mesh", MESHES)
_CALIBRATION = ("a calibration", (".toml", ".json", ".xml", ".csv", ".yml", ".yaml"))
# Keys in capture.toml, the files that they need, and file types that are not accepted, with their suffixes.
_KEYS = (
    (
        ("upper_teeth", "lower_teeth", "mandible", "skull"),
        "a mesh is needed (.ply, .stl, .obj or .dcm)",
        (_VIDEO, _PICTURE),
    ),
    (("video", "videos", "upper", "lower"), "a video or an image sequence is needed", (_MESH, _CALIBRATION)),
    (
        ("calibration",),
        "a calibration is needed; clips of a board belong in [boards] videos",
        (_MESH, _VIDEO, _PICTURE),
    ),
)


def is_pattern(path: Path) -> bool:
    """Return whether a path is a pattern of numbered files instead of one file."""
    try:
        return any(sign in path.name for sign in "%#*?") and not path.is_file()
    except (OSError, ValueError):  # the reader reports a path that is too long or has a null byte
        return False


@errors_name_file
def numbered_files(pattern: Path) -> dict[int, Path]:
    """Return the files of a pattern by number, in increasing order.

    Raises:
        CaptureError: the pattern does not have exactly one number, the folder is missing or has no file of this
            pattern, or two files have the same number.
    """
    name = pattern.name
    folder = pattern.parent
    if not folder.is_dir():
        raise CaptureError(f"there is no folder {folder}.", hint="Correct the path in capture.toml.")
    matches = _matching(pattern)
    found: dict[int, Path] = {}
    for entry in sorted(folder.iterdir()):
        match = matches.fullmatch(entry.name)
        digits = match and (match[1] if match.re.groups else (_DIGITS.search(Path(entry.name).stem) or [None])[0])
        if not digits or entry.name.startswith("."):
            continue
        number = int(digits)
        if number in found:
            single = next(iter(groups([entry.name])), entry.name)
            raise CaptureError(
                f"{found[number].name} and {entry.name} both have the number {number}.",
                hint=f"Write a pattern that matches only one of them, such as {single}.",
            )
        found[number] = entry
    if not found:
        raise CaptureError(f"no file in the folder matches {name}.", hint=_offer(folder))
    return dict(sorted(found.items()))


def _matching(pattern: Path) -> re.Pattern[str]:
    """Return a regular expression for the file names of a pattern; its group, if there is one, is the number."""
    name = pattern.name
    for sign, width in ((_PRINTF, lambda m: int(m[1] or 1)), (_HASHES, lambda m: len(m[0]))):
        places = list(sign.finditer(name))
        if len(places) > 1:
            raise CaptureError(
                "the pattern has two numbers; only one is allowed.", hint="Write the fixed number in digits."
            )
        if places:
            start, end = places[0].span()
            digits = rf"(\d{{{width(places[0])},}})"
            return re.compile(re.escape(name[:start]) + digits + re.escape(name[end:]))
    if "%" in name:
        raise CaptureError("the pattern needs a number such as %06d.", hint="Correct it in capture.toml.")
    return re.compile(fnmatch.translate(name))


def groups(names: Iterable[str]) -> Mapping[str, list[int]]:
    """Return the numbers of files by name pattern (with `%06d`); names without digits are ignored."""
    out: dict[str, list[int]] = defaultdict(list)
    widths: dict[str, set[int]] = defaultdict(set)
    for name in names:
        stem, suffix = Path(name).stem, Path(name).suffix
        match = _DIGITS.search(stem)
        if match is None:
            continue
        key = f"{stem[: match.start()]}\0{stem[match.end() :]}{suffix}"
        out[key].append(int(match[1]))
        widths[key].add(len(match[1]))
    named: dict[str, list[int]] = {}
    for key, numbers in out.items():
        width = min(widths[key])
        named[key.replace("\0", "%d" if width == 1 or len(widths[key]) > 1 else f"%0{width}d")] = sorted(numbers)
    return named


def gaps(numbers: Iterable[int]) -> str:
    """Return the numbers missing between the first and the last, such as "1007, 1010 to 1012"; "" if none."""
    there = sorted(numbers)
    out = []
    for before, after in zip(there, there[1:]):
        if after - before > 1:
            out.append(f"{before + 1}" if after - before == 2 else f"{before + 1} to {after - 1}")
    more = f" and {len(out) - _GAPS_SHOWN} more gaps" if len(out) > _GAPS_SHOWN else ""
    return ", ".join(out[:_GAPS_SHOWN]) + more


def _offer(folder: Path) -> str:
    """Return a hint with the most common patterns in a folder."""
    found = groups(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    if not found:
        return "Correct the path in capture.toml."
    return f"The folder has {' and '.join(sorted(found, key=lambda key: -len(found[key]))[:2])}."


def wrong_kind(key: str, path: PurePath) -> str | None:
    """Return why a key in capture.toml, such as `video`, rejects the suffix of a file, and what it accepts, or None."""
    for keys, needed, wrong in _KEYS:
        for kind, suffixes in wrong if key in keys else ():
            if path.suffix.lower() in suffixes:
                return f"is {kind}; {needed}."
    return None
