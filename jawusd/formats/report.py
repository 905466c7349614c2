"""What the report of a build, or of a solved performance, shows: gathered, but not yet rated or drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jawusd.formats.experiments import Experiments
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.notes import SyncNotes
from jawusd.formats.tracks import Tracks


@dataclass(frozen=True)
class Origin:
    """Say how a build was made; empty where that is not recorded."""

    finished: str  # date and time
    command: str  # the command line; "" also where a program called the build
    versions: Mapping[str, str]  # by package


@dataclass(frozen=True)
class CameraFacts:
    """Describe the input of one camera."""

    name: str
    video: str  # file name of the footage, "" without any
    masks: str  # file names of the masks, "" without any
    size_px: tuple[int, int]  # (width, height) of the recorded pictures


@dataclass(frozen=True, eq=False)
class Overlay:
    """Hold one frame of the footage with the tracked scans drawn over it, all cameras side by side."""

    frame: int  # of the reference camera
    reason: str  # why this frame is shown
    jpeg: bytes  # the picture, a JPEG file


@dataclass(frozen=True, eq=False)
class ContactPicture:
    """Hold the contacts of the teeth in one pose, both arches side by side."""

    title: str
    clearance_mm: float
    jpeg: bytes  # the picture, a JPEG file


@dataclass(frozen=True, eq=False)
class ReplayPart:
    """Hold a mesh of the replay."""

    name: str  # shown to people
    kind: str  # "bone", "tooth" or "gum": how it is coloured
    moves: bool  # it belongs to the mandible
    mesh: Mesh  # decimated, anatomical frame, at the closed bite [mm]


@dataclass(frozen=True)
class RigFacts:
    """Hold the checks of the rig files."""

    table_error_mm: float  # largest vertex distance of the sampled decoder to the exact model [mm]
    findings: tuple[str, ...]  # of the validators, "severity: message"; empty when all is well


@dataclass(frozen=True, eq=False)
class ReportData:
    """Hold what the report shows."""

    actor: str
    tracks: Tracks
    model: JawModel
    sync: SyncNotes
    cameras: tuple[CameraFacts, ...]  # empty where the capture is not at hand
    inferred: tuple[str, ...]  # what was derived instead of being given
    seconds: Mapping[str, float]  # per stage [s]
    hashes: Mapping[str, str]  # SHA-256 by file name of the build
    origin: Origin
    rig: RigFacts
    experiments: Experiments | None  # the paper's experiments, None if they could not be done
    overlays: tuple[Overlay, ...]  # frames of the footage, the worst first
    parts: tuple[ReplayPart, ...]
    left_out: tuple[str, ...]  # what the report does not show, and why
    findings: tuple[Finding, ...] = ()  # of the check before the first stage
    contacts: tuple[ContactPicture, ...] = ()  # of the teeth; empty where the scans do not show them


@dataclass(frozen=True, eq=False)
class SolveReportData:
    """Hold what the report of a solved performance shows."""

    shot: str
    tracks: Tracks  # with `solved`
    fps: float  # frames per second
    limits: str  # what the result is worth, in words; "" where it is not known
    cameras: tuple[CameraFacts, ...]  # empty where the shot is not at hand
    overlays: tuple[Overlay, ...]  # frames of the shot, the worst first
    versions: Mapping[str, str]  # by package
    left_out: tuple[str, ...]  # what the report does not show, and why
