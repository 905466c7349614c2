"""Cameras and footage of a capture: calibrations from any program, scaled to the recorded image size, and clips."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from jawusd.base.errors import CalibrationError, CaptureError, FormatError, OutputError, explain_missing_packages
from jawusd.cameras.calibration import save_calibration
from jawusd.cameras.colmap import save_colmap
from jawusd.cameras.files import lacks_sizes, load_cameras_file, plain_name
from jawusd.formats.capture import CameraSource, Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera
from jawusd.pipeline.subject import load_meshes

if TYPE_CHECKING:
    from jawusd.media.clip import Clip
    from jawusd.media.overlay import Backdrop
    from jawusd.segmentation.picture import ColourFootage


Size = tuple[int, int]
_FOOTAGE_HINT = "Specify the footage there (video = ...)."
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz", ".abc")


def read_calibration(path: Path, unit_mm: float, sizes: Callable[[], Mapping[str, Size]]) -> list[Camera]:
    """Read cameras from any supported file, including OpenUSD stages; the returned lengths are in mm.

    Args:
        unit_mm: the file's unit of length [mm]; ignored for stages, which state their own unit.
        sizes: returns the image size (width, height) [px] of each camera; used if the file does not state it.

    Raises:
        CalibrationError, FormatError, RigError: the file contains no valid cameras.
    """
    if path.suffix.lower() in USD_SUFFIXES:
        from jawusd.rig.cameras import read_cameras

        return read_cameras(path, sizes)
    return load_cameras_file(path, unit_mm, sizes() if lacks_sizes(path) else None)


class SameSize(dict[str, Size]):
    """A mapping that returns the same image size for every camera name."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        self._size = size

    def __contains__(self, name: object) -> bool:
        return True

    def __missing__(self, name: str) -> Size:
        return self._size


def convert_cameras(source: Path, out: Path, unit_mm: float, size: Size | None) -> tuple[list[Camera], list[Path]]:
    """Read cameras and write them in mm, to .toml (aniposelib), .usda (OpenUSD) or a folder (COLMAP).

    Args:
        source: a camera file as for `cameras.files.load_cameras_file`, or a stage.
        unit_mm: the source's unit of length [mm].
        size: (width, height) [px] of the images, for formats that do not state it.

    Raises:
        CalibrationError, FormatError, RigError: the source has no valid cameras, or the output cannot represent them.
        OutputError: the file cannot be written, or has an unsupported suffix.
    """
    cameras = read_calibration(source, unit_mm, lambda: {} if size is None else SameSize(size))
    suffix = out.suffix.lower()
    if suffix == ".toml":
        save_calibration(out, cameras)
        return cameras, [out]
    if suffix in USD_SUFFIXES[:3]:
        from jawusd.rig.cameras import write_camera_stage

        return cameras, [write_camera_stage(out, cameras)]
    if suffix:
        hint = "Give a .toml (aniposelib), a .usda, or a folder (COLMAP)."
        raise OutputError(f'cannot write "{suffix}" files.', path=out, hint=hint)
    return cameras, save_colmap(out, cameras)


@explain_missing_packages()
def load_cameras(capture: Capture) -> list[Camera]:
    """Return the calibrated cameras in the capture's order, scaled to the recorded image size.

    A calibration at a different image size of the same aspect ratio is scaled; see `rescaled_cameras`.

    Raises:
        CalibrationError: there is no calibration, it lacks a camera of the capture, or its aspect ratio differs from
            that of the images.
        CaptureError: a video or mask cannot be read.
    """
    return [_at_recorded_size(camera, capture, source) for camera, source in _calibrated(capture)]


def rescaled_cameras(capture: Capture) -> dict[str, tuple[Size, Size]]:
    """Return, by name, the calibrated and the recorded size [px] where they differ; raises like `load_cameras`."""
    pairs = zip(_calibrated(capture), load_cameras(capture), strict=True)
    sizes = {camera.name: (_size(camera), _size(recorded)) for (camera, _), recorded in pairs}
    return {name: (was, now) for name, (was, now) in sizes.items() if was != now}


def _size(camera: Camera) -> Size:
    width, height = camera.size_px
    return int(width), int(height)


def tracked_cameras(cameras: Sequence[Camera], tracks: Tracks) -> list[Camera]:
    """Return the calibrated cameras with the corrections estimated in tracking; tracked poses refer to them."""
    from jawusd.tracking.sequence.extrinsics import corrected_cameras

    return corrected_cameras(cameras, tracks.meta)


def _calibrated(capture: Capture) -> list[tuple[Camera, CameraSource]]:
    """Return the cameras as calibrated, each with its entry in the capture."""
    if capture.calibration is None:
        hint = "Specify a calibration file there; `jawusd calibrate` makes one from [boards]."
        raise CalibrationError('has no "calibration".', path=capture.file, hint=hint)
    found = read_calibration(capture.calibration, capture.calibration_unit_mm, lambda: _recorded_sizes(capture))
    # Camera names of other programs may contain dots; names in a capture must not.
    plain = {plain_name(camera.name): camera for camera in found}
    known = (plain if len(plain) == len(found) else {}) | {camera.name: camera for camera in found}
    missing = [source.name for source in capture.cameras if source.name not in known]
    if missing:
        raise CalibrationError(
            f"lacks camera {missing[0]} of the capture; it contains {', '.join(camera.name for camera in found)}.",
            path=capture.calibration,
        )
    return [(replace(known[source.name], name=source.name), source) for source in capture.cameras]


