"""Check and track many synthetic persons: python tests/benchmarks/population.py --persons 100 [--jobs 2] [--faults].

Persons, scanners, annotators and cameras over the human range (`subjects.short_capture`): each capture goes
through `jawusd check` and `jawusd track` and is compared with its truth. Printed are

    refused     valid captures that were refused, with the messages
    warned      valid captures with each kind of finding: the false-alarm rate of that kind
    errors      vertices per arch and the incisal point: median and 95th percentile over persons of the mean over
                frames; lost, gross: share of frames without a pose, or more than 0.5 mm wrong; silent: of gross ones
                without a flag (plainly tracked, sigma below 0.25 mm)
    ratio       error of the vertices (median over frames of their rms) over the Cramer-Rao bound by the wobble of
                the annotator, whose habits the take must tell; the worse arch. known: over the lower bound for habits
                that are known, which no tracker of masks can reach
    shift       median over frames of the error along each anatomical axis: share of persons within 0.02 mm. at bound:
                the same, and the ratio, of errors drawn from the normal distribution with the bound's covariance:
                what an estimator that makes the most of these masks would show
    NEES        normalised squared error of the poses over 6, mean over frames that are not grossly wrong and over
                persons: 1 when sigmas are honest
    faults      per planted fault, over a quarter of the persons: refused or flagged with the right cause; with a wrong
                one only; not at all; and of these how many were wrong by less than 0.1 mm at the incisal point all the
                same
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))
from population_faults import FAULTS, NotPossible
from population_score import AXES, ROWS, STEADY_MM, Outcome, run
from subjects.short_capture import ShortConfig, write_short_capture

#: Seed, fault or -1, frames, share of scans without paint, folder of the captures.
Task = tuple[int, int, int, float, Path]

HARMLESS_MM = 0.1


def main() -> None:
    """Run the persons and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first person; the others follow")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--unpainted", type=float, default=0.0, help="share of scans without paint")
    parser.add_argument("--faults", action="store_true", help="plant faults as well")
    parser.add_argument("--only", default="", help="pattern of the faults' names")
    parser.add_argument("--each", type=int, help="persons per fault, a quarter of all if not given")
    parser.add_argument("--out", type=Path, help="folder to keep outcomes (JSON lines) in")
    parser.add_argument("--captures", type=Path, help="folder to keep the captures in, and to take them from")
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.persons)
    with contextlib.ExitStack() as stack:
        folder = options.captures or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="jawusd_persons_")))
        measure(options, seeds, (options.frames, options.unpainted, folder))


