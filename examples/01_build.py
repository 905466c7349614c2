"""Build a rig from a capture and decide whether it is good enough: python examples/01_build.py [CAPTURE] [-o out]

The same as `jawusd build CAPTURE -o out`, from Python, with the question a TD asks afterwards: is this rig good enough
to work with? The exit code is 0 if it is.
"""

import argparse
import sys
from pathlib import Path

from jawusd.pipeline.build import BuildOptions, build

HOLDOUT_LIMIT_MM = 1.0  # distance of the farthest mandible vertex, mean over poses the model was not fitted to


def show(stage: str, done: int, total: int) -> None:
    """Print the end of every stage on stderr."""
    if done == total:
        print(f"{stage}: done", file=sys.stderr)


def main() -> int:
    """Build, print what matters, and judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", nargs="?", type=Path, default=Path(__file__).parent / "capture")
    parser.add_argument("-o", "--out", type=Path, default=Path("out"))
    parser.add_argument("--resume", action="store_true", help="Continue an earlier build in the folder.")
    options = parser.parse_args()
    summary = build(options.capture, options.out, BuildOptions(resume=options.resume), show)
    tracked, fitted = summary["track"], summary["fit"]
    print(f"tracked {tracked['tracked']} of {tracked['frames']} frames, lost {tracked['lost'] or 'none'}")
    for name, (low, high) in fitted["ranges_mm"].items():
        print(f"{name}: {low:.1f} .. {high:.1f} mm")
    for warning in fitted["warnings"]:
        print(f"warning: {warning['message']}")
    if "holdout" not in fitted["errors"]:
        print("the take is too short to leave parts of it out: nothing says how good the model is")
        return 1
    error_mm = fitted["errors"]["holdout"]["mandible"]["mean"]
    good = error_mm <= HOLDOUT_LIMIT_MM
    words = "good enough" if good else "NOT good enough"
    print(f"poses left out of the fit, farthest mandible vertex: {error_mm:.2f} mm on average, {words}")
    print(f"open {options.out / 'report.html'} and {options.out / 'actor.usda'}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
