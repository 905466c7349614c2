"""Checks of individual files of a capture: scans, bones, clips, calibration, board clips."""

from __future__ import annotations

import filecmp
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.errors import JawusdError
from jawusd.formats.capture import CameraSource, Capture
from jawusd.formats.file_names import is_pattern
from jawusd.formats.finding import Finding, Severity
from jawusd.formats.mesh import Mesh
from jawusd.geometry import LANDMARKS, Camera
from jawusd.pipeline.calibrate import known_sync
from jawusd.pipeline.cameras import load_cameras, rescaled_cameras
from jawusd.pipeline.subject import BONES, MESHES, TEETH, label_teeth, subject_of_capture

if TYPE_CHECKING:
    from jawusd.media.checks import MaskSamples
    from jawusd.media.clip import Clip
    from jawusd.tracking.contour.scan import Scan


@dataclass
class Parts:
    """Parts of a capture loaded by the checks, empty if unreadable."""

    capture: Capture | None
    out: Path  # future folder of the rig
    allow_outside: bool
    open_files: ExitStack  # closes the masks
    meshes: dict[str, Mesh] = field(default_factory=dict)
    scans: tuple[Scan, ...] = ()  # upper and lower scan, if both are usable
    videos: dict[str, Clip] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    samples: dict[str, MaskSamples] = field(default_factory=dict)

    @property
    def description(self) -> str:
        """Return the path of capture.toml."""
        return str(self.given.file)

    @property
    def given(self) -> Capture:
        """Return the capture; raises ValueError if it could not be read."""
        if self.capture is None:
            raise ValueError("there is no capture")
        return self.capture

    def usable(self, path: Path) -> bool:
        """Return whether a file, or the folder of an image pattern, exists and lies in an allowed folder."""
        place = path.parent if is_pattern(path) else path
        try:
            inside = self.allow_outside or place.resolve().is_relative_to(self.given.folder)
            return inside and place.exists()
        except (OSError, ValueError, RuntimeError):
            return False

    def clip_read(self, camera: CameraSource) -> bool:
        """Return whether the clip of a camera could be opened; true if the camera has no clip."""
        return camera.video is None or camera.name in self.videos

    def offsets(self) -> Mapping[str, int] | None:
        """Return the frame offsets of the cameras if they are known without decoding clips, otherwise None."""
        found = known_sync(self.given)
        return None if found is None else found["offsets"]

    def offset_guesses(self) -> list[Mapping[str, int]]:
        """Return the frame offsets or, if unknown, two guesses: zero, and offsets that align the first masks."""
        if (known := self.offsets()) is not None:
            return [known]
        capture = self.given
        guesses: list[Mapping[str, int]] = [{camera.name: 0 for camera in capture.cameras}]
        first = {name: sample.first_frame for name, sample in self.samples.items()}
        begin = first.get(capture.reference)
        if begin is not None:
            guesses.append({name: begin - own for name, own in first.items() if own is not None})
        return guesses


def found_error(kind: str, error: JawusdError, camera: str | None = None) -> Finding:
    """Convert an exception to a finding, about a camera if given."""
    path, camera = error.path, camera or error.camera
    return Finding(kind, "error", error.message, path=path, camera=camera, frame=error.frame, hint=error.hint)


# Maximum median distance of crown vertices from their bone [mm]; larger distances indicate different coordinate frames.
_TEETH_TO_BONE_MM = 20.0
_CONDYLES_MM = (75.0, 140.0)  # plausible range of the distance between the condyle centres; about 100 mm in adults


def scans(parts: Parts) -> Iterator[Finding]:
    """Read every mesh; label and prepare the scans."""
    from jawusd.meshes.meshio import load_mesh
    from jawusd.tracking.contour.scan import ARCH_NAMES, prepare_scan

    given = parts.given.scans
    files = {name: path for name in MESHES if (path := getattr(given, name)) is not None and parts.usable(path)}
    for name, path in files.items():
        try:
            parts.meshes[name] = load_mesh(path, kind="bone" if name in BONES else "scan")
        except JawusdError as error:
            yield found_error("mesh", error)
    labelled = label_teeth(parts.meshes, files, given.labels)
    for arch, scan in labelled.items():
        parts.meshes[TEETH[arch]] = scan.mesh
        yield from scan.findings
    prepared = []
    for arch in ARCH_NAMES:
        mesh = parts.meshes.get(f"{arch}_teeth")
        if mesh is None:
            continue
        try:
            prepared.append(prepare_scan(mesh, arch))
        except JawusdError as error:
            yield found_error("scan", error)
    parts.scans = tuple(prepared) if len(prepared) == len(ARCH_NAMES) else ()


def occlusion(parts: Parts) -> Iterator[Finding]:
    """Check that the two scans are in occlusion."""
    from jawusd.tracking.initialization.scan_checks import occlusion_findings

    yield from occlusion_findings(parts.scans, parts.given.anatomy.T_anatomical_skull)[1]


