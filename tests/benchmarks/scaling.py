"""What a capture costs as it grows: python tests/benchmarks/scaling.py build|track|many FOLDER [FRAMES ...]

`build` loops the frames of examples/capture back and forth (masks alone, at half size) to takes of the given numbers of
frames (100, 1000 and 5000 by default) and builds each. It prints, for every stage, processor time (user and system) per
frame, its ratio to the shortest take's, and peak memory, then the size of what was written.

`track` tracks a made-up mouth: with 2 to 12 cameras, with pictures from 200 to 4800 lines, with scans of 11,000 to
690,000 triangles, and takes of the given numbers of frames (10, 100, 1000 by default).

`many` builds twenty takes of the example's first frames, whose number may be given (30 by default): by two workers,
by one, and by one that is held to one core, whose time two should halve. (One alone uses more than a core: stages have
parts that run side by side.)

Every run is a process of its own; those of `build` and `track` have one thread. FOLDER gets the takes, their pictures
linked, and the builds. Linux only: memory is the high-water mark that the kernel keeps.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
for variable in VARIABLES:
    os.environ[variable] = "1"

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import trimesh  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from bumpy_teeth import jaw_poses, make_cameras, render_masks  # noqa: E402
from short_example import write_short  # noqa: E402

from jawusd.formats.mesh import Mesh  # noqa: E402

ROWS = ("upper", "lower")
FIRST = 20  # first frame of the looped example
UNIQUE = 40  # different frames of the made-up mouth
CAMERAS = (2, 3, 4, 6, 8, 12)
SIZES = (0.5, 1.2, 2.7, 5.4, 12.0)  # of 640 x 400; 12 is 8K
FINER = (0, 1, 2, 3)  # how often each triangle is cut in four
MANY = 20  # captures


def back_and_forth(count: int, length: int) -> np.ndarray:
    """Return which of `length` frames each frame of a take shows."""
    k = np.arange(count) % (2 * length - 2)
    return np.minimum(k, 2 * length - 2 - k)


def loop_example(folder: Path, frames: int) -> Path:
    """Write a take of the example's frames, back and forth, at half size."""
    write_short(folder, frames)
    text = (folder / "capture.toml").read_text()
    offsets = {name: int(o) for name, o in re.findall(r"(cam\d) = (-?\d+)", text)}
    halved = re.sub(r"\b([xy]) = ([\d.]+)", lambda m: f"{m[1]} = {(float(m[2]) + 0.5) / 2 - 0.5:.3f}", text)
    (folder / "capture.toml").write_text(re.sub(r"(upper|lower)\.mkv", r"\1/%06d.png", halved))
    for name, offset in offsets.items():
        for row in ROWS:
            film = folder / "masks" / name / f"{row}.mkv"
            pictures = film.with_suffix("")
            pictures.mkdir()
            shown = [_halved(picture) for picture in _pictures(film, FIRST - offset, 300)]
            _write_looped(pictures, shown, frames, FIRST - offset)
            film.unlink()
    return folder


def _pictures(film: Path, first: int, count: int) -> list[np.ndarray]:
    reader = cv2.VideoCapture(str(film))
    reader.set(cv2.CAP_PROP_POS_FRAMES, 0)
    every = [reader.read()[1] for _ in range(first + count)]
    return [picture[:, :, 0] for picture in every[first:]]


def _halved(picture: np.ndarray) -> np.ndarray:
    small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return (small > 127).astype(np.uint8) * 255


def _write_looped(folder: Path, pictures: list[np.ndarray], frames: int, first: int) -> None:
    """Write pictures back and forth; each once, linked where it comes again."""
    sources: dict[int, Path] = {}
    for k, source in enumerate(back_and_forth(frames, len(pictures)).tolist()):
        path = folder / f"{first + k:06d}.png"
        if source in sources:
            os.link(sources[source], path)
        else:
            cv2.imwrite(str(path), pictures[source])
            sources[source] = path


