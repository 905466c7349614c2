"""Damage files and read them, reader by reader: python tests/benchmarks/fuzz.py [--inputs 20000] [--seed 1].

Valid files of every format are damaged (bytes, words, numbers, paths, structure; see tests/support/fuzz_mutate.py and
fuzz_structures.py), or made from the grammar of USD and from schemas (fuzz_grammar.py), and read in a worker process
that may use 2 GB of address space. One row per reader:

    accepted, refused   the input was read, or ended in a JawusdError
    ended               the copy of the worker that reads USD was ended by a signal: one message of a command
    tracebacks          ended in any other exception, or killed the process (crashes: how many of them)
    hangs               more than 10 s of processor time, or 180 s of waiting
    memory              largest resident memory of the process while reading [MB], about 300 of it before it reads
    slowest             processor time of the slowest input [s]
    escapes             a file beside the input's folder was changed or opened as a layer, or Python was asked to write
                        outside it, to start a program, to connect, or to unpickle
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from fuzz_driver import READERS, run

# Text formats and archives are read in a millisecond or two; these take longer or are read by careful libraries.
FEWER = {"video masks": 0.5, "ARKit CSV": 0.5, "usdz": 0.4, "ONNX": 0.4, "PNG masks": 0.8, "usda": 0.5, "usdc": 0.5,
         "USD grammar": 0.5}  # fmt: skip


def main() -> None:
    """Run the series and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1, help="of the first input of every reader")
    parser.add_argument("--readers", nargs="*", default=READERS, choices=READERS, metavar="READER")
    options = parser.parse_args()
    shares = {reader: FEWER.get(reader, 1.0) for reader in options.readers}
    counts = {reader: -int(-options.inputs * share // sum(shares.values())) for reader, share in shares.items()}
    title = f"{'reader':<14}{'inputs':>7}{'accepted':>9}{'refused':>8}{'ended':>6}{'tracebacks':>11}{'(crashes)':>10}"
    print(f"{title}{'hangs':>6}{'memory':>8}{'slowest':>8}{'escapes':>8}", flush=True)
    bad = []
    with tempfile.TemporaryDirectory() as folder:
        for reader, found in run(Path(folder) / "work", counts, options.seed):
            bad += [(reader, *fault) for fault in found.bad]
            row = f"{reader:<14}{counts[reader]:>7}{found.accepted:>9}{found.refused:>8}{found.ended:>6}"
            row += f"{found.traceback + found.crash:>11}{found.crash:>10}{found.hang:>6}"
            print(f"{row}{found.peak_mb:>8.0f}{found.seconds:>8.1f}{found.escape:>8}", flush=True)
    print(f"{sum(counts.values())} inputs, {len(bad)} faults")
    for reader, seed, outcome, error in bad:
        print(f"\n{reader}, seed {seed}: {outcome}\n{error}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
