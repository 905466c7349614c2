"""What the report of a build shows: everything gathered, nothing judged or drawn yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from jawusd.formats.experiments import Experiments
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import Tracks


@dataclass(frozen=True)
class CameraFacts:
    """Say what one camera gave.

    Attributes:
        name: of the camera.
        video: file name of the footage, "" without any.
        masks: file names of the masks, "" without any.
        size_px: (width, height) of the recorded pictures.
    """

    name: str
    video: str
    masks: str
    size_px: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Overlay:
    """Hold one frame of the footage with the tracked scans drawn over it, all cameras side by side.

    Attributes:
        frame: of the reference camera.
        reason: why this frame is shown.
        jpeg: the picture, a JPEG file.
    """

    frame: int
    reason: str
    jpeg: bytes


@dataclass(frozen=True, eq=False)
class ReplayPart:
    """Hold a mesh of the replay.

    Attributes:
        name: for people.
        kind: "bone", "tooth" or "gum": how it is coloured.
        moves: it belongs to the mandible.
        mesh: decimated, anatomical frame, at the closed bite [mm].
    """

    name: str
    kind: str
    moves: bool
    mesh: Mesh


@dataclass(frozen=True)
class RigFacts:
    """Say what was found out about the rig files.

    Attributes:
        table_error_mm: largest vertex distance of the sampled decoder to the exact model [mm].
        findings: what the validators say, "severity: message"; empty when all is well.
    """

    table_error_mm: float
    findings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ReportData:
    """Hold what the report shows.

    Attributes:
        actor: whose jaw.
        tracks: the final tracks.
        model: the fitted model.
        sync: result of the sync stage: `offsets`, `method` and what it says of its confidence.
        cameras: empty where the capture is not at hand.
        inferred: what was derived instead of being given.
        seconds: per stage [s].
        hashes: SHA-256 by file name of the build.
        versions: by package.
        rig: what was found out about the rig files.
        experiments: the paper's experiments, None if they could not be done.
        overlays: frames of the footage, the worst first.
        parts: meshes of the replay.
        left_out: what the report does not show, and why.
    """

    actor: str
    tracks: Tracks
    model: JawModel
    sync: Mapping[str, object]
    cameras: tuple[CameraFacts, ...]
    inferred: tuple[str, ...]
    seconds: Mapping[str, float]
    hashes: Mapping[str, str]
    versions: Mapping[str, str]
    rig: RigFacts
    experiments: Experiments | None
    overlays: tuple[Overlay, ...]
    parts: tuple[ReplayPart, ...]
    left_out: tuple[str, ...]
