"""Classify the files of a folder by their names: footage, board clips, masks, scans, calibration."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath

from jawusd.formats.capture_writing import CameraSketch
from jawusd.formats.file_names import MESHES, PICTURES, VIDEOS, groups

_CALIBRATIONS = (".toml", ".json", ".xml", ".csv", ".yaml", ".yml", ".txt", ".usda", ".usdc", ".usd", ".nk")
_FEWEST_PICTURES = 5  # minimum number of numbered images that count as a sequence
_DEPTH = 4

_BOARD = {"board", "boards", "calib", "calibration", "calibrate", "checker", "checkerboard", "chess", "chessboard"}
_BOARD |= {"charuco", "chart", "grid", "aruco"}
_MASK = {"mask", "masks", "matte", "mattes", "roto", "segmentation", "seg"}
_UPPER = {"upper", "maxilla", "maxillary", "maxillar", "maxillaire", "maxilar", "oberkiefer", "oben", "superior"}
_UPPER |= {"superiore", "superieur"}
_LOWER = {"lower", "mandibular", "mandibulaire", "unterkiefer", "unten", "inferior", "inferiore", "inferieur"}
# Pairs of ambiguous words for upper and lower, accepted only if two file names are otherwise equal: "u" may also mean
# "unten", German for lower.
_PAIRS = [("u", "l"), ("o", "u"), ("ok", "uk"), ("uj", "lj"), ("max", "mand"), ("mx", "md"), ("sup", "inf")]
_PAIRS += [("top", "bottom"), ("haut", "bas")]
_MANDIBLE = {"mandible", "mandibula", "jawbone"}
_SKULL = {"skull", "cranium", "schaedel", "head"}
_TEETH = {"teeth", "tooth", "scan", "arch", "dentition", "row", "crowns"}
_BONE = {"bone", "bones", "jawbone", "knochen"}
# Parts of compound words, longest first, for names such as UPPERJAWSCAN and maxillaryscan.
_PARTS = _UPPER | _LOWER | _MANDIBLE | _TEETH | {word for pair in _PAIRS for word in pair if len(word) > 2}
_PARTS |= {"jaw", "scan", "model", "cast", "ok", "uk", "ios", "impression", "anatomy", "export"}
_PART = "|".join(sorted(_PARTS, key=len, reverse=True))
_GENERIC = {"video", "videos", "clip", "clips", "footage", "take", "camera", "cameras", "plates", "png", "exr", "dpx"}


@dataclass
class FoundFiles:
    """Files by kind, relative to the folder."""

    clips: list[PurePath] = field(default_factory=list)
    boards: list[PurePath] = field(default_factory=list)
    masks: dict[PurePath, str] = field(default_factory=dict)  # arch of each mask file
    scans: dict[str, list[PurePath]] = field(default_factory=lambda: defaultdict(list))  # meshes by [scans] key
    calibrations: list[PurePath] = field(default_factory=list)


def words(path: PurePath) -> list[str]:
    """Return the words of a path in lower case, split at punctuation and before capital letters."""
    plain = path.with_suffix("").as_posix()
    plain = re.sub(r"%0?\d*d", "", plain)
    parts = re.split(r"[^A-Za-z0-9]+", re.sub(r"([a-z0-9])([A-Z])", r"\1 \2", plain))
    return [part.lower() for part in parts if part]


def find_files(folder: Path) -> FoundFiles:
    """Classify the files below a folder; numbered images count as one file, named by their pattern.

    Folders of rigs and hidden folders are skipped.
    """
    out = FoundFiles()
    files = sorted(_files(folder))
    paired = _paired([path for path in files if path.suffix.lower() in MESHES]) | _paired(
        [path for path in files if path.suffix.lower() in VIDEOS or "%" in path.name]
    )
    for path in files:
        suffix, own_words = path.suffix.lower(), set(words(path))
        if suffix in VIDEOS or "%" in path.name:
            row = _arch(set(_split_words(path))) or paired.get(path, "")
            if row and (own_words & _MASK or "%" in path.name):
                out.masks[path] = row
            elif own_words & _MASK:
                continue
            elif own_words & _BOARD:
                out.boards.append(path)
            else:
                out.clips.append(path)
        elif suffix in MESHES:
            out.scans[_part(path, paired.get(path, ""))].append(path)
        elif suffix in _CALIBRATIONS and path.name not in ("capture.toml", "build.json"):
            out.calibrations.append(path)
    scans = out.scans
    if not scans["lower_teeth"] and scans["upper_teeth"] and len(scans["mandible"]) == 1:
        # In clinics, teeth scans are often called maxilla.stl and mandible.stl.
        scans["lower_teeth"] = scans.pop("mandible")
    return out


def _files(folder: Path) -> Iterable[PurePath]:
    for place, folders, names in os.walk(folder):
        inside = PurePath(place).relative_to(folder)
        is_rig = "build.json" in names or "actor.usda" in names
        if is_rig or len(inside.parts) >= _DEPTH:
            folders.clear()
        if is_rig:
            continue
        folders[:] = sorted(name for name in folders if not name.startswith(".") and name != "truth")
        pictures = [name for name in names if Path(name).suffix.lower() in PICTURES]
        for pattern, numbers in groups(pictures).items():
            if len(numbers) >= _FEWEST_PICTURES:
                yield inside / pattern
        yield from (inside / name for name in names if name not in pictures and not name.startswith("."))


def _split_words(path: PurePath) -> list[str]:
    """Return the words of a path, with compound words split."""
    whole = rf"(?:{_PART})+\d*"
    return [part for word in words(path) for part in (re.findall(_PART, word) if re.fullmatch(whole, word) else [word])]


def _arch(own_words: set[str]) -> str:
    upper, lower = own_words & _UPPER, own_words & _LOWER
    return "" if bool(upper) == bool(lower) else "upper" if upper else "lower"


def _paired(paths: Sequence[PurePath]) -> dict[PurePath, str]:
    """Return the arch of each file whose name differs from another file's only in one pair of ambiguous words."""
    spelt = {tuple(_split_words(path)): path for path in paths}
    pairs = [
        (path, spelt[other])
        for own, path in spelt.items()
        for upper, lower in _PAIRS
        for place, word in enumerate(own)
        if word == upper and (other := (*own[:place], lower, *own[place + 1 :])) in spelt
    ]
    uppers, lowers = {upper for upper, _ in pairs}, {lower for _, lower in pairs}
    sure = [pair for pair in pairs if not set(pair) & uppers & lowers]
    return {upper: "upper" for upper, _ in sure} | {lower: "lower" for _, lower in sure}


