"""Build one capture several times: python tests/benchmarks/determinism.py CAPTURE FOLDER

Each build is a process of its own, with its own number of threads for the tracker and for the linear algebra libraries.
Prints, for every kind of result, how many arrays (and attributes of the rig) there are and how many differ from those
of the first build; exit code 1 if any does. FOLDER gets the builds.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from short_example import results

# Name, threads of the tracker, threads of the libraries.
RUNS = (("first", 1, 1), ("again", 1, 1), ("two threads", 2, 1), ("two and two", 2, 2))
VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def build(capture: Path, folder: Path, jobs: int, threads: int) -> None:
    """Build in a process of its own."""
    environment = {**os.environ, **dict.fromkeys(VARIABLES, str(threads))}
    command = [sys.executable, "-m", "jawusd", "build", capture, "-o", folder, "--resume", "--jobs", str(jobs)]
    subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)


def report(capture: Path, root: Path) -> int:
    """Build, compare and print; return how many results differ."""
    found = {}
    for name, jobs, threads in RUNS:
        folder = root / name.replace(" ", "_")
        build(capture, folder, jobs, threads)
        found[name] = results(folder)
    first, total = found["first"], 0
    kinds = Counter(key.partition(":")[0] for key in first)
    print(f"{'build':<12}" + "".join(f"{f'{kind} ({count})':>22}" for kind, count in kinds.items()))
    for name, arrays in found.items():
        differ = [key for key in set(first) | set(arrays) if first.get(key) != arrays.get(key)]
        counts = Counter(key.partition(":")[0] for key in differ)
        print(f"{name:<12}" + "".join(f"{f'{counts[kind]} differ':>22}" for kind in kinds))
        for key in sorted(differ):
            print(f"    {key}")
        total += len(differ)
    return total


if __name__ == "__main__":
    sys.exit(report(Path(sys.argv[1]), Path(sys.argv[2])) > 0)
