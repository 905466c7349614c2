"""Load the cameras of a capture, at the size its pictures were recorded in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from jawusd.base.errors import CalibrationError, explain_missing_packages
from jawusd.cameras.parts import plain_name
from jawusd.formats.capture import CameraSource, Capture
from jawusd.formats.tracks import Tracks
from jawusd.geometry import Camera
from jawusd.pipeline.camera_convert import read_calibration

Size = tuple[int, int]


@explain_missing_packages()
def load_cameras(capture: Capture) -> list[Camera]:
    """Return the calibrated cameras in the capture's order, at the size the pictures were recorded in.

    A calibration made at another size of the same shape is scaled; `rescaled_cameras` says of which cameras.

    Raises:
        CalibrationError: there is no calibration, it does not know a camera of the capture, or the pictures have
            another shape than those it was made from.
        CaptureError: a video or mask cannot be read.
    """
    return [_at_recorded_size(camera, capture, source) for camera, source in _calibrated(capture)]


def rescaled_cameras(capture: Capture) -> dict[str, tuple[Size, Size]]:
    """Return the sizes (width, height) [px] calibrated and recorded, by the name of each camera where they differ.

    Raises:
        CalibrationError, CaptureError: as `load_cameras`.
    """
    sizes = {
        camera.name: (_size(camera), _size(recorded))
        for (camera, _), recorded in zip(_calibrated(capture), load_cameras(capture), strict=True)
    }
    return {name: (was, now) for name, (was, now) in sizes.items() if was != now}


def _size(camera: Camera) -> Size:
    width, height = camera.size_px
    return int(width), int(height)


def tracked_cameras(cameras: Sequence[Camera], tracks: Tracks) -> list[Camera]:
    """Return the cameras that the poses of tracks belong to: the calibrated ones with the take's own corrections."""
    from jawusd.tracking.sequence.extrinsics import corrected_cameras

    return corrected_cameras(cameras, tracks.meta)


def _calibrated(capture: Capture) -> list[tuple[Camera, CameraSource]]:
    """Return the cameras as calibrated, each with its source."""
    if capture.calibration is None:
        raise CalibrationError(
            'has no "calibration".',
            path=capture.folder / "capture.toml",
            hint="Name a calibration file there; jawusd calibrate makes one from [boards].",
        )
    found = read_calibration(capture.calibration, capture.calibration_unit_mm, lambda: _recorded_sizes(capture))
    # names of a capture have no dots; calibrations of other programs may
    plain = {plain_name(camera.name): camera for camera in found}
    known = (plain if len(plain) == len(found) else {}) | {camera.name: camera for camera in found}
    missing = [source.name for source in capture.cameras if source.name not in known]
    if missing:
        raise CalibrationError(
            f"does not know camera {missing[0]} of the capture; it names {', '.join(camera.name for camera in found)}.",
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
    # One pixel is what rounding of a scaled height makes.
    # An anamorphic picture is stored narrower (or, as DV, wider) than it is shown, and may be calibrated either way.
    if min(abs(recorded[0] * share * height / width - recorded[1]) for share in (1.0, aspect)) > 1.0:
        raise CalibrationError(
            f"calibrated for pictures of {width} x {height} px, but {path.name} has "
            f"{recorded[0]} x {recorded[1]} px, another shape.",
            camera=camera.name,
            path=capture.calibration,
            hint="Calibrate in the recording's own mode: a crop cannot be told from the sizes alone.",
        )
    return camera.scaled(recorded)