def _recorded_sizes(capture: Capture) -> dict[str, Size]:
    from jawusd.media.footage import open_clip

    return {camera.name: open_clip(camera.clip).size_px for camera in capture.cameras if camera.clip is not None}


def _at_recorded_size(camera: Camera, capture: Capture, source: CameraSource) -> Camera:
    from jawusd.media.footage import open_clip
    from jawusd.media.masks import mask_size_px

    aspect = 1.0
    if source.clip is not None:
        opened = open_clip(source.clip)
        recorded, aspect, path = opened.size_px, opened.pixel_aspect, opened.path
    elif source.masks is not None:
        path = source.masks.upper
        recorded = mask_size_px(path)
    else:
        return camera
    width, height = _size(camera)
    if tuple(recorded) == (width, height):
        return camera
    # One pixel of tolerance allows for a rounded height after scaling. Anamorphic images are stored narrower than
    # displayed (DV: wider), and may be calibrated as stored or as displayed.
    if min(abs(recorded[0] * share * height / width - recorded[1]) for share in (1.0, aspect)) > 1.0:
        raise CalibrationError(
            f"calibrated for images of {width} x {height} px, but {path.name} has "
            f"{recorded[0]} x {recorded[1]} px: the aspect ratios differ.",
            camera=camera.name,
            path=capture.calibration,
            hint="Calibrate in the recording mode of the take: sizes alone do not show how the images are cropped.",
        )
    return camera.scaled(recorded)


@explain_missing_packages()
def open_videos(capture: Capture) -> dict[str, Clip]:
    """Return the videos of a capture by the names of their cameras.

    Raises CaptureError if no camera has a video, or if one cannot be decoded.
    """
    from jawusd.media.footage import open_clip

    clips = {source.name: source.clip for source in capture.cameras if source.clip}
    if not clips:
        raise CaptureError("no camera has a video.", path=capture.file, hint=_FOOTAGE_HINT)
    return {name: open_clip(clip) for name, clip in clips.items()}


def open_footage(capture: Capture, tracks: Tracks | None = None) -> tuple[dict[str, Camera], dict[str, Clip]]:
    """Return the calibrated cameras, corrected as in tracks if these are given, and the videos, by camera name.

    Raises like `load_cameras` and `open_videos`.
    """
    cameras = load_cameras(capture)
    placed = cameras if tracks is None else tracked_cameras(cameras, tracks)
    return {camera.name: camera for camera in placed}, open_videos(capture)


def open_colour_footage(
    capture: Capture, offsets: Mapping[str, int], work: str | None = None
) -> tuple[dict[str, Camera], ColourFootage]:
    """Return the calibrated cameras of a capture that have a video, by name, and their images.

    Frame k of a camera is simultaneous with frame k + offset of the reference camera. Raises like `open_footage`, and
    CaptureError if the task named `work` has fewer than two cameras with a video.
    """
    from jawusd.segmentation.picture import ColourFootage

    cameras, videos = open_footage(capture)
    if work is not None and len(videos) < 2:
        message = f"{len(videos)} of {len(capture.cameras)} cameras have a video; {work} needs at least two."
        raise CaptureError(message, path=capture.file)
    return {name: camera for name, camera in cameras.items() if name in videos}, ColourFootage(videos, offsets)


@explain_missing_packages()
def open_backdrops(capture: Capture, offsets: Mapping[str, int]) -> dict[str, Backdrop]:
    """Return, by camera, the images over which scans are drawn: footage or, without footage, masks.

    Raises CaptureError if no camera has either, or if one cannot be decoded.
    """
    from jawusd.media.overlay import Backdrop

    sources = [source for source in capture.cameras if source.video or source.masks]
    if not sources:
        raise CaptureError("no camera has a video or masks to draw over.", path=capture.file, hint=_FOOTAGE_HINT)
    return {source.name: Backdrop(source, offsets[source.name]) for source in sources}


def check_same_cameras(capture: Capture, tracks: Tracks) -> None:
    """Raise FormatError if a capture lacks a camera that the tracks use."""
    names = [camera.name for camera in capture.cameras]
    if not set(tracks.camera_names) <= set(names):
        raise FormatError(
            f"the tracks use the cameras {', '.join(tracks.camera_names)}; the capture has {', '.join(names)}."
        )


def tracked_scans(capture: Capture, tracks: Tracks) -> tuple[Mesh, Mesh]:
    """Return the upper and the lower scan [mm] in the registration of the tracks; raises like `load_meshes`."""
    meshes = load_meshes(capture, tracks.meta)
    return meshes["upper_teeth"], meshes["lower_teeth"]
