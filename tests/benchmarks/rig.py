"""Measure a built rig against its bars: python tests/benchmarks/rig.py RIG_FOLDER [CAPTURE]

One row per bar: what was found, what is allowed. With the capture also the time to bake a take of 10,000 frames.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
import onnxruntime  # noqa: E402
from pxr import Usd, UsdGeom  # noqa: E402
from scipy.interpolate import RegularGridInterpolator, interp1d  # noqa: E402

from jawusd.formats.model import load_model, save_model  # noqa: E402
from jawusd.geometry import se3_exp  # noqa: E402
from jawusd.plugins import jawusd_reader  # noqa: E402
from jawusd.rig import load_rig  # noqa: E402
from jawusd.rig.onnx_sidecar import decode_model  # noqa: E402
from jawusd.rig.table import sample_valid  # noqa: E402

MESHES = {"geo.usdc", "proxy.usdc", "actor.usdz"}  # files that hold meshes
RIG = {"actor.usda", "rig.usdc", "actor.onnx", "actor_encode.onnx", "actor_skel.usdc", "anim_capture.usdc"}
RIG |= {"cameras.usda", "cameras_motion.usdc"}
RECORDS = {"tracks.npz", "first_pass.npz", "model.npz", "build.json"}  # of the build; they grow with the capture
TAKE_FRAMES = 10_000


def row(name, value, bar, good):
    """Print one bar."""
    print(f"{'ok ' if good else 'NO '} {name:<66} {value:>16}   {bar}", flush=True)


def sizes(folder):
    """Sum the files of the rig that hold no meshes."""
    files = {path.name: path.stat().st_size for path in folder.iterdir() if path.is_file()}
    rig, records = (sum(size for name, size in files.items() if name in group) for group in (RIG, RECORDS))
    row("rig without meshes and without the build's records", f"{rig / 1e6:.2f} MB", "<= 2 MB", rig <= 2e6)
    row("rig without meshes, with the records", f"{(rig + records) / 1e6:.2f} MB", "<= 2 MB", rig + records <= 2e6)
    for name in sorted(MESHES & set(files)):
        print(f"    {name}: {files[name] / 1e6:.2f} MB")


def mandible_points(stage):
    """Return all vertices that move with the jaw, mandible coordinates [mm]."""
    meshes = [UsdGeom.Mesh(p) for p in stage.GetPrimAtPath("/Actor/geo/Mandible").GetChildren() if p.IsA(UsdGeom.Mesh)]
    return np.concatenate([np.array(mesh.GetPointsAttr().Get(), dtype=np.float64) for mesh in meshes])


def worst_mm(T_a, T_b, points):
    """Return the largest distance of any point between two sets of poses."""
    found = 0.0
    for a, b in zip(T_a, T_b, strict=True):
        D = (a - b)[:3]
        found = max(found, float((((points @ D[:, :3].T) + D[:, 3]) ** 2).sum(axis=1).max()))
    return np.sqrt(found)


def table_poses(prim, d):
    """Read the table as the schema describes it, with scipy's interpolators, and return its poses."""
    knots = [np.array(prim.GetAttribute(f"jaw:decoder:d{i}Knots").Get()) for i in (1, 2, 3)]
    twists = np.array(prim.GetAttribute("jaw:decoder:twists").Get(), dtype=np.float64).reshape(-1, 6)
    if prim.GetAttribute("jaw:decoder:format").Get() == "grid":
        grid = twists.reshape(*(len(axis) for axis in knots), 6)
        xi = RegularGridInterpolator(knots, grid)(d)
    else:
        parts = np.split(twists, np.cumsum([len(axis) for axis in knots])[:2])
        xi = sum(interp1d(axis, part, axis=0)(x) for axis, part, x in zip(knots, parts, d.T))
    return se3_exp(xi) @ np.array(prim.GetAttribute("jaw:model:tRest").Get()).reshape(4, 4)


