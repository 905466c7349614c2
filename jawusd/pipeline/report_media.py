"""Pictures and meshes of the report: the frames that fit worst, and the jaw small enough for a page."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from jawusd.errors import FormatError
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.report import Overlay, ReplayPart
from jawusd.formats.tracks import Tracks
from jawusd.geometry import transform_points
from jawusd.pipeline.overlay import open_footage
from jawusd.pipeline.prepare import load_meshes, tracked_cameras

_UNCOVERED, _UNSURE = 3, 2  # frames shown for either reason; one typical frame is added, to compare with
_APART_S = 0.5  # neighbours show the same trouble
_MOST_CAMERAS = 4
_TILE_PX = (400, 225)
_QUALITY = 82
_MOST_FACES = 6000  # per mesh


def draw_worst_frames(capture: Capture, offsets: dict[str, int], tracks: Tracks) -> tuple[Overlay, ...]:
    """Draw the scans over the footage where they fit it worst, and once where they fit as usual.

    Args:
        capture: gives footage, calibration and scans.
        offsets: frame offset by camera.
        tracks: the poses to draw.

    Returns:
        Pictures, the worst first.

    Raises:
        CaptureError: no camera has a video, or one cannot be decoded.
        CalibrationError: a video has another shape than its camera's calibration.
        FormatError: the tracks are of another capture.
    """
    from jawusd.imaging.overlay import encode_jpeg, tracking_sheet

    if list(tracks.camera_names) != [camera.name for camera in capture.cameras]:
        raise FormatError(f"the capture has other cameras than the tracks ({', '.join(tracks.camera_names)}).")
    cameras, videos = open_footage(capture)
    shown = [name for name in videos][:_MOST_CAMERAS]
    placed = tracked_cameras([cameras[name] for name in shown], tracks)
    meshes = load_meshes(capture)
    found = []
    for row, reason in chosen_frames(tracks, capture.fps):
        frame = int(tracks.frames[row])
        scans = meshes["upper_teeth"], meshes["lower_teeth"]
        sheet = tracking_sheet(tracks, [frame], placed, videos, offsets, *scans, tile_px=_TILE_PX)
        found.append(Overlay(frame, reason, encode_jpeg(sheet, _QUALITY)))
    return tuple(found)


def chosen_frames(tracks: Tracks, fps: float) -> list[tuple[int, str]]:
    """Return rows of the tracks to look at, each with the reason, the worst first.

    Args:
        tracks: the take.
        fps: frames per second.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without any mask
        uncovered = np.nanmean(tracks.coverage_error, axis=(1, 2))
    sigma = tracks.sigma_mm.max(axis=1)
    tracked = tracks.tracked()
    uncovered, sigma = (np.where(tracked, value, np.nan) for value in (uncovered, sigma))
    apart = max(round(_APART_S * fps), 1)
    found: list[tuple[int, str]] = []
    for values, count, words in (
        (100 * uncovered, _UNCOVERED, "{:.2f} % of the masks left uncovered"),
        (sigma, _UNSURE, "expected error of {:.2f} mm at the worst landmark"),
    ):
        taken = 0
        for row in np.argsort(-np.nan_to_num(values, nan=-np.inf)):
            if taken == count or not np.isfinite(values[row]):
                break
            if all(abs(int(tracks.frames[row] - tracks.frames[other])) >= apart for other, _ in found):
                found.append((int(row), words.format(values[row])))
                taken += 1
    known = np.flatnonzero(np.isfinite(uncovered))
    if len(known):
        usual = known[np.argsort(uncovered[known])[len(known) // 2]]
        found.append((int(usual), f"a usual one, {100 * uncovered[usual]:.2f} % of the masks left uncovered"))
    return found


def replay_parts(folder: Path, model: JawModel) -> tuple[ReplayPart, ...]:
    """Return the meshes of a rig thinned for the page, anatomical frame, in the closed bite.

    Args:
        folder: of the rig.
        model: gives the anatomical frame and the closed bite.

    Raises:
        RigError: there is no geometry.
    """
    from jawusd.rig.geo import read_geometry, read_gum

    path = folder / "geo.usdc"
    meshes, gums = read_geometry(path), read_gum(path)
    A, rest = model.arrays["T_anatomical_skull"], model.arrays["T_rest"]
    found = []
    for name, mesh in meshes.items():
        moves = name in ("mandible", "lower_teeth")
        place = A @ rest if moves else A
        gum = gums.get(name, np.zeros(len(mesh.faces), bool))
        kind = "tooth" if name.endswith("teeth") else "bone"
        for part, faces in ((kind, mesh.faces[~gum]), ("gum", mesh.faces[gum])):
            if len(faces):
                small = _small(Mesh(mesh.vertices, faces))
                placed = Mesh(transform_points(place, small.vertices), small.faces)
                found.append(ReplayPart(name, part, moves, placed))
    return tuple(found)


def _small(mesh: Mesh) -> Mesh:
    from jawusd.imaging.decimation import decimated

    count = min(_MOST_FACES, len(mesh.faces))
    return Mesh(*decimated(mesh.vertices, mesh.faces, count))
