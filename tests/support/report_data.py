"""Results and report data for tests: made up, of the right shapes, without any fitting."""

from dataclasses import replace

import numpy as np
from example_model import example_arrays, example_meta
from example_rig import example_meshes, example_motion

from jawusd.evaluator import JawRig
from jawusd.formats.experiments import CondylePath, Coverage, Distances, Experiments, ParameterPath
from jawusd.formats.model import JawModel
from jawusd.formats.performance import SolvedJaw, SolveState
from jawusd.formats.report import CameraFacts, Origin, Overlay, ReplayPart, ReportData, RigFacts, SolveReportData
from jawusd.formats.tracks import LOST, TRACKED, Tracks
from jawusd.paper.figures import inline_figures
from jawusd.report import document as report_document

FPS = 24.0
CAMERAS = ("cam0", "cam1")


def experiments(bones=True, gaps=True, sentences=()):
    """Return results of the paper's experiments; `bones` and `gaps` may be missing."""
    rng = np.random.default_rng(0)
    opening = np.linspace(0, 40, 30)
    points = np.stack([np.stack([np.full(30, side), 30 - 0.2 * opening, -80 + 0.3 * opening], 1) for side in (50, -50)])
    lines = rng.normal(size=(5, 2, 2)) + [-80, 30]
    heads = (lines,) * 4 if bones else ()
    paths = tuple(CondylePath(name, opening, points, heads) for name in ("principal component 1", "anchored"))
    distances = [Distances("reconstruction", name, "x", rng.gamma(2, 0.2, 300)) for name in ("NLPCA 1", "anchored")]
    distances += [Distances("synthesis", name, "static: box", rng.gamma(2, 1, 200)) for name in ("captured", "paper")]
    d = rng.uniform([0, -9, -1], [40, 9, 7], (300, 3))
    square = np.array([[0.0, -9], [40, -9], [40, 9], [0, 9]])
    holes = rng.uniform([0, -3], [40, 3], (20, 2)) if gaps else np.empty((0, 2))
    slices = np.stack([np.stack([np.full(30, -9.0), np.full(30, 9.0)], 1)] * 2)
    coverage = Coverage(d, ((square,), (square, square / 2)), opening, slices, (holes, holes), sentences)
    skull = lines if bones else np.empty((0, 2, 2))
    captured = points + rng.normal(size=points.shape) * 0.1
    swept = tuple(ParameterPath(name, k, opening, points[0] + k) for name in ("pca", "anchored") for k in range(3))
    return Experiments("someone", 300, captured, skull, paths, tuple(distances), coverage, (), swept)


def report_data(count=60, lost=(), **change):
    """Return the data of a report on a good build of `count` frames; the rows `lost` have no pose."""
    frames, d = example_motion(count)
    model = JawModel(
        example_arrays(), frames, d, np.full(count, 0.1), np.ones(count, bool), {**example_meta(), **_meta()}
    )
    model.trained[list(lost)] = False
    poses = JawRig(model.arrays, model.meta).pose(d)
    values = {
        "actor": "someone",
        "tracks": _tracks(frames, poses, list(lost)),
        "model": model,
        "sync": {"offsets": {"cam0": 0, "cam1": 3}, "method": "light flash", "confidence": {"cam0": 1.0, "cam1": 0.9}},
        "cameras": tuple(CameraFacts(name, f"{name}.mp4", "upper.mkv, lower.mkv", (640, 360)) for name in CAMERAS),
        "inferred": ("anatomical axes, from the scans",),
        "seconds": {"sync": 1.0, "track": 20.0},
        "hashes": {"actor.usda": "ab" * 32},
        "origin": Origin("2031-02-03 04:05:06 UTC", "jawusd build 'some where' -o out", {"jawusd": "1.2.3"}),
        "rig": RigFacts(0.02, ()),
        "experiments": experiments(),
        "overlays": (Overlay(int(frames[7]), "1.00 % of the masks left uncovered", b"\xff\xd8\xff\xd9"),),
        "parts": _parts(),
        "left_out": ("the networks",),
    }
    return replace(ReportData(**values), **change)


