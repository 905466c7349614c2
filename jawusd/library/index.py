"""The index of a folder of rigs: `library.json`, format jawusd-library/1.

The index only caches the results of scanning the folder; the paths in it are never opened. Rigs are searched for only
within the folder, and read again if their content has changed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, JawusdError
from jawusd.base.npz import check_format
from jawusd.evaluator import JawRig
from jawusd.formats.atomic import write_text_atomic
from jawusd.geometry import LANDMARKS, landmark_frame, transform_points
from jawusd.library.personal import Donor, condylar_distance_mm, condyle_incisor_mm

FAMILY, VERSION = "jawusd-library", 1
INDEX_FILE = "library.json"
MODEL_FILE, ACTOR_FILE = "model.npz", "actor.usda"
PARAMETERS = ("opening", "laterotrusion", "protrusion")

_MAX_FOLDERS = 20_000
_MAX_INDEX_BYTES = 64 << 20

#: Function that reads a rig from a file.
Loader = Callable[[Path], JawRig]


@dataclass(frozen=True)
class Entry:
    """The index entry of one rig."""

    path: str  # path of the rig's file relative to the folder, with forward slashes
    actor: str  # name of the subject
    kind: str  # kind of the rig's model
    content: str  # SHA-256 hash of the rig's files
    ranges_mm: dict[str, list[float]]  # minimum and maximum of each jaw parameter
    # landmarks by name, in the subject's own landmark frame (occlusal plane, origin at the lower incisal point)
    landmarks_mm: dict[str, list[float]]
    condylar_distance_mm: float  # distance between the condyle centres
    condyle_incisor_mm: float  # distance from the midpoint of the condyles to the incisal point
    errors_mm: dict[str, object]  # error tables from the header of the model
    not_shown: bool  # whether the capture lacks a movement, which makes the rig unusable for transfer

    def landmarks(self) -> Array:
        """Return the landmarks [mm] in the order of `LANDMARKS`, shape (5, 3)."""
        return np.array([self.landmarks_mm[name] for name in LANDMARKS])


@dataclass(frozen=True)
class Library:
    """A folder of rigs after scanning."""

    folder: Path  # resolved path of the folder
    entries: tuple[Entry, ...]  # rigs in the folder, sorted by path
    skipped: dict[str, str]  # by path of a file that could not be read: the reason
    reread: int  # number of new or changed rigs

    def find(self, name: str) -> Entry:
        """Return the rig of a subject, given its name or path; raises FormatError unless exactly one rig matches."""
        found = [entry for entry in self.entries if name in (entry.path, entry.actor, str(Path(entry.path).parent))]
        if not found:
            known = ", ".join(entry.actor for entry in self.entries) or "no rigs"
            raise FormatError(f'has no rig named "{name}"; it contains {known}.', path=self.folder)
        if len(found) > 1:
            paths = ", ".join(entry.path for entry in found)
            raise FormatError(f'has several rigs named "{name}": {paths}.', path=self.folder, hint="Give the path.")
        return found[0]

    def search(self, text: str) -> tuple[Entry, ...]:
        """Return the rigs whose name or path contains a given text, ignoring case."""
        return tuple(e for e in self.entries if text.lower() in e.actor.lower() or text.lower() in e.path.lower())


def scan_library(folder: AnyPath, load: Loader) -> Library:
    """Scan a folder and update its index.

    Every subfolder with a `model.npz` or, without it, an `actor.usda`, is one subject. Links out of the folder are not
    followed.

    Raises:
        FormatError: the folder is missing or has too many subfolders, or the index is corrupt.
        VersionError: the index was written by a newer version.
        OutputError: the updated index cannot be written.
    """
    root = Path(folder).resolve()
    if not root.is_dir():
        raise FormatError("the folder does not exist.", path=folder)
    known = _read_index(root / INDEX_FILE)
    entries, skipped, reread = [], {}, 0
    for path in sorted(_rig_files(root)):
        name = path.relative_to(root).as_posix()
        try:
            content = _content(path, root)
            entry = known.get(name)
            if entry is None or entry.content != content:
                entry, reread = _entry(name, content, load(path)), reread + 1
            entries.append(entry)
        except JawusdError as error:
            skipped[name] = f"{error.statement()} {error.hint or ''}".strip()
    if {entry.path: entry for entry in entries} != known:
        data = {"format": f"{FAMILY}/{VERSION}", "units": "mm", "rigs": [asdict(entry) for entry in entries]}
        write_text_atomic(root / INDEX_FILE, json.dumps(data, indent=1, sort_keys=True) + "\n")
    return Library(root, tuple(entries), skipped, reread)


def load_donors(library: Library, load: Loader) -> list[Donor]:
    """Read the rigs of all subjects whose captures include every movement, named by their paths.

    Raises a JawusdError if a rig has become unreadable since the scan.
    """
    return [Donor(e.path, load(library.folder / e.path)) for e in library.entries if not e.not_shown]


def _rig_files(root: Path) -> Iterator[Path]:
    for count, (where, folders, files) in enumerate(os.walk(root, followlinks=False)):
        if count >= _MAX_FOLDERS:
            raise FormatError(f"has more than {_MAX_FOLDERS} subfolders, which is the limit for a library.", path=root)
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in (MODEL_FILE, ACTOR_FILE):
            if name in files:
                yield Path(where) / name
                break


def _content(path: Path, root: Path) -> str:
    """Return the SHA-256 of the files from which a rig is read."""
    total = hashlib.sha256()
    parts = [path]
    if path.name == ACTOR_FILE:  # OpenUSD also opens the files in this folder that the interface layer references
        parts += sorted(p for p in path.parent.iterdir() if p.suffix.startswith(".usd") and p != path)
    for part in parts:
        if not part.resolve().is_relative_to(root):
            raise FormatError(
                f"{part.name} is a link that points outside the library; such links are not followed.", path=path
            )
        if not part.is_file():
            raise FormatError(f"{part.name} is not a file.", path=path)
        total.update(part.name.encode() + b"\0")
        try:
            with open(part, "rb") as handle:
                hashlib.file_digest(handle, lambda: total)  # continues the hash
        except OSError as error:
            raise FormatError(f"{part.name} cannot be read: {error.strerror}.", path=path) from error
    return total.hexdigest()


def _entry(name: str, content: str, rig: JawRig) -> Entry:
    landmarks = rig.landmarks
    shown = transform_points(landmark_frame(landmarks), landmarks)
    warnings, errors = rig.meta.get("warnings"), rig.meta.get("errors")
    codes = [w.get("code") for w in warnings if isinstance(w, dict)] if isinstance(warnings, list) else []
    return Entry(
        path=name,
        actor=rig.actor or Path(name).parent.name or "unnamed",
        kind=rig.kind,
        content=content,
        ranges_mm={key: row.tolist() for key, row in zip(PARAMETERS, rig.d_range, strict=True)},
        landmarks_mm={key: row.tolist() for key, row in zip(LANDMARKS, shown, strict=True)},
        condylar_distance_mm=condylar_distance_mm(landmarks),
        condyle_incisor_mm=condyle_incisor_mm(landmarks),
        errors_mm=errors if isinstance(errors, dict) else {},
        not_shown="not_shown" in codes,
    )


def _read_index(path: Path) -> dict[str, Entry]:
    """Return the entries of an index by path; empty if there is no index."""
    if path.is_symlink():
        raise FormatError("is a link; the index must be a regular file.", path=path)
    if not path.exists():
        return {}
    try:
        if path.stat().st_size > _MAX_INDEX_BYTES:
            raise ValueError(f"it has {path.stat().st_size} bytes")
        data = json.loads(path.read_text(encoding="utf-8"))
        check_format(data.get("format"), FAMILY, VERSION, path)
        return {entry.path: entry for entry in map(_entry_of, data["rigs"])}
    except (OSError, ValueError, TypeError, AttributeError, KeyError, OverflowError, RecursionError) as error:
        raise FormatError(f"is corrupt ({error}).", path=path, hint="Delete it; it will be rebuilt.") from error


def _entry_of(record: object) -> Entry:
    if not isinstance(record, dict):
        raise TypeError("an entry is not an object")
    entry = Entry(**record)
    text = [field.name for field in fields(Entry) if field.type == "str"]
    if not all(isinstance(getattr(entry, name), str) for name in text):
        raise ValueError("a text field is not a string")
    numbers = [*entry.ranges_mm[PARAMETERS[0]], entry.condylar_distance_mm, entry.condyle_incisor_mm]
    numbers += [*entry.ranges_mm[PARAMETERS[1]], *entry.ranges_mm[PARAMETERS[2]]]
    if len(numbers) != 8 or not np.isfinite(np.array(numbers, dtype=np.float64)).all():
        raise ValueError("ranges are not three pairs of numbers")
    if entry.landmarks().shape != (5, 3) or not np.isfinite(entry.landmarks().astype(np.float64)).all():
        raise ValueError("landmarks are not five points")
    return entry
