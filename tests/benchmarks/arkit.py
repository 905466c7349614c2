"""Learn persons' mappings from ARKit weights to d: python tests/benchmarks/arkit.py [--persons 12]

Synthetic persons perform 35 s of exercises, captured by jaw (noisy poses, 24 fps) and face (60 fps). The weights come
from the chin's place in the skull, with gains, cross-talk, resting values, dead zones and noise of the person; the fit
knows none of it, and clocks are 1.7 s apart. Scored on other exercises (2,000 frames): mean error of the incisal point
[mm], after the bound, of fixed shares, of the mapping, and of what `fit_skin` learns from the same four weights; beside
it what the fit of the mapping itself expected.
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

import jawusd  # noqa: E402
from jawusd.fitting.face import columns_at, fit_arkit  # noqa: E402
from jawusd.formats.arkit import shares_of  # noqa: E402

APART_S = 1.7


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--persons", type=int, default=12)
    ratios, offsets, skins = [], [], []
    print("person  shares  mapping  ratio  skin  ratio  expected  clocks off [ms]")
    for seed in range(parser.parse_args().persons):
        performer = Performer(seed)
        face, _, measured = performer.perform("training")
        d, _ = performer.rig.encode(measured)
        fit = fit_arkit(performer.rig, face, np.arange(len(d)) / JAW_FPS + APART_S, d)
        other, truth, _ = performer.perform("hidden", 2000, 2)
        times = other.frames / other.fps
        shares = performer.incisal_error(performer.rig.denormalized(shares_of(other.weights)), times, truth)
        own = performer.incisal_error(fit.mapping.d(other.weights), times, truth)
        ratios.append(own / shares)
        weights = columns_at(face.frames / face.fps, face.weights, np.arange(len(d)) / JAW_FPS)
        skin = jawusd.fit_skin(performer.rig, weights, d, np.isfinite(d).all(axis=1))
        by_skin = performer.incisal_error(skin(other.weights).d, times, truth)
        skins.append(by_skin / shares)
        offsets.append(1000 * (fit.offset_s - APART_S))
        learned = f"{own:7.2f}  {ratios[-1]:5.2f}  {by_skin:4.2f}  {skins[-1]:5.2f}"
        print(f"{seed:6d}  {shares:6.2f}  {learned}  {fit.error_mm:8.2f}  {offsets[-1]:8.1f}")
    print(f"ratio: mean {np.mean(ratios):.2f}, worst {max(ratios):.2f}")
    print(f"ratio of the skin: mean {np.mean(skins):.2f}, worst {max(skins):.2f}")


if __name__ == "__main__":
    main()