def cost_of_build(capture: str, out: str) -> dict:
    """Build here and return processor seconds and peak memory [MB] by stage."""
    from jawusd.pipeline.build import BuildOptions, build

    seconds: dict[str, float] = {}
    peaks: dict[str, float] = {}
    now = {"stage": "sync", "clock": time.process_time()}

    def note(stage: str, done: int, total: int) -> None:
        seconds[now["stage"]] = seconds.get(now["stage"], 0.0) + time.process_time() - now["clock"]
        peaks[now["stage"]] = max(peaks.get(now["stage"], 0.0), _peak_mb())
        now.update(stage=stage, clock=time.process_time())

    summary = build(capture, out, BuildOptions(jobs=1), note)
    note("", 0, 0)
    sizes = {path.name: path.stat().st_size for path in Path(out).iterdir()}
    return {"seconds": seconds, "peaks": peaks, "sizes": sizes, "tracked": summary["track"]["tracked"]}


def cost_of_track(folder: str, cameras: int, size: float, frames: int, finer: int) -> dict:
    """Track the made-up mouth here and return processor seconds and peak memory [MB]."""
    import small_take

    from jawusd.tracking import track_capture

    small_take.MESHES = tuple(_finer(mesh, finer) for mesh in small_take.MESHES)
    own = make_cameras(tuple(np.linspace(-40, 40, cameras)))
    small_take.CAMERAS = [camera.scaled(tuple(int(size * s) for s in camera.size_px)) for camera in own]
    small_take.OFFSETS = {camera.name: 0 for camera in own}
    capture = small_take.make_capture(Path(folder), frames)
    before = _peak_mb()
    arguments = (capture, small_take.CAMERAS, small_take.OFFSETS, *small_take.MESHES, small_take.LANDMARKS)
    short = capture.model_copy(update={"frames": (small_take.FIRST, small_take.FIRST + 10)})
    track_capture(short, *arguments[1:], threads=1)  # compiled and warm
    clock = time.process_time()
    tracks = track_capture(*arguments, threads=1)
    spent = time.process_time() - clock
    faces = sum(len(mesh.faces) for mesh in small_take.MESHES)
    tracked = int(tracks.tracked().sum())
    return {"seconds": spent, "peak": _peak_mb(), "before": before, "tracked": tracked, "faces": faces}


def _finer(mesh: Mesh, times: int) -> Mesh:
    """Return the same surface with every triangle cut in four so many times."""
    for _ in range(times):
        paint = {"color": np.asarray(mesh.colors, np.float64)}
        vertices, faces, paint = trimesh.remesh.subdivide(mesh.vertices, mesh.faces, vertex_attributes=paint)
        mesh = Mesh(vertices, faces.astype(np.int32), np.rint(paint["color"]).astype(np.uint8))
    return mesh


def _peak_mb() -> float:
    """Return the high-water mark of memory since the last call [MB], and start it anew."""
    status = Path("/proc/self/status").read_text()
    Path("/proc/self/clear_refs").write_text("5")
    return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024


def write_mouth(folder: Path, cameras: int, size: float, frames: int) -> None:
    """Write the masks of a made-up mouth that nods and opens back and forth."""
    import small_take

    shown = jaw_poses(np.arange(UNIQUE))
    for camera in make_cameras(tuple(np.linspace(-40, 40, cameras))):
        pair = [render_masks(small_take.MESHES, poses, camera, (7.5, -16.0)) for poses in shown]
        pair = np.array(pair)
        full = tuple(int(size * s) for s in camera.size_px)
        for r, row in enumerate(ROWS):
            target = folder / camera.name / row
            target.mkdir(parents=True)
            grown = [cv2.resize(mask, full, interpolation=cv2.INTER_LINEAR) for mask in pair[:, r]]
            binary = [(mask > 127).astype(np.uint8) * 255 for mask in grown]
            _write_looped(target, binary, frames, small_take.FIRST)


