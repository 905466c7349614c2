"""Learn persons' jaws from their skin: python tests/benchmarks/skin.py [--persons 12] [--head 0 0]

Synthetic persons (`tests/support/skin_takes.py`): 40 points on the lower face follow the true jaw, whose motion is not
of the fitted form, with a lag, eight expressions, a drift of 0.2 mm and a noise of 0.3 mm. Learned on 92 s (exercises,
speech with the teeth visible, 2.5 s of occlusion), tested on 60 s of other speech behind closed lips. `--head` is the
error of head stabilisation in both [mm, degrees]. Without it, both 0 and 1 mm, 0.5 degrees are run.

    mean, p95, condyles   error at the incisal point and mean error of the condyles, after the bound [mm]
    z2                    mean squared error of d over its variance, 1 if sigmas are honest
    held out              mean error on held-out blocks of the calibration, as the fit states it
    chin, carried         errors of three chin points rigid with the bone, and of the last d of the calibration [mm]
    share                 mean over chin
    strange               frames flagged as unfamiliar: of other speech with the teeth visible (false alarms), of the
                          tested speech, and of speech with a strong expression that was not trained
    unrelated             error learned from another take's columns over that of the best guess; above 0.65 is refused
    every 2 s             mean, p95 and z2 behind closed lips if the lips part every 2 s and show the teeth in 3 frames,
                          fused as in `jawusd solve`; and the mean error of interpolation without skin
    live                  the same, one frame at a time as in `jawusd live`; and the mean error with the last d held
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
from functools import partial  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from skin_takes import Skin  # noqa: E402

import jawusd  # noqa: E402
from jawusd.base.errors import FittingError  # noqa: E402
from jawusd.evaluator.skin import SkinJaw  # noqa: E402
from jawusd.fitting import face as fitting  # noqa: E402
from jawusd.geometry import transform_points  # noqa: E402
from jawusd.tracking.performance import motion  # noqa: E402
from jawusd.tracking.performance.attempts import LARGEST_SIGMA  # noqa: E402
from jawusd.tracking.performance.skin import SLOW, SkinFactor, SkinFilter  # noqa: E402
from jawusd.tracking.performance.smoother import VARIANCE_RATIO  # noqa: E402
from jawusd.tracking.performance.system import TakeSystem  # noqa: E402

UNTRAINED = 4
FPS, PERIOD, PARTED, SEEN, SIGMA_MM = 24.0, 48, 9, (3, 6), 0.15


def main() -> None:
    """Print a table for each error of head stabilisation."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--persons", type=int, default=12)
    parser.add_argument("--head", type=float, nargs=2, action="append", metavar=("MM", "DEGREES"))
    options = parser.parse_args()
    people = [Skin(seed) for seed in range(options.persons)]
    for head in options.head or [(0.0, 0.0), (1.0, 0.5)]:
        print(f"head stabilisation {head[0]:g} mm, {head[1]:g} degrees")
        print(
            "person  mean   p95  condyles    z2  held out   chin  carried  share        strange      unrelated"
            "              every 2 s                 live"
        )
        rows = np.array([scores(skin, tuple(head)) for skin in people])
        for seed, row in enumerate(rows):
            print(f"{seed:6d}  {line(row)}")
        print(f"  mean  {line(rows.mean(axis=0))}\n worst  {line(rows.max(axis=0))}")


def line(row: np.ndarray) -> str:
    """Return one row of the table."""
    form = "{:4.2f}  {:4.2f}  {:8.2f}  {:4.2f}  {:8.2f}  {:5.2f}  {:7.2f}  {:5.2f}  {:5.3f} {:4.2f} {:4.2f}  {:12.2f}"
    form += 2 * "  {:4.2f} {:4.2f} {:4.2f} {:5.2f}"
    return form.format(*row)


def scores(person: Skin, head: tuple[float, float]) -> list[float]:
    """Return the columns of the table for one person."""
    rig, frames = person.rig, np.arange(0, 1440, 10)
    X, d, seen = person.calibration(head=head)
    skin = jawusd.fit_skin(rig, X, d, seen, 0.15)
    Z, T = person.closed_speech(head=head)
    found, true = skin(Z), rig.encode(T).d
    error = person.errors_mm(rig.project(found.d), T)
    z2 = np.mean((found.d - true) ** 2 / np.einsum("fii->fi", found.covariance))
    T_skull_face, on_bone, chosen = fitting.on_bone(rig, X[seen][::4], rig.pose(d[seen][::4]))
    chin = rig.ik(on_bone, transform_points(T_skull_face, Z[frames][:, chosen])).d
    chin_mm = person.errors_mm(chin, T[frames])[:, 0].mean()
    carried = person.errors_mm(np.broadcast_to(d[seen][-1], true.shape), T)[:, 0].mean()
    strange = [1 - skin(take).familiar.mean() for take in (person.open_speech(head=head)[0], Z)]
    narrow, d_narrow, seen_narrow = person.calibration(head=head, away=(UNTRAINED,))
    less = jawusd.fit_skin(rig, narrow, d_narrow, seen_narrow, 0.15)
    strange.append(1 - less(person.closed_speech(head=head, strong=(UNTRAINED,))[0]).familiar.mean())
    mean = error[:, 0].mean()
    return [
        *(mean, np.quantile(error[:, 0], 0.95), error[:, 3:].mean(), z2, skin.meta["errors_mm"]["skin"]),
        *(chin_mm, carried, mean / chin_mm, *strange, unrelated(rig, X, d, seen)),
        *every_2_s(person, skin, head),
    ]


