"""Compare the paper's solver with the default one: python tests/benchmarks/tracking.py CAPTURE [--windows 3 --length 4]

Tracks a few short windows spread over a capture that comes with its truth (truth/truth.npz). Both solvers start every
window from the same picks, taken from the truth of its first frame; that frame is not scored. Each row of the table
runs in a process of its own, one after the other:

    solve   wall time of the solver, median per frame, both rows of teeth, all views [ms]
    core    processor time of the solver, where it runs in one thread [ms]
    all     wall time with reading, undistorting and judging [ms]
    CPU     processor time of all that, all threads, mean per frame [ms]
    error   distance of tooth vertices from the truth, mean over vertices: mean, 95th percentile, largest over frames

"exact" counts boundary pixels as eq. 9 does; "spared" leaves those in the other row's mask uncounted, which helps the
paper's energy where one row hides the other.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROWS = ("upper", "lower")


@dataclass(frozen=True)
class Setup:
    """Name one row of the table."""

    solver: str
    backend: str
    threads: int

    def label(self) -> str:
        """Return the row's name."""
        how = "paper, exact" if self.solver == "paper" else "default"
        return f"{how:<15}{self.backend:<5}{self.threads}"


SETUPS = (
    Setup("contour", "cpu", 1),
    Setup("contour", "cpu", 2),
    Setup("paper", "cpu", 1),
    Setup("paper", "cpu", 2),
    Setup("paper", "gl", 1),
    Setup("paper", "gl", 2),
)


class Watch:
    """Take wall time, time within the solver, and processor time at every finished frame."""

    def __init__(self, module: object, name: str) -> None:
        """Time the function or method of that name from now on."""
        self._solve_s = self._core_s = 0.0
        self._marks: list[tuple[float, ...]] = []
        original = getattr(module, name)

        def timed(*arguments: object, **options: object) -> object:
            start, core = time.perf_counter(), time.thread_time()
            try:
                return original(*arguments, **options)
            finally:
                self._solve_s += time.perf_counter() - start
                self._core_s += time.thread_time() - core

        setattr(module, name, timed)

    def mark(self, done: int, total: int) -> None:
        """Note that a frame is finished."""
        self._marks.append((time.perf_counter(), self._solve_s, self._core_s, time.process_time()))

    def frames_ms(self) -> list[list[float]]:
        """Return all, solve, core, CPU [ms] of every frame but the first, and forget them."""
        marks, self._marks = self._marks, []
        return [[1e3 * (b - a) for a, b in zip(first, then)] for first, then in zip(marks, marks[1:])]


def run_setup(path: Path, setup: Setup, windows: int, length: int) -> dict:
    """Track all windows with one setup; return times and errors per scored frame."""
    import numpy as np

    from jawusd.formats.capture import load_capture
    from jawusd.formats.mesh import tooth_labels
    from jawusd.geometry import transform_points
    from jawusd.paper import take as paper_take
    from jawusd.pipeline.cameras import load_cameras
    from jawusd.pipeline.subject import load_meshes, subject_of_capture
    from jawusd.tracking import track_capture
    from jawusd.tracking.contour.solver import ContourSolver

    capture = load_capture(path)
    cameras, meshes = load_cameras(capture), load_meshes(capture)
    with np.load(capture.folder / "truth" / "truth.npz", allow_pickle=False) as archive:
        truth = {name: archive[name] for name in archive.files}
    offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
    scans = [meshes[f"{row}_teeth"] for row in ROWS]
    watch = Watch(*((paper_take, "solve_paper") if setup.solver == "paper" else (ContourSolver, "solve")))
    landmarks = subject_of_capture(capture, meshes).landmarks
    times: list[list[float]] = []
    errors: dict[str, list[float]] = {row: [] for row in ROWS}
    for start in np.linspace(0, len(truth["frames"]) - length, windows).round().astype(int):
        window = cut(capture, cameras, scans, truth, int(start), length)
        if setup.solver == "paper":
            options = {"backend": setup.backend, "threads": setup.threads, "progress": watch.mark}
            tracks = paper_take.track_capture_paper(window, cameras, offsets, *scans, **options)
        else:
            options = {"threads": setup.threads, "progress": watch.mark}
            tracks = track_capture(window, cameras, offsets, *scans, landmarks, **options)
        times += watch.frames_ms()
        for row, scan in zip(ROWS, scans, strict=True):
            crown = scan.vertices[tooth_labels(scan) > 0][::5]
            found = getattr(tracks, f"raw_T_world_{row}")[1:]
            exact = truth[f"T_world_{row}"][start + 1 : start + length]
            gap = np.linalg.norm(transform_points(found, crown) - transform_points(exact, crown), axis=-1)
            errors[row] += gap.mean(-1).tolist()
    return {"times_ms": times, "errors_mm": errors}