def bone_findings(parts: Parts) -> Iterator[Finding]:
    """Check the positions of bones and landmarks relative to the teeth."""
    for bone, arch, scan in zip(BONES, ("lower", "upper"), reversed(parts.scans), strict=True):
        if bone not in parts.meshes:
            continue
        vertices = parts.meshes[bone].vertices
        apart = np.median([np.linalg.norm(vertices - point, axis=1).min() for point in scan.crown_vertices(300)])
        if apart > _TEETH_TO_BONE_MM:
            limit, path = _TEETH_TO_BONE_MM, getattr(parts.given.scans, bone)
            message = f"the {bone} is {apart:.0f} mm from the {arch} teeth; at most {limit:g} mm is plausible"
            hint = "Export it in the coordinate frame of the scans, in mm."
            yield Finding("bone_elsewhere", "warning", message, float(apart), limit, path=str(path), hint=hint)
    landmarks = dict(zip(LANDMARKS, subject_of_capture(parts.given, parts.meshes).landmarks, strict=True))
    width = float(np.linalg.norm(landmarks["condyle_left"] - landmarks["condyle_right"]))
    if not _CONDYLES_MM[0] <= width <= _CONDYLES_MM[1]:
        message = f"the condyles are {width:.0f} mm apart; {_CONDYLES_MM[0]:g} to {_CONDYLES_MM[1]:g} mm is plausible"
        limit = _CONDYLES_MM[width > _CONDYLES_MM[1]]
        hint = "Check the mandible mesh, or give the condyles in [anatomy.landmarks]."
        yield Finding("condyles", "warning", message, width, limit, path=parts.description, hint=hint)


def clips(parts: Parts) -> Iterator[Finding]:
    """Open and decode every clip; long clips are decoded only in parts."""
    from jawusd.media.checks import decoded_findings, rate_findings
    from jawusd.media.footage import open_clip

    for camera in parts.given.cameras:
        if camera.clip is None or not parts.usable(camera.clip.path):
            continue
        try:
            parts.videos[camera.name] = open_clip(camera.clip)
        except JawusdError as error:
            yield found_error("clip", error, camera.name)
    with ThreadPoolExecutor() as pool:
        for found in pool.map(lambda item: list(decoded_findings(item[1], item[0])), parts.videos.items()):
            yield from found
    yield from _copies({name: video.path for name, video in parts.videos.items()})
    yield from rate_findings(parts.videos, parts.given.fps, parts.description)


def _copies(clips: Mapping[str, Path]) -> Iterator[Finding]:
    """Report clips with identical contents: two cameras never record the same bytes, so one clip is a copy."""
    for one, other in combinations(clips, 2):
        paths = clips[one], clips[other]
        if not all(path.is_file() for path in paths) or not filecmp.cmp(*paths, shallow=False):
            continue
        message = f"its clip {paths[1].name} is identical to {paths[0].name}, the clip of camera {one}"
        hint = "Copy the clip of this camera again."
        yield Finding("clips_alike", "error", message, path=str(paths[1]), camera=other, hint=hint)


def calibration(parts: Parts) -> Iterator[Finding]:
    """Read and check the calibration."""
    from jawusd.capture.camera_checks import camera_findings

    capture = parts.given
    if capture.calibration is None:
        if capture.boards is None:
            message = 'has neither "calibration" nor [boards] to make one from'
            hint = "Specify a calibration file, or clips of a calibration board."
            yield Finding("no_calibration", "error", message, path=parts.description, hint=hint)
        return
    if not parts.usable(capture.calibration) or not all(parts.clip_read(camera) for camera in capture.cameras):
        return  # the recorded size of a camera is unknown if its clip was not read
    if len(capture.cameras) < 2:
        message = "has one camera; tracking in 3-D needs at least two"
        yield Finding("one_camera", "error", message, 1, 2, path=parts.description)
    parts.cameras = {camera.name: camera for camera in load_cameras(capture)}
    yield from camera_findings(list(parts.cameras.values()), str(capture.calibration))
    yield from _rescaled(parts)


def _rescaled(parts: Parts) -> Iterator[Finding]:
    """Report calibrations whose image size differs from the recorded size; likely a mistake if only some differ."""
    found = rescaled_cameras(parts.given)
    for name, (was, now) in found.items():
        every = len(found) == len(parts.cameras)
        message = f"calibrated at {was[0]} x {was[1]} px, but its images or masks have {now[0]} x {now[1]} "
        message += "px; assumed to be scaled, not cropped" + ("" if every else "; the sizes of the other cameras match")
        hint = "Check that its masks were not drawn at a reduced size; picks refer to the pixels of the calibration."
        severity: Severity = "note" if every else "warning"
        yield Finding("calibration_rescaled", severity, message, camera=name, hint=hint)


def boards(parts: Parts) -> Iterator[Finding]:
    """Open the board clips if the cameras must be calibrated from them."""
    from jawusd.media.checks import decoded_findings
    from jawusd.media.footage import open_clip

    capture = parts.given
    if capture.boards is None or capture.calibration is not None:
        return
    for path, camera in zip(capture.boards.videos, capture.cameras, strict=True):
        if not parts.usable(path):
            continue
        try:
            video = open_clip(path)
        except JawusdError as error:
            yield found_error("board_clip", error, camera.name)
            continue
        yield from decoded_findings(video, camera.name)
        own = parts.videos.get(camera.name)
        if own is not None and abs(video.size_px[0] * own.size_px[1] / own.size_px[0] - video.size_px[1]) > 1.0:
            message = f"its board clip ({video.size_px[0]} x {video.size_px[1]} px) and its video ({own.size_px[0]} x "
            message += f"{own.size_px[1]} px) have different aspect ratios"
            hint = "Record the boards in the recording mode of the take."
            yield Finding("board_shape", "error", message, path=str(path), camera=camera.name, hint=hint)
