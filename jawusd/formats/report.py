"""Data of the reports of a build and of a solved performance, before rating and drawing."""

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
    """Verdict on a build: the worst grade of the stages, what to do, and the checks with this grade."""

    grade: str
    todo: NotRequired[list[str]]  # sentences on what to do, the most important first
    because: list[str]


_USABLE = {
    "good": "Usable for animation.",
    "look": "Usable for animation.",
    "bad": "Not usable.",
    "open": "Not judged, for lack of data.",
}


def verdict_sentence(verdict: BuildVerdict) -> str:
    """Return the verdict and the most important thing to do, on one line."""
    return " ".join([_USABLE.get(verdict["grade"], "Not judged."), *verdict.get("todo", [])[:1]])


@dataclass(frozen=True)
class Origin:
    """Provenance of a build; strings are empty if not recorded."""

    finished: str  # date and time at which the build ended
    command: str  # command line; "" if the build was called from Python
    versions: Mapping[str, str]  # versions by package


@dataclass(frozen=True)
class CameraFacts:
    """Input files and image size of one camera."""

    name: str
    video: str  # File name of the footage, "" if there is none.
    masks: str  # File names of the masks, "" if there are none.
    size_px: tuple[int, int]  # (width, height) of the recorded images


@dataclass(frozen=True, eq=False)
class Overlay:
    """Image of one frame of all cameras side by side, with the tracked scans drawn over the footage."""

    frame: int  # frame number of the reference camera
    reason: str  # Reason why this frame was chosen.
    jpeg: bytes  # Content of a JPEG file.


@dataclass(frozen=True, eq=False)
class ContactPicture:
    """Image of the tooth contacts in one pose, both arches side by side."""

    title: str
    clearance_mm: float
    jpeg: bytes  # Content of a JPEG file.


@dataclass(frozen=True, eq=False)
class ReplayPart:
    """Mesh that is shown in the replay of a report."""

    name: str  # Display name of the mesh.
    kind: str  # "bone", "tooth" or "gum", which determines the colour.
    moves: bool  # whether the mesh moves with the mandible
    mesh: Mesh  # decimated mesh in the anatomical frame, in occlusion [mm]


@dataclass(frozen=True)
class RigFacts:
    """Results of checking the rig files."""

    table_error_mm: float  # maximum vertex distance [mm] between the sampled decoder and the exact model
    findings: tuple[str, ...]  # findings of the validators, each as "severity: message"


@dataclass(frozen=True, eq=False)
class ReportData:
    """Data of the report of a build."""

    actor: str
    tracks: Tracks
    model: JawModel
    sync: SyncNotes
    cameras: tuple[CameraFacts, ...]  # inputs of the cameras; empty if the capture is not available
    inferred: tuple[str, ...]  # descriptions of values that were derived instead of given
    seconds: Mapping[str, float]  # duration of each stage [s]
    hashes: Mapping[str, str]  # SHA-256 of each file of the build, by file name
    origin: Origin
    rig: RigFacts
    experiments: Experiments | None  # results of the paper's experiments, None if they failed
    overlays: tuple[Overlay, ...]  # images of footage frames, the worst frame first
    parts: tuple[ReplayPart, ...]
    left_out: tuple[str, ...]  # parts that the report omits, with reasons
    findings: tuple[Finding, ...] = ()  # findings of the check before the first stage
    # Images of tooth contacts; empty if contacts cannot be computed from the scans.
    contacts: tuple[ContactPicture, ...] = ()


@dataclass(frozen=True, eq=False)
class SolveReportData:
    """Data of the report of a solved performance."""

    shot: str
    tracks: Tracks  # tracks with `solved` arrays
    fps: float  # frame rate [Hz]
    limits: str  # text on the accuracy and limits of the result; "" if unknown
    cameras: tuple[CameraFacts, ...]  # inputs of the cameras; empty if the shot is not available
    overlays: tuple[Overlay, ...]  # images of frames of the shot, the worst frame first
    versions: Mapping[str, str]  # versions by package
    left_out: tuple[str, ...]  # parts that the report omits, with reasons