def cut(capture: object, cameras: list, scans: list, truth: dict, start: int, length: int) -> object:
    """Return the capture limited to a window of the truth, with exact picks on its first frame."""
    import numpy as np

    from jawusd.formats.capture import Bootstrap, Pick, PickView
    from jawusd.formats.mesh import tooth_labels
    from jawusd.geometry import transform_point

    first = int(truth["frames"][start])
    picks = {}
    for row, scan in zip(ROWS, scans, strict=True):
        teeth = np.flatnonzero(tooth_labels(scan) > 0)
        spread = np.array([[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0.7, 0, 0.7], [-0.7, 0, 0.7]])
        chosen = {int(teeth[np.argmax(scan.vertices[teeth] @ direction)]) for direction in spread}
        picks[row] = []
        for vertex in sorted(chosen):
            place = transform_point(truth[f"T_world_{row}"][start], scan.vertices[vertex])
            pixels = [(camera.name, camera.project(place)) for camera in cameras]
            views = tuple(PickView(camera=name, x=float(x), y=float(y)) for name, (x, y) in pixels)
            picks[row].append(Pick(vertex=vertex, views=views))
    bootstrap = Bootstrap(frame=first, upper=tuple(picks["upper"]), lower=tuple(picks["lower"]))
    return capture.model_copy(update={"frames": (first, first + length), "bootstrap": bootstrap})


def in_a_process(options: argparse.Namespace, setup: Setup) -> dict | str:
    """Run one setup in a fresh interpreter; return its result, or why there is none."""
    limits = {name: str(setup.threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS")}
    command = [sys.executable, __file__, str(options.capture), "--row", str(SETUPS.index(setup))]
    command += ["--windows", str(options.windows), "--length", str(options.length)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **limits})
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    return json.loads(done.stdout)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--windows", type=int, default=3)
    parser.add_argument("--length", type=int, default=4, help="frames per window")
    parser.add_argument("--row", type=int, help="run one row of the table only and print it as JSON")
    options = parser.parse_args()
    if options.row is not None:
        print(json.dumps(run_setup(options.capture, SETUPS[options.row], options.windows, options.length)))
        return
    import numpy as np

    scored = options.windows * (options.length - 1)
    print(f"{options.capture}: {options.windows} windows of {options.length} frames, {scored} scored")
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"{'':<22}{'ms per frame':^36} |{'upper error [mm]':^24} |{'lower error [mm]':^24}")
    heads = "".join(f"{name:>8}" for name in ("mean", "p95", "max"))
    print(f"{'solver         where thr':<24}{'solve':>7}{'core':>9}{'all':>9}{'CPU':>9} |{heads} |{heads}")
    found = {}
    for setup in SETUPS:
        result = in_a_process(options, setup)
        if isinstance(result, str):
            print(f"{setup.label()}      {result}", flush=True)
            continue
        everything, solve, core, cpu = np.array(result["times_ms"]).T
        found[setup] = np.median(core), np.mean([np.mean(result["errors_mm"][row]) for row in ROWS])
        alone = f"{np.median(core):.0f}" if setup.threads == 1 and setup.backend == "cpu" else "-"
        line = f"{setup.label():<22}{np.median(solve):9.0f}{alone:>9}{np.median(everything):9.0f}{cpu.mean():9.0f}"
        for row in ROWS:
            e = np.array(result["errors_mm"][row])
            line += f" |{e.mean():8.3f}{np.percentile(e, 95):8.3f}{e.max():8.3f}"
        print(line, flush=True)
    default, paper = (found.get(Setup(name, "cpu", 1)) for name in ("contour", "paper"))
    if default and paper:
        print(
            f"default against paper, one core: {paper[0] / default[0]:.0f} times faster (at least 40 wanted), ",
            end="",
        )
        print(f"{paper[1] / default[1]:.1f} times more accurate (at least 3 wanted)")


if __name__ == "__main__":
    main()
