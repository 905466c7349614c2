"""Watch what is opened over hostile rigs: python tests/benchmarks/reach.py [--rigs 300] [--seed 1]. Needs strace.

`jawusd info`, `validate`, `animate` and `view` (started and stopped) run over rigs whose layers are made from the
grammar of USD, or damaged, in one process that strace watches with all its children. Listed are calls of open and
connect that name anything but the rig's own folder, the package, the interpreter and the files of the system; of
`view`, anything but this machine.

Shots, unlike rigs, may name a rig elsewhere: a layer that they name is opened to see whether it is one. Such calls are
counted apart.
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
    asked = [(step, call) for _, step, call in found if "/outside.usda" in call and "O_RDONLY" in call]
    rest = [(step, call) for _, step, call in found if (step, call) not in asked]
    print(f"{len(asked)} calls asked whether a layer that a shot names is a rig; {len(rest)} others reached out")
    for (step, call), times in Counter((step, call.split(" ", 1)[1]) for step, call in rest).most_common(20):
        print(f"{times:>6} {step:<9} {call:.200}")
    sys.exit(bool(rest))


if __name__ == "__main__":
    main()