def _part(path: PurePath, paired: str) -> str:
    """Return the key of [scans] for a mesh, "" if unknown; words of the file name take precedence over folder names.

    `paired` is the arch according to an ambiguous word (see `_paired`), "" if unknown.
    """
    own, all_words = set(_split_words(PurePath(path.name))), set(_split_words(path))
    for own_words, arch in ((own, ""), (all_words, ""), (all_words, paired)):
        arch = _arch(own_words) or arch
        if own_words & _UPPER and own_words & _LOWER:
            return ""
        if own_words & _BONE and not own_words & _TEETH and arch:
            return "mandible" if arch == "lower" else ""
        if arch and not (
            own_words & (_MANDIBLE | _SKULL) and not own_words & _TEETH and not own_words & {"upper", "lower"}
        ):
            return f"{arch}_teeth"
        if own_words & _MANDIBLE:
            return "lower_teeth" if own_words & _TEETH else "mandible"
        if own_words & _SKULL:
            return "skull"
    return ""


def camera_names(paths: Sequence[PurePath]) -> dict[PurePath, str]:
    """Return a unique name for each clip, made of the words in which its path differs from the other paths."""
    own_words = {path: words(path) for path in paths}
    shared = set.intersection(*(set(own) for own in own_words.values())) if len(own_words) > 1 else set()
    out: dict[PurePath, str] = {}
    for path, own in own_words.items():
        distinct = dict.fromkeys(word for word in own if word not in shared | _BOARD | _GENERIC)
        out[path] = "_".join(distinct) or "_".join(words(PurePath(path.name))) or "camera"
    stems = [PurePath(path.name).stem for path in paths]
    plain = [re.sub(r"[^A-Za-z0-9_\-]+", "_", re.sub(r"%0?\d*d", "", stem)).strip("_.-") for stem in stems]
    if len(set(out.values())) < len(paths) or any(len(name) > 40 for name in out.values()):
        out = {path: f"{name or 'cam'}_{number}" for number, (path, name) in enumerate(zip(paths, plain))}
    elif all(sorted(words(PurePath(name))) == sorted(words(PurePath(out[path]))) for path, name in zip(paths, plain)):
        out = dict(zip(paths, plain))  # same words: keep the spelling of the file name
    return out


def fitting(name: str, paths: Iterable[PurePath]) -> list[PurePath]:
    """Return the paths that contain all words of a name."""
    wanted = set(words(PurePath(name)))
    return [path for path in paths if wanted <= set(words(path))]


def pair(names: Mapping[PurePath, str], others: Sequence[PurePath]) -> tuple[dict[PurePath, PurePath], bool]:
    """Match files of one camera each to clips with camera names; also return whether names, not the order, match."""
    found: dict[PurePath, PurePath] = {}
    for clip, name in names.items():
        fits = fitting(name, others)
        if len(fits) == 1 and fits[0] not in found.values():
            found[clip] = fits[0]
    if names and not found and len(others) == len(names):
        return dict(zip(names, others)), False
    return found, True


def with_masks(cameras: Sequence[CameraSketch], masks: Mapping[PurePath, str]) -> list[CameraSketch]:
    """Return each camera with the masks whose paths contain the words of its name."""
    out = []
    for camera in cameras:
        own = fitting(camera.name, masks)
        rows = {row: [path for path in own if masks[path] == row] for row in ("upper", "lower")}
        out.append(replace(camera, masks={row: paths[0] for row, paths in rows.items() if len(paths) == 1}))
    return out
