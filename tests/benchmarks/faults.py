"""Kill builds at random moments and compare the resumed ones: python tests/benchmarks/faults.py CAPTURE [--kills 30].

An undisturbed build is the reference. Then builds are killed (SIGKILL to the whole process group) at a random moment of
a stage, resumed, killed again `--each` times, and resumed to the end; every stage gets as many kills. Compared are the
bytes of every file but the report, which tells how long each stage took (that it is there is checked), and what
build.json says but for times: hashes of inputs and outputs, results.

    kills       the stage each build was working on when it was killed, and the seconds since its start
    files       finished files there after each kill
    half        those of them that are not, byte for byte, files of the reference
    identical   files and records are those of the reference, and nothing unfinished is left
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from faults import REPORT, digests, finish, kill, records, stages, start_build, unfinished, wait_for_stage

STAGES = ("sync", "track", "fit", "refine", "bake", "report")
ORDER = ("sync", "fit", "bake", "track", "refine", "report")  # neighbours are far apart
START_S = 3.0  # until the program is loaded


def main() -> None:
    """Run the series and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--each", type=int, default=1, help="kills per build")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reference", type=Path, help="an undisturbed build of this code; made if not given")
    parser.add_argument("--folder", type=Path, help="where to build; a temporary folder if not given")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        reference = options.reference or Path(folder) / "reference"
        if options.reference is None:
            code, said = finish(start_build(options.capture, reference))
            if code:
                sys.exit(f"the undisturbed build failed: {said}")
        seconds = {name: record["seconds"] for name, record in stages(reference).items()}
        seconds["sync"] += START_S
        print(f"undisturbed: {sum(seconds.values()):.0f} s, {len(digests(reference))} files and {REPORT}")
        print(f"{'build':>5}  {'kills':<{16 * options.each}}{'files':<15}{'half':>4}  identical", flush=True)
        rng = np.random.default_rng(options.seed)
        wanted = [ORDER[i % len(ORDER)] for i in range(options.kills)]
        builds = [sorted(wanted[i : i + options.each], key=STAGES.index) for i in range(0, len(wanted), options.each)]
        good = sum(
            run(options.capture, reference, Path(folder) / f"run{i}", names, rng, seconds)
            for i, names in enumerate(builds)
        )
        print(f"{options.kills} kills in {len(builds)} builds, {good} identical results")
    sys.exit(good != len(builds))


def run(
    capture: Path, reference: Path, out: Path, wanted: list[str], rng: np.random.Generator, seconds: dict[str, float]
) -> bool:
    """Kill one build, resume it to the end, print its row and return whether the result is the reference's."""
    exact = digests(reference)
    kills, files, half = [], [], []
    for stage in wanted:
        share, after_s = rng.uniform(0.02, 0.98), None
        while after_s is None:
            options = ["--resume"] if out.exists() else []
            after_s = disturbed(start_build(capture, out, *options), out, stage, share * seconds[stage])
            if after_s is None:  # faster than the reference, it ended before its kill
                shutil.rmtree(out)
                share *= 0.7
        there = digests(out)
        kills.append(f"{stage_now(out)} {after_s:.1f} s")
        files.append(str(len(there)))
        half += [name for name, found in there.items() if exact.get(name) != found]
    code, said = finish(start_build(capture, out, "--resume"))
    same = code == 0 and digests(out) == exact and records(out) == records(reference)
    same = same and (out / REPORT).is_file() and not unfinished(out) and not half
    word = "yes" if same else f"NO {said.strip()[-200:] if code else changed(out, reference)}"
    shown = "".join(f"{kill:<16}" for kill in kills)
    print(f"{out.name:>5}  {shown}{' '.join(files):<15}{len(half):>4}  {word}", flush=True)
    if same:
        shutil.rmtree(out)
    return same


def disturbed(process, out: Path, stage: str, delay_s: float) -> float | None:
    """Kill a build a while after a stage began; return the seconds since its start, None if it had ended before."""
    start = time.perf_counter()
    wait_for_stage(process, out, set(STAGES[: STAGES.index(stage)]))
    time.sleep(delay_s)
    after_s = time.perf_counter() - start
    return after_s if kill(process) else None


def stage_now(out: Path) -> str:
    """Return the stage that a killed build was working on."""
    return next((name for name in STAGES if name not in stages(out)), "end")


def changed(out: Path, reference: Path) -> str:
    """Return the names of what differs from the reference."""
    a, b = digests(out), digests(reference)
    files = [name for name in sorted(a | b) if a.get(name) != b.get(name)]
    c, d = records(out), records(reference)
    return ", ".join([*files, *(f"record of {name}" for name in sorted(c | d) if c.get(name) != d.get(name))])


if __name__ == "__main__":
    main()