def evaluators(folder, rig, points):
    """Compare table, ONNX graphs and single-file reader with the exact model at 10,000 random valid d."""
    stage = Usd.Stage.Open(str(folder / "actor.usda"))
    prim = stage.GetPrimAtPath("/Actor")
    d = sample_valid(rig, 10_000, seed=20261121)
    exact = rig.pose(d)
    error = worst_mm(exact, table_poses(prim, d), points)
    row(f"table, 10,000 d, {len(points)} vertices, worst", f"{error:.4f} mm", "<= 0.06 mm", error <= 0.06)
    print(f"    the rig states {prim.GetAttribute('jaw:decoder:maxError').Get():.4f} mm")
    graph = (folder / "actor.onnx").read_bytes()
    for name, data, dtype, bar in (
        ("actor.onnx (float32)", graph, np.float32, 0.01),
        ("ONNX exported in float64", decode_model(rig, np.float64).SerializeToString(), np.float64, 1e-6),
    ):
        (pose,) = onnxruntime.InferenceSession(data).run(["pose"], {"d": d.astype(dtype)})
        error = worst_mm(rig.pose(d.astype(dtype).astype(np.float64)), pose.astype(np.float64), points)
        row(f"{name}, 10,000 d", f"{error:.2e} mm", f"<= {bar:g} mm", error <= bar)
    reader = jawusd_reader.load(str(folder / "actor.usda"))
    error = worst_mm(exact[:2000], np.array([reader.pose(*row) for row in d[:2000].tolist()]), points)
    row("jawusd_reader.py, 2,000 d", f"{error:.2e} mm", "<= 1e-9 mm", error <= 1e-9)


def between_frames(folder, rig, points):
    """Look at the baked ops at fractional time codes."""
    stage = Usd.Stage.Open(str(folder / "anim_capture.usdc"))
    actor, mandible = stage.GetPrimAtPath("/Actor"), UsdGeom.Xformable(stage.GetPrimAtPath("/Actor/geo/Mandible"))
    times = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode(), 1 / 7)
    T = np.array([np.array(mandible.GetLocalTransformation(float(time))).T for time in times])
    d = np.array([[actor.GetAttribute(f"jaw:d{i}").Get(float(time)) for i in (1, 2, 3)] for time in times])
    bend = np.abs(np.linalg.det(T[:, :3, :3]) - 1).max()
    error = worst_mm(T, rig.pose(d), points)
    row(f"captured motion at {len(times)} fractional time codes, |det - 1|", f"{bend:.1e}", "<= 1e-9", bend <= 1e-9)
    row("    distance to the evaluator", f"{error:.4f} mm", "<= 0.05 mm", error <= 0.05)


def bake_time(folder, capture):
    """Bake a take of 10,000 frames with the program, as a user does."""
    model = load_model(folder / "model.npz")
    known = np.flatnonzero(np.isfinite(model.d).all(axis=1))
    there_and_back = np.concatenate([known, known[::-1]])
    rows = np.resize(there_and_back, TAKE_FRAMES)
    model.frames, model.d = np.arange(TAKE_FRAMES), model.d[rows]
    model.residual_mm, model.trained = model.residual_mm[rows], model.trained[rows]
    with tempfile.TemporaryDirectory() as scratch:
        save_model(Path(scratch) / "model.npz", model)
        command = [sys.executable, "-m", "jawusd", "bake", f"{scratch}/model.npz", "--capture", str(capture)]
        start = time.perf_counter()
        subprocess.run([*command, "-o", f"{scratch}/actor"], check=True, capture_output=True)
        seconds = time.perf_counter() - start
    row("jawusd bake, 10,000 frames, one core", f"{seconds:.1f} s", "<= 20 s", seconds <= 20)


def main(folder, capture=None):
    """Measure everything."""
    rig = load_rig(folder / "actor.usda")
    points = mandible_points(Usd.Stage.Open(str(folder / "actor.usda")))
    sizes(folder)
    evaluators(folder, rig, points)
    between_frames(folder, rig, points)
    if capture is not None:
        bake_time(folder, capture)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
