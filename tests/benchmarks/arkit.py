"""Learn persons' jaws from ARKit weights: python tests/benchmarks/arkit.py [--persons 12]

Synthetic persons perform 35 s of exercises, captured by jaw (noisy poses, 24 fps) and face (60 fps). The weights come
from the chin's place in the skull, with gains, cross-talk, resting values, dead zones and noise of the person; the fit
knows none of it, and clocks are 1.7 s apart. Scored on other exercises (2,000 frames): mean error of the incisal point
[mm], after the bound, of fixed shares, and of what `arkit-fit` learns from the four jaw weights; beside it what the fit
itself expected.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from face_takes import JAW_FPS, Performer  # noqa: E402

from jawusd.formats.arkit import shares_of  # noqa: E402
from jawusd.pipeline.skin import SIGMA_MM, JawTake, learn_skin  # noqa: E402

APART_S = 1.7


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--persons", type=int, default=12)
    ratios = []
    print("person  shares  learned  ratio  expected  clocks off [ms]")
    for seed in range(parser.parse_args().persons):
        performer = Performer(seed)
        face, _, measured = performer.perform("training")
        d = performer.rig.encode(measured).d
        frames, seen = np.arange(len(d)) + APART_S * JAW_FPS, np.isfinite(d).all(axis=1)
        take = JawTake(frames, d, seen, np.full(d.shape, SIGMA_MM), JAW_FPS)
        skin, offset_s = learn_skin(performer.rig, take, face)
        other, truth, _ = performer.perform("hidden", 2000, 2)
        times = other.frames / other.fps
        shares = performer.incisal_error(performer.rig.denormalized(shares_of(other.X)), times, truth)
        learned = performer.incisal_error(skin(other.X).d, times, truth)
        ratios.append(learned / shares)
        apart = f"{skin.errors_mm['skin']:8.2f}  {1000 * (offset_s - APART_S):8.1f}"
        print(f"{seed:6d}  {shares:6.2f}  {learned:7.2f}  {ratios[-1]:5.2f}  {apart}")
    print(f"ratio: mean {np.mean(ratios):.2f}, worst {max(ratios):.2f}")


if __name__ == "__main__":
    main()
