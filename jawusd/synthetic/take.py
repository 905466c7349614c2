"""A performance in front of the cameras: jaw, head, lips, tongue and light at every instant of a take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.geometry import make_transform, so3_exp
from jawusd.synthetic.anatomy import Occlusion, lifted_bite
from jawusd.synthetic.exercises import schedule, smooth_noise, smoothed
from jawusd.synthetic.kinematics import smoothstep
from jawusd.synthetic.person import Person
from jawusd.synthetic.soft_tissue import LipState
from jawusd.synthetic.studio import T_WORLD_SCAN

FPS = 24.0
#: Frames before the first and after the last tracked one, which contain the flashes.
LEAD, TAIL = 20, 16
#: Frames of the slightly open mouth and of the closed bite at the start of the tracked part.
OPEN_HOLD, REST_HOLD = 10, 12
_DARK_FRAMES = 4
_FLASH_START, _FLASH_BEFORE_END = 8, 10
_DARKNESS = 0.06
_HALF_OPEN = 0.10
_EXERCISES = (
    "open", "lateral", "protrude", "frontal border", "chew", "chew", "circumduct", "sagittal border",
    "lateral half open", "protrude half open", "speech", "open", "frontal border", "circumduct", "chew",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Take:
    """A performance, sampled at the instants of the reference camera's frames."""

    first_instant: int  # reference frame number of the first instant; negative when another camera started earlier
    tracked: tuple[int, int]  # first and one past the last reference frame to be tracked
    rest_frame: int  # reference frame with the teeth in occlusion
    dark: NDArray[np.int64]  # dark intervals [first, last) in reference frames, shape (2, 2)
    controls: Array  # opening, lateral, protrusion, shape (I, 3)
    phase: NDArray[np.str_]  # name of the exercise, shape (I,)
    T_skull_mandible: Array  # shape (I, 4, 4)
    T_world_skull: Array  # shape (I, 4, 4)
    lips: list[LipState]  # one per instant
    tongue_mm: Array  # forward, up, left, shape (I, 3)
    light: Array  # brightness, shape (I,)


def perform(person: Person, occlusion: Occlusion, frames: int, offsets: tuple[int, ...], seed: int) -> Take:
    """Return the exercises of a person as a take.

    Args:
        occlusion: contact of the teeth, which guides closed movements.
        frames: number of tracked frames, more than the two holds at the start.
        offsets: of the cameras; all their frames are covered.
        seed: of exercises, head motion, lips and tongue.
    """
    rng = np.random.default_rng([seed, 0x7A6E])
    first = min(0, *offsets)
    n = LEAD + frames + TAIL + max(0, *offsets) - first
    start = LEAD - first  # index of the first tracked frame
    controls, phase, held = _controls(person, frames, start, n, rng)
    extra_mm = smooth_noise(rng, n, 8.0, 3) * [person.noise.side_mm, person.noise.lift_mm, person.noise.lift_mm]
    extra_mm *= 1.0 - held[:, None]
    controls = lifted_bite(person, occlusion, controls, extra_mm)
    T_jaw = person.pose_with_extra(controls, extra_mm)
    dark = np.array([[_FLASH_START, 0], [LEAD + frames + TAIL - _FLASH_BEFORE_END, 0]])
    dark[:, 1] = dark[:, 0] + _DARK_FRAMES
    light = np.ones(n)
    for a, b in dark - first:
        light[a:b] = _DARKNESS
    return Take(
        first_instant=first,
        tracked=(LEAD, LEAD + frames),
        rest_frame=LEAD + OPEN_HOLD + REST_HOLD // 2,
        dark=dark,
        controls=controls,
        phase=phase,
        T_skull_mandible=T_jaw,
        T_world_skull=_head(n, rng),
        lips=_lips(controls, phase, rng),
        tongue_mm=_tongue(controls, rng),
        light=light,
    )


def _controls(
    person: Person, frames: int, start: int, n: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.str_], Mask]:
    """Return controls and phase of every instant, and where the jaw is held still (1) at the closed bite."""
    exercises = frames - OPEN_HOLD - REST_HOLD
    curves, names = schedule(_EXERCISES, exercises, rng, tempo=1.5)
    still = np.array([_HALF_OPEN, 0.0, 0.0])
    head = np.tile(still, (start + OPEN_HOLD, 1))
    rest = np.zeros((REST_HOLD, 3))
    tail = np.tile(still, (n - len(head) - REST_HOLD - exercises, 1))
    controls = smoothed(np.concatenate([head, rest, curves, tail]))
    resting = np.concatenate([np.zeros(len(head)), np.ones(REST_HOLD), np.zeros(exercises + len(tail))])
    phase = np.array(["open"] * len(head) + ["rest"] * REST_HOLD + list(names) + ["open"] * len(tail))
    held = smoothed(resting[:, None])
    unintended = smooth_noise(rng, n, 10.0, 3) * [0.006, 0.03, 0.03] * (1.0 - np.minimum(1.0, 4.0 * held))
    return person.limit(controls + unintended), phase, held[:, 0] > 0.02


def _drift(n: int, rng: np.random.Generator, count: int) -> Array:
    """Slow wandering of unit variance: a few sinusoids of 2 to 7 s, shape (n, count)."""
    seconds = np.arange(n) / FPS
    period, phase = rng.uniform(2.0, 7.0, (4, count)), rng.uniform(0.0, 2 * np.pi, (4, count))
    return np.sin(2 * np.pi * seconds[:, None, None] / period + phase).sum(1) / np.sqrt(2.0)


def _head(n: int, rng: np.random.Generator) -> Array:
    """Head poses: a few millimetres and degrees about the atlas, shape (n, 4, 4)."""
    drift = _drift(n, rng, 6)
    R = so3_exp(drift[:, :3] * np.deg2rad([1.0, 1.3, 0.8]))
    pivot = np.array([0.0, 20.0, -95.0])
    shift = drift[:, 3:] * [1.0, 0.7, 1.2]
    return T_WORLD_SCAN @ make_transform(R, pivot + shift - R @ pivot)


def _lips(controls: Array, phase: NDArray[np.str_], rng: np.random.Generator) -> list[LipState]:
    """Lips drawn back to show the teeth, less so in chewing and speech."""
    drift = _drift(len(controls), rng, 4)
    relaxed = smoothed(np.isin(phase, ["chew", "speech"]).astype(np.float64)[:, None])[:, 0]
    wide = smoothstep(controls[:, 0])
    upper = 8.2 + 0.9 * drift[:, 0] - 1.6 * relaxed + 0.8 * wide
    lower = 8.2 + 1.0 * drift[:, 1] - 1.8 * relaxed - 1.2 * wide
    width = 27.5 + 0.6 * drift[:, 2] - 1.2 * relaxed - 1.5 * wide
    return [LipState(*row) for row in np.stack([upper, lower, width, 0.008 * drift[:, 3]], -1).tolist()]


def _tongue(controls: Array, rng: np.random.Generator) -> Array:
    """Tongue at rest, now and then raised over the lower front teeth when the mouth is open; (n, 3) mm."""
    drift = _drift(len(controls), rng, 2)
    room = smoothstep((controls[:, 0] - 0.12) / 0.3)
    raised = smoothstep((drift[:, 0] - 0.5) / 1.2) * room
    return np.stack([7.0 * raised, 9.0 * raised + 1.5 * room, 3.0 * drift[:, 1] * raised], -1)