def measure(options: argparse.Namespace, seeds: Iterable[int], config: tuple[int, float, Path]) -> None:
    """Run valid and spoilt captures and print."""
    valid = collect([(seed, -1, *config) for seed in seeds], options, "valid")
    valid.sort(key=lambda o: o.seed)
    report(valid)
    if options.faults:
        usable = [o.seed for o in valid if not o.refused]
        each = options.each or max(1, options.persons // 4)
        before = {o.seed: {kind for kind, _, _ in o.findings} for o in valid}
        chosen = [k for k, fault in enumerate(FAULTS) if re.search(options.only, fault.name)]
        tasks = [(seed, k, *config) for i, k in enumerate(chosen) for seed in _part(usable, i, each)]
        report_faults(collect(tasks, options, "faults"), before)


def _part(seeds: list[int], index: int, count: int) -> list[int]:
    """Return so many seeds, others for every index."""
    if not seeds:
        return []
    return list(dict.fromkeys(seeds[(index * 7 + i) % len(seeds)] for i in range(count)))


def one(task: Task) -> Outcome | None:
    """Write, spoil, track and score one capture; None if the fault cannot be planted into it."""
    seed, fault, frames, unpainted, captures = task
    cv2.setNumThreads(1)
    valid = captures / f"person_{seed}_{frames}_{unpainted:g}"
    if not (valid / "capture.toml").exists():  # written last
        write_short_capture(valid, ShortConfig(seed, frames, unpainted))
    if fault < 0:
        return run(valid, seed)
    with tempfile.TemporaryDirectory(prefix=f"jawusd_fault_{fault}_") as folder:
        spoilt = shutil.copytree(valid, Path(folder) / "capture")
        try:
            FAULTS[fault].plant(spoilt, np.random.default_rng([seed, fault]))
        except NotPossible:
            return None
        outcome = run(spoilt, seed)
        outcome.groups["fault"] = FAULTS[fault].name
        return outcome


def collect(tasks: list[Task], options: argparse.Namespace, name: str) -> list[Outcome]:
    """Return the outcomes of all tasks; progress goes to stderr."""
    start, out = time.perf_counter(), []
    with ProcessPoolExecutor(options.jobs) as pool:
        for done, future in enumerate(as_completed([pool.submit(one, task) for task in tasks]), 1):
            outcome = future.result()
            if outcome is not None:
                out.append(outcome)
                if options.out:
                    options.out.mkdir(parents=True, exist_ok=True)
                    with open(options.out / f"{name}.jsonl", "a") as lines:
                        lines.write(json.dumps(asdict(outcome)) + "\n")
            print(f"\r{name}: {done} of {len(tasks)}, {time.perf_counter() - start:.0f} s", end="", file=sys.stderr)
    print(file=sys.stderr)
    return out


def report(outcomes: list[Outcome]) -> None:
    """Print the tables of the valid captures."""
    refused = [o for o in outcomes if o.refused]
    print(f"{len(outcomes)} valid persons, {len(refused)} refused")
    for o in refused:
        print(f"  person {o.seed} ({o.groups['bite']}, {o.groups['gums']}), {o.refused_by}: {o.refused[:230]}")
    print("warned:")
    kinds = Counter((kind, severity) for o in outcomes for kind, severity in {(k, s) for k, s, _ in o.findings})
    for (kind, severity), count in kinds.most_common():
        print(f"  {kind:<30}{severity:<9}{count:4d}  {100 * count / len(outcomes):5.1f} %")
    scored = [o for o in outcomes if "vertices upper" in o.figures]
    head = ("n", "lost", "gross", "silent", "upper", "p95", "lower", "p95", "incisor", "p95", "ratio", "known")
    heads = (*head, "shift u", "shift l", "shift r", "NEES u", "NEES l", "NEES r")
    print(f"{'':<26}" + "".join(f"{name:>8}" for name in heads))
    for name, group in grouped(scored):
        print(f"{name:<26}" + row(group))
    print("steady shift, share within 0.02 mm (and median size [mm]) along " + ", ".join(AXES))
    for part in (*ROWS, "relative"):
        shift = np.abs([o.vectors[f"shift {part}"] for o in scored])
        cells = [f"{100 * (c <= STEADY_MM).mean():5.0f} % ({np.median(c):.3f})" for c in shift.T]
        print(f"  {part:<12}" + "  ".join(cells))
        least = np.mean([o.vectors[f"efficient shift {part}"] for o in scored], axis=0)
        print(f"  {'at bound':<12}" + "  ".join(f"{100 * share:5.0f} %        " for share in least))
    drawn = np.concatenate([o.vectors["efficient ratio"] for o in scored])
    print(f"ratio of an estimator at the bound: median {np.median(drawn):.2f}")


def grouped(outcomes: list[Outcome]) -> Iterable[tuple[str, list[Outcome]]]:
    """Yield everything, then each group by what it shares."""
    yield "all", outcomes
    for key in ("bite", "gums", "cameras", "annotator", "lips", "scan", "height"):
        for value in sorted({o.groups[key] for o in outcomes}):
            yield f"{key} {value}", [o for o in outcomes if o.groups[key] == value]


def row(group: list[Outcome]) -> str:
    """Return the figures of a group of persons as text."""

    def figures(name: str) -> np.ndarray:
        return np.array([o.figures[name] for o in group])

    cells = [f"{len(group):8d}", *(f"{100 * figures(name).mean():7.1f}%" for name in ("lost", "gross", "silent"))]
    for name in ("vertices upper", "vertices lower", "incisor"):
        cells += [f"{np.median(figures(name)):8.3f}", f"{np.percentile(figures(name), 95):8.3f}"]
    cells += [f"{np.median(figures(name)):8.2f}" for name in ("ratio", "ratio known")]
    for part in (*ROWS, "relative"):
        steady = [np.abs(o.vectors[f"shift {part}"]).max() <= STEADY_MM for o in group]
        cells.append(f"{100 * np.mean(steady):7.0f}%")
    cells += [f"{np.nanmean(figures(f'nees {part}')):8.2f}" for part in (*ROWS, "relative")]
    return "".join(cells)


def verdict(outcome: Outcome, cause: str, before: set[str]) -> str:
    """Return what was said of a planted fault: found, wrong cause or missed."""
    if outcome.refused:
        return "found" if re.search(cause, outcome.refused, re.IGNORECASE) and not outcome.crashed else "wrong cause"
    new = [(kind, severity, line) for kind, severity, line in outcome.findings if kind not in before]
    # A kind that the same person's valid capture carries too says nothing of the fault.
    if any(re.search(cause, f"{kind} {line}", re.IGNORECASE) for kind, _, line in new):
        return "found"
    return "wrong cause" if any(severity in ("warning", "error") for _, severity, _ in new) else "missed"


def report_faults(outcomes: list[Outcome], before: dict[int, set[str]]) -> None:
    """Print how many of each planted fault were found."""
    heads = f"{'n':>4}{'found':>8}{'wrong':>7}{'missed':>8}{'harmless':>9}{'incisor':>9}   said most often"
    print(f"{'planted fault':<40}{heads}")
    for fault in FAULTS:
        own = [o for o in outcomes if o.groups["fault"] == fault.name]
        if not own:
            continue
        verdicts = Counter(verdict(o, fault.cause, before.get(o.seed, set())) for o in own)
        silent = [o for o in own if verdict(o, fault.cause, before.get(o.seed, set())) == "missed"]
        errors = np.array([o.figures.get("incisor", np.nan) for o in own])
        harmless = sum(o.figures.get("incisor", 9.0) < HARMLESS_MM for o in silent)
        said = Counter(o.refused[:70] or ", ".join(sorted({k for k, _, _ in o.findings})) or "-" for o in own)
        typical = f"{np.nanmedian(errors):9.2f}" if np.isfinite(errors).any() else f"{'':>9}"
        share = 100 * verdicts["found"] / len(own)
        print(
            f"{fault.name:<40}{len(own):4d}{share:7.0f}%{verdicts['wrong cause']:7d}{verdicts['missed']:8d}"
            f"{harmless:9d}{typical}   {said.most_common(1)[0][0]}"
        )


if __name__ == "__main__":
    main()