def in_a_process(*arguments: object) -> dict:
    """Run a cost function of this file in a fresh process."""
    command = [sys.executable, __file__, "--cost", *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise SystemExit(result.stderr)
    return json.loads(result.stdout.splitlines()[-1])


def report_build(root: Path, counts: list[int]) -> None:
    """Build looped takes and print the table."""
    first: dict[str, float] = {}
    for count in counts:
        take = root / f"take_{count}"
        if not take.exists():
            loop_example(take, count)
        cost = in_a_process("build", take, root / f"build_{count}")
        total = sum(cost["seconds"].values())
        rows = {**cost["seconds"], "all": total}
        print(f"{count} frames, {cost['tracked']} tracked: {total:.1f} s of processor time", flush=True)
        for stage, seconds in rows.items():
            each = 1e3 * seconds / count
            first.setdefault(stage, each)
            peak = cost["peaks"].get(stage, max(cost["peaks"].values()))
            print(f"  {stage:<10} {seconds:8.2f} s {each:9.2f} ms/frame  x {each / first[stage]:5.2f}  {peak:6.0f} MB")
        kilo = {name: size / 1000 for name, size in cost["sizes"].items() if size > 1e5}
        print("  " + ", ".join(f"{name} {size:.0f} kB" for name, size in sorted(kilo.items())), flush=True)


def report_track(root: Path, counts: list[int]) -> None:
    """Track takes of many shapes and print the table."""
    heads = ("cameras", 7), ("frames", 7), ("picture", 12), ("triangles", 9), ("s", 9), ("ms/frame", 9)
    heads = *heads, ("per view", 9), ("peak MB", 8)
    print(" ".join(f"{name:>{width}}" for name, width in heads), "tracked")
    shapes = [(c, 60, 1.2, 0) for c in CAMERAS] + [(3, 60, s, 0) for s in SIZES]
    shapes += [(3, 60, 1.2, finer) for finer in FINER] + [(3, n, 0.5, 0) for n in counts]
    for cameras, frames, size, finer in shapes:
        folder = root / f"mouth_{cameras}_{frames}_{size:g}"
        if not folder.exists():
            write_mouth(folder, cameras, size, frames)
        cost = in_a_process("track", folder, cameras, size, frames, finer)
        each = 1e3 * cost["seconds"] / frames
        picture = f"{int(640 * size)} x {int(400 * size)}"
        shape = f"{cameras:>7} {frames:>7} {picture:>12} {cost['faces']:>9}"
        row = f"{shape} {cost['seconds']:>9.2f} {each:>9.2f} {each / cameras:>9.2f}"
        print(f"{row} {cost['peak']:>8.0f} {cost['tracked']:>7}", flush=True)


def report_many(root: Path, counts: list[int]) -> None:
    """Build twenty takes by one and by two workers and print how near two come to half the time of one."""
    takes = [write_short(root / f"take_{k}", counts[0]) for k in range(MANY)]
    cores = sorted(os.sched_getaffinity(0))
    _build_many(takes[:1], root / "warm", 1)  # compiles
    seconds = {"two": _build_many(takes, root / "two", 2), "one": _build_many(takes, root / "one", 1)}
    os.sched_setaffinity(0, cores[:1])  # those that are started keep to it too
    seconds["one on one core"] = _build_many(takes, root / "held", 1)
    os.sched_setaffinity(0, cores)
    print(f"{MANY} takes of {counts[0]} frames")
    for name, spent in seconds.items():
        print(f"  by {name}: {spent:.1f} s; two workers take {2 * seconds['two'] / spent:.2f} of half of it")


def _build_many(takes: list[Path], out: Path, workers: int) -> float:
    """Build takes and return seconds by the clock."""
    listed = out.with_suffix(".txt")
    listed.write_text("".join(f"{take.name}/capture.toml\n" for take in takes))
    command = [sys.executable, "-m", "jawusd", "build-many", str(listed), "-o", str(out), "--workers", str(workers)]
    clock = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - clock


def main(arguments: list[str]) -> None:
    """Run what the command line says."""
    if arguments[:1] == ["--cost"]:
        kind, *rest = arguments[1:]
        if kind == "build":
            print(json.dumps(cost_of_build(*rest)))
        else:
            folder, cameras, size, frames, finer = rest
            print(json.dumps(cost_of_track(folder, int(cameras), float(size), int(frames), int(finer))))
        return
    reports = {
        "build": (report_build, [100, 1000, 5000]),
        "track": (report_track, [10, 100, 1000]),
        "many": (report_many, [30]),
    }
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=tuple(reports))
    parser.add_argument("folder", type=Path)
    parser.add_argument("frames", type=int, nargs="*")
    chosen = parser.parse_args(arguments)
    report, usual = reports[chosen.kind]
    report(chosen.folder, chosen.frames or usual)


if __name__ == "__main__":
    main(sys.argv[1:])
