"""Data for the reports of a build and of a solved performance, before rating and drawing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NotRequired

from typing_extensions import TypedDict

from jawusd.formats.experiments import Experiments
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.notes import SyncNotes
from jawusd.formats.tracks import Tracks


class BuildVerdict(TypedDict):
    """Verdict on a build: the worst grade of its stages, what to do, and the checks with that grade."""

    grade: str
    todo: NotRequired[list[str]]  # sentences, the most important first; absent in earlier builds
    because: list[str]


_USABLE = {
    "good": "Usable for animation.",
    "look": "Usable for animation.",
    "bad": "Not usable.",
    "open": "Not judged, for lack of data.",
}


def verdict_sentence(verdict: BuildVerdict) -> str:
    """Return a verdict and the most important thing to do, on one line."""
    return " ".join([_USABLE.get(verdict["grade"], "Not judged."), *verdict.get("todo", [])[:1]])


@dataclass(frozen=True)
class Origin:
    """Provenance of a build; strings are empty if not recorded."""

    finished: str  # date and time of the end of the build
    command: str  # the command line; "" if called from Python
    versions: Mapping[str, str]  # versions by package


@dataclass(frozen=True)
class CameraFacts:
    """Input of one camera."""

    name: str
    video: str  # file name of the footage, "" without any
    masks: str  # file names of the masks, "" without any
    size_px: tuple[int, int]  # (width, height) of the recorded images


@dataclass(frozen=True, eq=False)
class Overlay:
    """One frame of the footage with the tracked scans drawn over it, all cameras side by side."""

    frame: int  # frame of the reference camera
    reason: str  # why this frame was chosen
    jpeg: bytes  # the image, a JPEG file


@dataclass(frozen=True, eq=False)
class ContactPicture:
    """The tooth contacts in one pose, both arches side by side."""

    title: str
    clearance_mm: float
    jpeg: bytes  # the image, a JPEG file


@dataclass(frozen=True, eq=False)
class ReplayPart:
    """A mesh of the replay."""

    name: str  # display name
    kind: str  # "bone", "tooth" or "gum": determines the colour
    moves: bool  # whether it moves with the mandible
    mesh: Mesh  # decimated, anatomical frame, in occlusion [mm]


@dataclass(frozen=True)
class RigFacts:
    """Results of checking the rig files."""

    table_error_mm: float  # maximum vertex distance between the sampled decoder and the exact model [mm]
    findings: tuple[str, ...]  # findings of the validators, "severity: message"


@dataclass(frozen=True, eq=False)
class ReportData:
    """Data of the report of a build."""

    actor: str
    tracks: Tracks
    model: JawModel
    sync: SyncNotes
    cameras: tuple[CameraFacts, ...]  # empty if the capture is not available
    inferred: tuple[str, ...]  # values that were derived instead of given
    seconds: Mapping[str, float]  # duration of each stage [s]
    hashes: Mapping[str, str]  # SHA-256 of each file of the build, by file name
    origin: Origin
    rig: RigFacts
    experiments: Experiments | None  # the paper's experiments, None if they failed
    overlays: tuple[Overlay, ...]  # frames of the footage, the worst first
    parts: tuple[ReplayPart, ...]
    left_out: tuple[str, ...]  # parts omitted from the report, and why
    findings: tuple[Finding, ...] = ()  # findings of the check before the first stage
    contacts: tuple[ContactPicture, ...] = ()  # empty if contacts cannot be computed from the scans


@dataclass(frozen=True, eq=False)
class SolveReportData:
    """Data of the report of a solved performance."""

    shot: str
    tracks: Tracks  # tracks with `solved` arrays
    fps: float  # frames per second
    limits: str  # accuracy and limits of the result, in words; "" if unknown
    cameras: tuple[CameraFacts, ...]  # empty if the shot is not available
    overlays: tuple[Overlay, ...]  # frames of the shot, the worst first
    versions: Mapping[str, str]  # versions by package
    left_out: tuple[str, ...]  # parts omitted from the report, and why