def solve_data(**change):
    """Return a performance of 60 frames: 10-14 out of sight (lower arch), 30 lost (both), 40 and 41 outside."""
    tracks = report_data().tracks
    count = len(tracks.frames)
    state, valid, margin = np.ones(count, np.int8), np.ones(count, bool), np.full(count, 2.0)
    sigma = np.full((count, 3), 0.05)
    state[10:15], state[30] = SolveState.CARRIED, SolveState.LOST
    tracks.status[10:15, 1] = tracks.status[30] = LOST
    sigma[10:15], sigma[30] = [1.0, 0.5, 0.25], 3.0
    valid[40:42], margin[40:42] = False, -0.7
    margin[45] = -0.2
    d = np.stack([np.linspace(0, 30, count), np.linspace(-4, 4, count), np.zeros(count)], axis=1)
    tracks.solved = SolvedJaw(d, sigma, margin, state, valid)
    tracks.meta["tolerance_mm"], tracks.meta["focal"] = 0.3, {"cam1": [1.02, 0.003]}
    tracks.meta["findings"] = [{"kind": "x", "severity": "warning", "message": "masks <are> wide", "camera": "cam1"}]
    values = {
        "shot": "take & one",
        "tracks": tracks,
        "fps": FPS,
        "limits": "having one camera",
        "cameras": (CameraFacts("cam0", "cam0.mp4", "", (640, 360)), CameraFacts("cam2", "", "", (640, 360))),
        "overlays": (Overlay(int(tracks.frames[30]), "lost <here>", b"\xff\xd8\xff\xd9"),),
        "versions": {"jawusd": "1.2.3"},
        "left_out": (),
    }
    return replace(SolveReportData(**values), **change)


def _meta():
    row = {"mean": 0.3, "median": 0.2, "p95": 0.6, "max": 1.0, "frames": 50}
    return {
        "errors": {"holdout": {"mandible": row, "incisor": row}, "train": {"mandible": row}},
        "uncertainty": {"incisor": {"base_mm": 0.1, "per_mm": 0.02}},
        "excluded_frames": {"uncertain": [31, 32, 33, 40]},
        "trimmed_frames": [],
        "warnings": [],
        "fps": FPS,
    }


def _tracks(frames, poses, lost):
    count = len(frames)
    poses = poses.copy()
    poses[lost] = np.nan
    status = np.full((count, 2), TRACKED, np.int8)
    status[lost] = LOST
    world = np.tile(np.eye(4), (count, 1, 1))
    covariance = np.tile(np.eye(6), (count, 1, 1))
    return Tracks(
        frames=frames,
        T_world_upper=world,
        T_world_lower=poses,
        T_upper_lower=poses,
        raw_T_world_upper=world,
        raw_T_world_lower=poses,
        raw_T_upper_lower=poses,
        status=status,
        prior_aided=np.zeros(count, bool),
        coverage_error=np.full((count, 2, 2), 0.005),
        masks_used=np.ones((count, 2, 2), bool),
        covariance_upper=covariance,
        covariance_lower=covariance,
        covariance_relative=covariance,
        sigma_mm=np.tile([0.05, 0.1, 0.1, 0.2, 0.2], (count, 1)),
        residual_px=np.full((count, 2), 0.5),
        matched_px=np.full((count, 2), 900.0),
        camera_names=CAMERAS,
        meta={
            "delays_frames": {"cam0": 0.0, "cam1": 0.1},
            "start": {"by": "picks", "frame": 30, "picks_left_out": {"upper": [2], "lower": []}},
        },
    )


def _parts():
    moves = ("mandible", "lower_teeth")
    return tuple(
        ReplayPart(name, "tooth" if "teeth" in name else "bone", name in moves, mesh)
        for name, mesh in example_meshes().items()
    )


def all_figures(data):
    """Return all plots of a report, as a build draws them."""
    return report_document.draw_figures(data) | (inline_figures(data.experiments) if data.experiments else {})


def document(data):
    """Return the report with all its plots."""
    return report_document.document(data, all_figures(data))


def write_document(path, data):
    """Write the report with all its plots."""
    return report_document.write_document(path, data, all_figures(data))
