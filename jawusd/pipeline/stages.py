"""Each stage as one function from objects to objects; `build` strings them together and keeps the record."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jawusd.errors import FormatError, JawusdError, explain_missing_packages
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.mesh import Mesh
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import Tracks, load_tracks
from jawusd.pipeline.made_masks import tracking_config
from jawusd.pipeline.prepare import BONES, find_anatomy, load_cameras, load_meshes, rescaled_cameras, tracked_cameras
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import Subject, subject_of_capture
from jawusd.pipeline.trajectories import TrajectoryOptions, read_trajectory

Motion = Tracks | tuple[np.ndarray, np.ndarray]


@explain_missing_packages()
def sync_cameras(capture: Capture, progress: Progress) -> dict:
    """Return the frame offset of every camera to the reference camera.

    Args:
        capture: the capture.
        progress: told of the work.

    Returns:
        `offsets` by camera name [frames], `method`, and what the method says of its confidence.

    Raises:
        SyncError: no flash was found, or the flashes of two cameras do not match.
    """
    progress("sync", 0, 1)
    if capture.sync.offsets is not None:
        result = {"offsets": dict(capture.sync.offsets), "method": "given in the capture"}
    elif len(capture.cameras) == 1 or any(camera.video is None for camera in capture.cameras):
        # Masks alone carry no flash; numbered alike they are taken as simultaneous, and the report says so.
        result = {"offsets": {camera.name: 0 for camera in capture.cameras}, "method": "taken as simultaneous"}
    else:
        with about(capture.folder / "capture.toml"):
            from jawusd.capture.sync import estimate_offsets

            result = alignment_result(estimate_offsets(capture))
    progress("sync", 1, 1)
    return result


@explain_missing_packages()
def sync_videos(videos: Mapping[str, Path], reference: str, progress: Progress) -> dict:
    """Return the frame offset of every clip to the reference, as `sync_cameras` does for a capture.

    Args:
        videos: clips by the names of their cameras.
        reference: the camera that the others are aligned with.
        progress: told of the work.

    Raises:
        SyncError, CaptureError: see `capture.sync.align_videos`.
    """
    from jawusd.capture.sync import align_videos

    progress("sync", 0, 1)
    result = alignment_result(align_videos(videos, reference))
    progress("sync", 1, 1)
    return result


def alignment_result(alignment: Any) -> dict:
    """Return a `capture.sync.Alignment` as plain data.

    Args:
        alignment: of `capture.sync`, which is not imported here.
    """
    found = alignment.cameras
    return {
        "offsets": alignment.offsets,
        "reference": alignment.reference,
        "method": alignment.method,
        "exact_frames": {name: offset.exact_frames for name, offset in found.items()},
        "confidence": alignment.confidence,
        "notes": list(alignment.notes),
    }


@explain_missing_packages()
def track_teeth(
    capture: Capture,
    offsets: dict[str, int],
    jobs: int,
    progress: Progress,
    solver: str = "contour",
    backend: str = "cpu",
) -> Tracks:
    """Track both rows of teeth.

    Args:
        capture: the capture.
        offsets: frame offset by camera.
        jobs: threads.
        progress: told of every frame.
        solver: "contour", or "paper" for the paper's own method, to compare with.
        backend: where the paper's method draws, "cpu" or "gl".

    Raises:
        CaptureError, TrackingError: see `tracking.track_capture` and `tracking.paper.take`.
        MissingDependencyError: the GL backend has no OpenGL to work with.
    """
    with about(capture.folder / "capture.toml"):
        tracks = _track(capture, offsets, jobs, progress, solver, backend)
    tracks.meta["calibration_rescaled_px"] = rescaled_cameras(capture)
    return tracks


@contextlib.contextmanager
def about(path: Path) -> Iterator[None]:
    """Name a file in errors of stages that know only its content.

    Args:
        path: the file named.
    """
    try:
        yield
    except JawusdError as error:
        if error.path is None:
            error.path = str(path)
        raise


def _track(
    capture: Capture, offsets: dict[str, int], jobs: int, progress: Progress, solver: str, backend: str
) -> Tracks:
    cameras, meshes = load_cameras(capture), load_meshes(capture)
    if solver == "paper":
        from jawusd.tracking.paper.take import track_capture_paper

        return track_capture_paper(
            capture,
            cameras,
            offsets,
            meshes["upper_teeth"],
            meshes["lower_teeth"],
            backend=backend,
            threads=jobs,
            progress=lambda done, total: progress("track", done, total),
        )
    from jawusd.tracking import track_capture

    anatomy = find_anatomy(capture, meshes)
    return track_capture(
        capture,
        cameras,
        offsets,
        meshes["upper_teeth"],
        meshes["lower_teeth"],
        anatomy.landmarks,
        tracking_config(capture),
        threads=jobs,
        progress=lambda done, total: progress("track", done, total),
    )


@explain_missing_packages()
def aid_teeth(
    capture: Capture, offsets: dict[str, int], tracks: Tracks, model: JawModel, jobs: int, progress: Progress
) -> Tracks:
    """Track the hard frames again with the fitted model as a prior.

    Args:
        capture: the capture.
        offsets: frame offset by camera.
        tracks: the first pass.
        model: the model fitted to it.
        jobs: threads.
        progress: told of every frame.

    Raises:
        CaptureError: a mask cannot be read.
    """
    from jawusd.tracking.sequence.model_refinement import refine_tracks

    with about(capture.folder / "capture.toml"):
        meshes = load_meshes(capture)
        return refine_tracks(
            tracks,
            JawRig(model.arrays, model.meta),
            capture,
            load_cameras(capture),
            offsets,
            meshes["upper_teeth"],
            meshes["lower_teeth"],
            tracking_config(capture),
            threads=jobs,
            progress=lambda done, total: progress("aid", done, total),
        )


def read_motion(path: str | os.PathLike[str], options: TrajectoryOptions | None = None) -> Motion:
    """Read tracks, or poses from elsewhere.

    Args:
        path: tracks.npz, a CSV or JSON table, or HDF5 of jaw-tracking-system.
        options: how a file from elsewhere is written; not for tracks.

    Returns:
        `Tracks` of an npz file; of any other file frame numbers (F,) and T_skull_mandible (F, 4, 4).

    Raises:
        FormatError: not such a file, or options given for tracks.
        MissingDependencyError: HDF5 without h5py.
    """
    if Path(path).suffix != ".npz":
        return read_trajectory(path, options or TrajectoryOptions())
    if options not in (None, TrajectoryOptions()):
        raise FormatError("are tracks; columns, units and rest frame are for poses from elsewhere.", path=path)
    return load_tracks(path)


def fit_jaw(capture: Capture, motion: Motion, method: str, progress: Progress) -> JawModel:
    """Fit the jaw model of the person of a capture; see `fit_subject`.

    Args:
        capture: gives landmarks and mandible.
        motion: what `read_motion` gives.
        method: "anchored", "additive", "paper" or "pca".
        progress: told of the work.
    """
    with about(capture.folder / "capture.toml"):
        return fit_subject(subject_of_capture(capture), motion, method, progress)


@explain_missing_packages()
def fit_subject(subject: Subject, motion: Motion, method: str, progress: Progress) -> JawModel:
    """Fit the jaw model.

    Args:
        subject: gives landmarks and mandible.
        motion: what `read_motion` gives.
        method: "anchored", "additive", "paper" or "pca".
        progress: told of the work.

    Raises:
        FittingError: the poses cannot carry a model.
    """
    from jawusd.fitting import FittingConfig, fit_model

    model = fit_model(
        motion,
        T_anatomical_skull=subject.T_anatomical_skull,
        landmarks=subject.landmarks,
        mandible_vertices=subject.measured_points(),
        T_rest=subject.T_rest,
        config=FittingConfig(method=method),
        actor=subject.name,
        progress=lambda done, total: progress("fit", done, total),
    )
    model.meta["inferred"] = list(subject.inferred)
    if subject.fps is not None:
        model.meta["fps"] = subject.fps
    return model


def bake_files(capture: Capture, model: JawModel, folder: Path, progress: Progress, table_size: int = 33) -> list[Path]:
    """Write the rig.

    Args:
        capture: gives the meshes and the name.
        model: the fitted model with the captured parameters.
        folder: where the rig goes.
        progress: told of the work.
        table_size: knots per axis of the sampled decoder, 17, 33 or 65.

    Returns:
        The files written.

    Raises:
        RigError, OutputError: the rig cannot be written.
    """
    return bake_meshes(load_meshes(capture), capture.name, capture.fps, model, folder, progress, table_size)


@explain_missing_packages()
def bake_meshes(
    meshes: Mapping[str, Mesh],
    name: str,
    fps: float,
    model: JawModel,
    folder: Path,
    progress: Progress,
    table_size: int = 33,
) -> list[Path]:
    """Write the rig of a person whose meshes are at hand, with the captured motion if the model has any.

    Args:
        meshes: by the names of `prepare.MESHES` [mm].
        name: of the person.
        fps: frames per second.
        model, folder, progress, table_size: see `bake_files`.

    Returns:
        The files written.

    Raises:
        RigError, OutputError: the rig cannot be written.
    """
    from jawusd.imaging.mesh_cleaning import manifold
    from jawusd.rig.bake import bake_rig

    # Bones come from segmented scans with all their faults; teeth scans stay as they are, vertex for vertex.
    meshes = {key: manifold(mesh) if key in BONES else mesh for key, mesh in meshes.items()}
    motion = {"frames": model.frames, "d": model.d} if len(model.frames) else {}
    progress("bake", 0, 1)
    files = bake_rig(
        folder, JawRig(model.arrays, model.meta), meshes, name=name, fps=fps, table_size=table_size, **motion
    )
    progress("bake", 1, 1)
    return files


@explain_missing_packages()
def write_take(capture: Capture, tracks: Tracks, folder: Path) -> list[Path]:
    """Write the take beside the rig: its cameras, and the actor where the head was.

    Args:
        capture: gives cameras and frame rate.
        tracks: the poses of the head.
        folder: of the rig.

    Returns:
        The files written.

    Raises:
        CalibrationError: a camera of the capture has no calibration.
        RigError, OutputError: the take cannot be written.
    """
    from jawusd.rig.cameras import write_cameras

    return write_cameras(
        folder / "cameras.usda",
        tracked_cameras(load_cameras(capture), tracks),
        folder / "anim_capture.usdc",
        tracks.frames,
        tracks.T_world_upper,
        capture.fps,
    )


@explain_missing_packages("demo")
def write_demo_capture(folder: Path, seed: int, frames: int, progress: Progress) -> Path:
    """Render a synthetic capture and return its capture.toml.

    Args:
        folder: where to.
        seed: another number is another person.
        frames: exercise frames.
        progress: told of the work.

    Raises:
        MissingDependencyError: OpenGL without a display (EGL) is not available.
        OutputError: the folder cannot be written.
    """
    from jawusd.synthetic.capture_writer import DemoConfig, write_demo

    config = DemoConfig(seed=seed, frames=frames)
    write_demo(folder, config, progress=lambda done, total: progress("demo", done, total))
    return folder / "capture.toml"
