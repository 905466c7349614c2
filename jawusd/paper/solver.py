"""The optimiser of the paper (section 4): descent with finite differences, then a dense local search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from math import radians

import numpy as np
from scipy.spatial.transform import Rotation

from jawusd.base.arrays import Array
from jawusd.geometry import make_transform, orthonormalise, transform_point

_GOLDEN = (np.sqrt(5) - 1) / 2

Energy = Callable[[Array], Array]
Line = Callable[[list[float]], Array]


@dataclass(frozen=True)
class PaperConfig:
    """Settings of the paper's method. The paper specifies lambda and the order of the steps only.

    The other values were tuned on a synthetic take; changing one of them affects the error by less than a factor of
    two.
    """

    # Weight of the boundary term: lambda in eq. 7.
    boundary_weight: float = 0.4
    # Resolution at the teeth [px/mm]: about that of the paper's 940 x 480 buffer and of the default solver.
    working_px_per_mm: float = 7.2
    # Half step of the finite differences; smaller steps are dominated by pixel quantisation, larger steps by curvature.
    difference_rad: float = radians(0.3)
    difference_mm: float = 0.15
    # Longest step of the line search: about the motion between two video frames of an exercise.
    reach_rad: float = radians(1.0)
    reach_mm: float = 1.0
    # Interval length at which the golden-section search stops: a motion of a tenth of a pixel.
    tolerance_rad: float = radians(0.01)
    tolerance_mm: float = 0.01
    # Maximum number of rounds of rotation and translation steps; typical frames need fewer than ten.
    most_rounds: int = 40
    # Dense search: number of samples per degree of freedom (odd), and their spacing.
    dense_samples: int = 3
    dense_rad: float = radians(0.2)
    dense_mm: float = 0.1


@dataclass(frozen=True, eq=False)
class PaperSolution:
    """Result for one arch in one frame."""

    pose: Array  # T_world_scan, shape (4, 4)
    energy: float  # energy E of eq. 6 at the pose [px]
    rounds: int  # number of rounds of rotation and translation steps


def solve_paper(energy: Energy, start: Array, centre: Array, config: PaperConfig) -> PaperSolution:
    """Minimise the energy, E (N,) of poses (N, 4, 4), of one arch in one frame.

    The six parameters are those of eq. 6, R = Rz(theta_z) Ry(theta_y) Rx(theta_x) and t, relative to the start: zero is
    T_world_scan (4, 4) of the previous frame, and rotations are about the centroid of the teeth (3,), in scan
    coordinates [mm]. The paper does not specify this.
    """

    def at(parameters: Array) -> Array:
        return energy(_poses(start, centre, parameters))

    best, lowest = np.zeros(6), float(at(np.zeros((1, 6)))[0])
    rounds = 0
    improved = True
    while improved and rounds < config.most_rounds:
        rounds += 1
        before = lowest
        for rotation in (True, False):
            best, lowest = _descend(at, best, lowest, rotation, config)
        improved = lowest < before
    spacing = np.repeat([config.dense_rad, config.dense_mm], 3)
    half = config.dense_samples // 2
    around = best + spacing * np.array(list(product(range(-half, half + 1), repeat=6)))
    values = at(around)
    # The middle sample is `best` itself and wins ties.
    if values.min() < lowest:
        best, lowest = around[values.argmin()], float(values.min())
    return PaperSolution(_poses(start, centre, best[None])[0], lowest, rounds)


def _descend(at: Energy, best: Array, lowest: float, rotation: bool, config: PaperConfig) -> tuple[Array, float]:
    """Take one step in rotation or in translation; return the better of start and end, and its energy."""
    block = slice(0, 3) if rotation else slice(3, 6)
    step = config.difference_rad if rotation else config.difference_mm
    nudges = np.zeros((6, 6))
    nudges[:3, block] = step * np.eye(3)
    nudges[3:, block] = -step * np.eye(3)
    values = at(best + nudges)
    gradient = (values[:3] - values[3:]) / (2 * step)
    steepness = np.linalg.norm(gradient)
    if steepness == 0:
        return best, lowest
    direction = np.zeros(6)
    direction[block] = -gradient / steepness
    reach = config.reach_rad if rotation else config.reach_mm
    tolerance = config.tolerance_rad if rotation else config.tolerance_mm
    length, value = golden_section(lambda s: at(best + np.outer(s, direction)), reach, tolerance)
    return (best + length * direction, value) if value < lowest else (best, lowest)


def golden_section(line: Line, reach: float, tolerance: float) -> tuple[float, float]:
    """Return the best point on [0, reach] and its value, found by golden-section search (J. Kiefer, Proc. AMS 4, 1953).

    `line` returns its values at a list of points. The search stops at an interval of the length `tolerance`.
    """
    low, high = 0.0, reach
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = (float(v) for v in line([a, b]))
    while high - low > tolerance:
        if at_a <= at_b:
            high, b, at_b = b, a, at_a
            a = high - _GOLDEN * (high - low)
            at_a = float(line([a])[0])
        else:
            low, a, at_a = a, b, at_b
            b = low + _GOLDEN * (high - low)
            at_b = float(line([b])[0])
    return (a, at_a) if at_a <= at_b else (b, at_b)


def _poses(start: Array, centre: Array, parameters: Array) -> Array:
    """Return T_world_scan for angles and translations (N, 6) relative to the start, shape (N, 4, 4)."""
    R = Rotation.from_euler("ZYX", parameters[:, 2::-1]).as_matrix()
    pivot = transform_point(start, centre)
    moved = R @ (start[:3, 3] - pivot) + pivot + parameters[:, 3:]
    return orthonormalise(make_transform(R @ start[:3, :3], moved))
