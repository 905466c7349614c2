"""Watch what is opened over hostile rigs: python tests/benchmarks/reach.py [--rigs 300] [--seed 1]. Needs strace.

`jawusd info`, `validate`, `animate` and `view` (started and stopped) run over rigs whose layers are made from the
grammar of USD, or damaged, in one process that strace watches with all its children. Listed are calls of open and
connect that name anything but the rig's own folder, the package, the interpreter and the files of the system; of
`view`, anything but this machine.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from reach_driver import STRACE, watch, write_rigs


def main() -> None:
    """Run the commands and print what reached out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1, help="of the first rig")
    options = parser.parse_args()
    if STRACE is None:
        sys.exit("strace is not installed: nothing was watched.")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch).resolve() / "rigs"
        folder.mkdir()
        write_rigs(folder, options.rigs, options.seed)
        found, counts = watch(folder)
    print(counts.strip())
    print(f"{len(found)} calls reached out")
    for (step, call), times in Counter((step, call.split(" ", 1)[1]) for _, step, call in found).most_common(20):
        print(f"{times:>6} {step:<9} {call:.200}")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
