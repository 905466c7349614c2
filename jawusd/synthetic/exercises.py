"""Jaw exercises as control curves, and recordings of a subject who performs them.

Speeds and amplitudes follow chewing and clinical exercise data: chewing cycles of 0.6 to 1 s and 15 to 20 mm, border
movements of 3 to 4 s, all at 24 frames per second.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.geometry import make_transform, so3_exp
from jawusd.synthetic.kinematics import smoothstep
from jawusd.synthetic.person import Person

Kind = Literal["training", "hidden"]

# Sequences of exercises, repeated until the recording is long enough.
_SCHEDULES: dict[str, tuple[str, ...]] = {
    "training": (
        "open", "lateral", "protrude", "open", "lateral", "sagittal border", "lateral half open",
        "protrude half open", "frontal border", "frontal border", "chew", "chew", "chew", "chew", "speech",
        "open", "protrude", "lateral half open", "lateral", "chew", "speech", "protrude half open",
        "sagittal border", "open",
    ),
    "hidden": (
        "open", "lateral", "protrude", "sagittal border", "lateral half open", "protrude half open",
        "frontal border", "chew", "chew", "speech", "explore", "explore",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """Recorded exercises of a subject; all poses are T_skull_mandible, shape (F, 4, 4)."""

    controls: Array  # opening 0..1, lateral -1..1, protrusion -1..1, shape (F, 3)
    phase: NDArray[np.str_]  # name of the exercise of each frame, shape (F,)
    T_true: Array  # poses of the controls with small movements outside them
    T_noisy: Array  # `T_true` with tracking noise


def record(person: Person, n_frames: int, seed: int, kind: Kind = "training", noise_scale: float = 1.0) -> Recording:
    """Record the exercises of a subject at 24 frames per second.

    Args:
        n_frames: number of frames; the paper trained on 833.
        kind: "training": clinical exercises, chewing and speech; "hidden": a different order, other amplitudes and
            random motion through the whole envelope, to test models fitted to "training".
        noise_scale: factor on the tracking noise.

    Raises:
        ValueError: the kind is unknown or there is less than one frame.
    """
    if kind not in _SCHEDULES:
        raise ValueError(f"kind must be one of {sorted(_SCHEDULES)}, got {kind!r}")
    rng = np.random.default_rng([seed, person.seed, len(kind)])
    curves, phase = schedule(_SCHEDULES[kind], n_frames, rng)
    unintended = smooth_noise(rng, n_frames, 10.0, 3) * [0.006, 0.04, 0.04]
    controls = person.limit(curves + unintended)
    extra_mm = smooth_noise(rng, n_frames, 8.0, 3) * [person.noise.side_mm, person.noise.lift_mm, person.noise.lift_mm]
    T_true = person.pose_with_extra(controls, extra_mm)
    return Recording(controls, phase, T_true, _with_tracking_noise(person, T_true, rng, noise_scale))


def schedule(
    names: tuple[str, ...], n_frames: int, rng: np.random.Generator, tempo: float = 1.0
) -> tuple[Array, NDArray[np.str_]]:
    """Concatenate exercises, repeating them until all frames are filled; `tempo` does not apply to chewing and speech.

    Return controls with smoothed transitions, shape (F, 3), and the exercise of each frame, shape (F,).

    Raises:
        ValueError: there is less than one frame.
    """
    if n_frames < 1:
        raise ValueError(f"a recording needs at least one frame, got {n_frames}")
    curves: list[Array] = []
    phase: list[str] = []
    while len(phase) < n_frames:
        name = names[len(curves) % len(names)]
        curve = np.stack(_EXERCISES[name](rng), -1)
        curves.append(curve if name in ("chew", "speech") else _faster(curve, tempo))
        phase += [name] * len(curves[-1])
    return smoothed(np.concatenate(curves)[:n_frames]), np.array(phase[:n_frames])


def smooth_noise(rng: np.random.Generator, n_frames: int, frames: float, n: int) -> Array:
    """Return n random curves of unit variance with a given correlation time [frames], shape (n_frames, n)."""
    keep = np.exp(-1.0 / frames)
    steps = rng.normal(size=(n_frames, n)) * np.sqrt(1.0 - keep**2)
    curve = np.empty((n_frames, n))
    curve[0] = rng.normal(size=n)
    for i in range(1, n_frames):
        curve[i] = keep * curve[i - 1] + steps[i]
    return smoothed(curve)


def _faster(curve: Array, tempo: float) -> Array:
    """Resample a control curve (F, 3) to a smaller number of frames."""
    at = np.arange(0.0, len(curve) - 1.0, tempo)
    return np.stack([np.interp(at, np.arange(len(curve)), column) for column in curve.T], -1)


def smoothed(curves: Array) -> Array:
    """Smooth curves (F, n) in time with a seven-frame Hann window, since muscles move the jaw smoothly."""
    kernel = np.hanning(9)[1:-1]
    kernel = kernel / kernel.sum()
    padded = np.pad(curves, ((3, 3), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, kernel, "valid") for column in padded.T], -1)


def _with_tracking_noise(person: Person, T: Array, rng: np.random.Generator, scale: float) -> Array:
    """Add a small random rotation and translation about the centre of the lower arch to each pose."""
    centre = person.joint.incisor + [0.0, -3.0, -20.0]
    R = so3_exp(rng.normal(size=(len(T), 3)) * person.noise.tracking_rad * scale)
    shift = rng.normal(size=(len(T), 3)) * person.noise.tracking_mm * scale
    return T @ make_transform(R, centre + shift - R @ centre)


def _bump(n: int, power: float = 1.0) -> Array:
    """Return a bump from 0 to 1 and back over n frames."""
    return (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n) / n)) ** power


def _swing(n: int) -> Array:
    """Return one period of a sine over n frames."""
    return np.sin(2 * np.pi * np.arange(n) / n)


def _border(n: int, turn: float, end: int) -> tuple[Array, Array]:
    """Trace the border: the jaw moves to one side with closed teeth, opens there, crosses over, closes on the other.

    The mandible crosses over during the first part of closing (fraction `turn`), and returns to the middle in the last
    `end` frames. Return opening 0..1 and excursion -1..1, shape (n,) each.
    """
    first, second = n // 5, int(0.4 * n)
    out, up, down = (np.arange(k) / k for k in (first, second, n - first - second))
    opening = np.concatenate([np.zeros(first), smoothstep(up), 1.0 - smoothstep(down)])
    excursion = np.concatenate([smoothstep(out), np.ones(second), 1.0 - 2.0 * smoothstep(down / turn)])
    excursion[-end:] *= np.linspace(1.0, 0.0, end)
    return opening, excursion


def _open(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(42, 62))
    opening = rng.uniform(0.85, 1.0) * _bump(n, rng.uniform(0.8, 1.1))
    return opening, np.full(n, 0.06 * rng.normal()), rng.uniform(-0.15, 0.15) * _swing(n)


def _lateral(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(40, 56))
    lateral = rng.uniform(0.85, 1.0) * _swing(n) * rng.choice([-1, 1])
    return np.full(n, rng.uniform(0.0, 0.06)), lateral, np.full(n, rng.uniform(-0.05, 0.15))


def _lateral_half_open(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(40, 56))
    opening = rng.uniform(0.15, 0.6) * np.minimum(1.0, 4.0 * _bump(n))
    lateral = rng.uniform(0.8, 1.0) * _swing(n) * rng.choice([-1, 1])
    return opening, lateral, np.full(n, rng.uniform(-0.1, 0.2))


def _protrude(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    forward = rng.uniform(0.85, 1.0) * _bump(int(rng.integers(36, 52)))
    back = -rng.uniform(0.7, 1.0) * _bump(int(rng.integers(12, 20)))
    protrusion = np.concatenate([forward, back])
    n = len(protrusion)
    return np.full(n, rng.uniform(0.0, 0.05)), np.full(n, 0.05 * rng.normal()), protrusion


def _protrude_half_open(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(40, 56))
    opening = rng.uniform(0.15, 0.6) * np.minimum(1.0, 4.0 * _bump(n))
    swing = _swing(n)
    protrusion = swing * np.where(swing > 0, rng.uniform(0.8, 1.0), rng.uniform(0.5, 0.95))
    return opening, np.full(n, 0.05 * rng.normal()), protrusion


def _sagittal_border(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(74, 92))
    opening, protrusion = _border(n, 0.35, 8)
    return opening * rng.uniform(0.93, 1.0), np.full(n, 0.04 * rng.normal()), protrusion * rng.uniform(0.88, 1.0)


def _frontal_border(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(70, 90))
    opening, lateral = _border(n, 0.4, 10)
    lateral *= rng.choice([-1, 1]) * rng.uniform(0.88, 1.0)
    return opening * rng.uniform(0.85, 1.0), lateral, np.full(n, rng.uniform(-0.1, 0.25))


def _circumduct(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(44, 60))
    turn = 2 * np.pi * np.arange(n) / n * rng.choice([-1, 1])
    fade = np.minimum(1.0, 5.0 * _bump(n))
    opening = rng.uniform(0.2, 0.5) * fade
    size = rng.uniform(0.65, 0.9) * fade
    return opening, size * np.sin(turn), size * np.cos(turn) * fade


def _chew(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    n = int(rng.integers(14, 20))
    part = np.arange(n) / n
    opening = rng.uniform(0.25, 0.5) * _bump(n)
    sideways = -(np.sin(np.pi * part) ** 2) * np.sin(2 * np.pi * (part - 0.25))
    return opening, rng.choice([-1, 1]) * rng.uniform(0.3, 0.7) * sideways, rng.uniform(-0.15, 0.15) * _swing(n)


def _speech(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    noise = smooth_noise(rng, int(rng.integers(30, 60)), 4.0, 3)
    return 0.10 + 0.09 * np.tanh(noise[:, 0]), 0.12 * noise[:, 1], 0.05 + 0.25 * np.tanh(noise[:, 2])


def _explore(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    noise = 1.25 * smooth_noise(rng, int(rng.integers(120, 200)), rng.uniform(8.0, 18.0), 3)
    return 0.5 + 0.5 * np.tanh(1.1 * noise[:, 0] - 0.25), np.tanh(noise[:, 1]), np.tanh(noise[:, 2])


_EXERCISES = {
    "open": _open,
    "lateral": _lateral,
    "lateral half open": _lateral_half_open,
    "protrude": _protrude,
    "protrude half open": _protrude_half_open,
    "sagittal border": _sagittal_border,
    "frontal border": _frontal_border,
    "circumduct": _circumduct,
    "chew": _chew,
    "speech": _speech,
    "explore": _explore,
}
