"""Run jawusd and others on data that nobody here made: python tests/benchmarks/real --data DIR [--only SECTION ...]

DIR holds clones of the repositories that --list names. Tables are Markdown; plots and pictures go to --out. Every
figure but seconds is the same in every run on one machine. What each table says, and what it cannot say: README.md
beside this file.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the other benchmarks

from sources import SOURCES, listing  # noqa: E402

SECTIONS = ("markers", "models", "patients", "scanner", "peers", "face")


def main() -> None:
    """Run the sections that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", action="store_true", help="say which repositories to clone, and under which licence")
    parser.add_argument("--data", type=Path, help="folder of the clones")
    parser.add_argument("--captures", type=Path, nargs="*", default=[], help="captures with truth, for the peers")
    parser.add_argument("--m3t", type=Path, help="a program that runs M3T as README.md says, for the peers")
    parser.add_argument("--mediapipe", type=Path, help="Python of an environment with mediapipe 0.10.21, for the face")
    parser.add_argument("--frames", type=int, default=24, help="of each capture, for the peers")
    parser.add_argument("--only", nargs="*", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--out", type=Path, default=Path("real_out"), help="folder of plots and pictures")
    given = parser.parse_args()
    if given.list:
        print(listing())
        return
    if given.data is None:
        parser.error("--data DIR is needed; --list says what belongs there.")
    for source in SOURCES:
        source.found(given.data)
    for section in given.only:
        run(section, given)


def run(section: str, given: argparse.Namespace) -> None:
    """Run one section; each imports what it needs."""
    if section in ("markers", "models"):
        import motion

        (motion.poses_against_the_maker if section == "markers" else motion.models)(given.data, given.out)
    elif section == "patients":
        import patients

        patients.run(given.data, given.out)
    elif section == "scanner":
        import scanner

        scanner.run(given.data, given.out)
    elif section == "face":
        import face

        face.run(given.captures, given.mediapipe)
    else:
        import peers

        peers.run(given.captures, given.frames, given.m3t)


if __name__ == "__main__":
    main()
