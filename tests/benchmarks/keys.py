"""Random keys brought inside the bound: how fast, how far beyond the keys, how deep, and how long it takes.

    python tests/benchmarks/keys.py [RIG ...] [--sets 200]

For the example rig, the same with a waist, and every rig named: sets of three to seven random keys, inside the ranges
and up to 30 % beyond them, joined by straight lines and by smooth curves, brought inside as `jawusd animate` does.
Columns: largest step over the largest step of the keys' own curve (numpy, scipy); the largest of the same by frame;
smallest margin at ten times the frame rate; the largest way beyond the keys' range of motions that the bound lets stay
within; the share of sets that it does not (more than 0.05 mm beyond, and at some opening on the way nothing in the
range is inside), and the largest way of those; how far keys that are inside were moved at most; ms per set.
The last columns are what the nearest valid point of every frame does: largest step over that of the keys' own.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from example_model import example_arrays, example_meta
from key_sets import hollow_rig, measured, own_curve, random_keys

from jawusd.evaluator import JawRig
from jawusd.pipeline.library import load_any_rig

EXAMPLES = {
    "(20, 6, 0) to (20, 11, 0)": ([0.0, 100.0], [[20.0, 6, 0], [20, 11, 0]]),
    "d1 0, 20, 20, 5": ([0.0, 10, 30, 40], [[0.0, 0, 0], [20, 0, 0], [20, 0, 0], [5, 0, 0]]),
    "a hold at the closed bite": ([0.0, 10, 30, 40], [[10.0, 0, 0], [0, 0, 0], [0, 0, 0], [15, 0, 0]]),
}


def projected(rig, frames, keys, method):
    """Return the largest step of the frames' nearest valid points over the largest of the keys' own curve."""
    own = own_curve(frames, keys, np.arange(frames[0], frames[-1] + 1), method)
    steps = [np.linalg.norm(np.diff(d, axis=0), axis=1).max() for d in (rig.project(own), own)]
    return steps[0] / steps[1]


def print_row(name, method, found, seconds, nearest):
    """Print one line of the table."""
    f = np.array(found)
    forced = f[:, 5] > 0
    beyond = f"{f[~forced, 3].max(initial=0.0):7.3f} {forced.mean():6.3f} {f[forced, 3].max(initial=0.0):6.2f}"
    print(
        f"{name:34s} {method:6s} {f[:, 0].max():6.3f} {f[:, 1].max():6.3f} {f[:, 2].min():10.2e} {beyond} "
        f"{f[:, 4].max():7.3f} {1e3 * seconds / len(f):6.0f} {max(nearest):8.2f}"
    )


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rigs", nargs="*", type=Path)
    parser.add_argument("--sets", type=int, default=200)
    options = parser.parse_args()
    rigs = {"example": JawRig(example_arrays(), example_meta()), "example with a waist": hollow_rig()}
    rigs |= {rig.actor or path.stem: rig for path, rig in ((path, load_any_rig(path)) for path in options.rigs)}
    head = ("keys", "", "step", "frame", "margin", "beyond", "forced", "by", "missed", "ms", "nearest")
    print("{:34s} {:6s} {:>6s} {:>6s} {:>10s} {:>7s} {:>6s} {:>6s} {:>7s} {:>6s} {:>8s}".format(*head))
    for name, rig in rigs.items():
        for method in ("linear", "smooth"):
            for label, (frames, keys) in EXAMPLES.items():
                began = time.perf_counter()
                found = measured(rig, np.array(frames), np.array(keys), method)
                seconds = time.perf_counter() - began
                nearest = projected(rig, np.array(frames), np.array(keys), method)
                print_row(f"{name}: {label}", method, [found], seconds, [nearest])
            for spread, label in ((0.0, "in the ranges"), (0.3, "beyond")):
                sets = [random_keys(rig, seed, spread) for seed in range(options.sets)]
                began = time.perf_counter()
                found = [measured(rig, *keys, method) for keys in sets]
                seconds = time.perf_counter() - began
                nearest = [projected(rig, *keys, method) for keys in sets]
                print_row(f"{name}: {len(sets)} {label}", method, found, seconds, nearest)


if __name__ == "__main__":
    main()