def every_2_s(person: Skin, skin: jawusd.evaluator.skin.Skin, head: tuple[float, float]) -> list[float]:
    """Return mean, p95, z2 with skin, and the mean without, of closed lips that part every 2 s; in a take, and live."""
    rng = np.random.default_rng([4, 0x2AC])
    phase = np.arange(1440) % PERIOD
    closed, seen = phase >= PARTED, (phase >= SEEN[0]) & (phase < SEEN[1])
    T = person.speech(len(phase), rng)
    true, by_skin = person.rig.encode(T).d, skin(person.points(T, rng, closed.astype(float), head=head))
    measured = true + SIGMA_MM * rng.normal(size=true.shape)
    none = by_skin._replace(d=np.full_like(true, np.nan))
    row: list[float] = []
    for solved in (partial(fused, person.rig), followed):
        found, variance = solved(measured, seen, by_skin)
        held = solved(measured, seen, none)[0]
        error, without = (person.errors_mm(person.rig.project(d), T)[closed, 0] for d in (found, held))
        z2 = ((found - true) ** 2 / variance)[closed].mean()
        row += [error.mean(), np.quantile(error, 0.95), z2, without.mean()]
    return row


def followed(d: np.ndarray, seen: np.ndarray, by_skin: SkinJaw) -> tuple[np.ndarray, np.ndarray]:
    """Return d and its variances (F, 3) from d of frames with visible teeth, and skin, as it arrives."""
    slow, found, variance = SkinFilter(), np.zeros_like(d), np.full_like(d, LARGEST_SIGMA[6] ** 2)
    step = (VARIANCE_RATIO * motion._MISS[6]) ** 2
    for k in range(len(d)):
        start = d[k] if seen[k] else found[k - 1]
        size = np.full(3, SIGMA_MM**2) if seen[k] else np.minimum(variance[k - 1] + step, LARGEST_SIGMA[6] ** 2)
        jaw = SkinJaw(*(part[k] for part in by_skin))
        found[k], covariance, _ = slow.fuse(jaw, start, np.diag(size), seen=bool(seen[k]), seconds=1 / FPS)
        variance[k] = np.diag(covariance)
    return found, variance


def fused(rig: jawusd.JawRig, d: np.ndarray, seen: np.ndarray, by_skin: SkinJaw) -> tuple[np.ndarray, np.ndarray]:
    """Return d and its variances (F, 3) from d of frames with visible teeth, skin, and the smoother's motion prior."""
    system, usual = TakeSystem(len(d), 3 + SLOW, 0), motion._of_rig(rig, FPS)
    for k in np.flatnonzero(seen):
        system.add_frame(k, np.diag([SIGMA_MM**-2.0] * 3 + [0.0] * SLOW), np.r_[d[k] / SIGMA_MM**2, np.zeros(SLOW)])
    factor = SkinFactor(by_skin, FPS)
    zero = np.zeros_like(d)
    factor.add(system, zero, zero, 0)
    jaw, gap = slice(0, 3), ~(seen | factor.familiar)
    system.add_bends(jaw, zero[2:], 1.0 / (motion._LOOSE * usual))
    system.add_steps(jaw, zero[1:], (gap[1:] | gap[:-1])[:, None] / (25 * usual))
    return system.solve()[0][:, :3], np.einsum("fii->fi", system.covariance().own)[:, :3]


def unrelated(rig: jawusd.JawRig, X: np.ndarray, d: np.ndarray, seen: np.ndarray) -> float:
    """Return the error over that of the best guess, of a fit whose face plays 20 s late."""
    share, fitting._MOST_SHARE = fitting._MOST_SHARE, np.inf
    try:
        errors = jawusd.fit_skin(rig, np.roll(X, 480, axis=0), d, seen, 0.15).meta["errors_mm"]
    except FittingError:
        return np.inf
    finally:
        fitting._MOST_SHARE = share
    return errors["skin"] / min(value for name, value in errors.items() if name != "skin")


if __name__ == "__main__":
    main()
