"""Judge possible and impossible poses with a rig: python tests/benchmarks/verdicts.py BUILD_FOLDER

BUILD_FOLDER holds model.npz and tracks.npz of `jawusd build`. Captured poses are the raw ones of the first pass, noise
and all. The impossible ones, 2,500 of each kind:

    thrown      twists drawn evenly from sizes that jaws reach (0.5, 0.2, 0.2 rad; 15, 30, 20 mm)
    knocked     captured poses moved off the model by 3 mm and 3 degrees, what lies along the model taken out
    mirrored    captured poses as a tracker with left-handed axes would give them
    gaping      the rotation of a wide open jaw, its incisal point where it is closed

Some thrown poses are possible by chance: their share is below the error of a per cent. The first column of verdicts is
the rig's own (model, joint bound, thresholds), the second the paper's two polygons alone: the nearest parameters within
both, however far the pose is from the model.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from jawusd.evaluator import JawRig, load
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import (
    make_transform,
    mandible_metric,
    se3_exp,
    se3_left_jacobian,
    transform_point,
    transform_points,
)

COUNT = 2500


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    rig, tracks = load(options.folder / "model.npz"), load_tracks(options.folder / "tracks.npz")
    captured = tracks.raw_T_upper_lower[np.isfinite(tracks.raw_T_upper_lower).all((1, 2))]
    rng = np.random.default_rng(0)
    rows = {
        "captured": captured,
        "thrown": se3_exp(rng.uniform(-1, 1, (COUNT, 6)) * [0.5, 0.2, 0.2, 15, 30, 20]) @ rig.T_rest,
        "knocked": knocked(rig, captured, rng),
        "mirrored": captured[rng.integers(len(captured), size=COUNT)] * [[-1], [1], [1], [1]],
        "gaping": gaping(rig, rng),
    }
    print(f"{'accepted':<12}{'poses':>8}{'rig':>10}{'polygons':>10}")
    refused = np.zeros(2)
    for name, poses in rows.items():
        own = rig.validate(poses).valid
        polygons = rig.validate(poses, bound="polygons", residual_limit_mm=np.inf, tolerance_mm=0.0).valid
        print(f"{name:<12}{len(poses):>8}{own.mean():>10.2%}{polygons.mean():>10.2%}")
        if name != "captured":
            refused += [(~own).sum(), (~polygons).sum()]
    print(f"{'impossible ones refused':<20}{refused[0] / (4 * COUNT):>7.2%}{refused[1] / (4 * COUNT):>10.2%}")


def knocked(rig: JawRig, captured: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return captured poses moved by 3 mm and 3 degrees about the teeth, less what lies along the model."""
    chosen = captured[rng.integers(len(captured), size=COUNT)]
    directions = rng.normal(size=(2, COUNT, 3))
    turn, move = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    twist = np.concatenate([np.radians(3.0) * turn, 3.0 * move], axis=1)
    d = rig.encode(chosen)[0]
    out = np.empty_like(chosen)
    for k, T in enumerate(chosen):
        middle = transform_point(T, rig.landmarks[:3].mean(0))
        to, back = make_transform(np.eye(3), -middle), make_transform(np.eye(3), middle)
        # Of equal length before and after: what lay along the model is turned away from it.
        M = mandible_metric(transform_points(to @ T, rig.landmarks))
        J = se3_left_jacobian(rig.twist(d[k])) @ rig.jacobian(d[k])
        J = np.concatenate([J[:3], J[3:] + np.cross(J[:3].T, middle).T])
        along = J @ np.linalg.solve(J.T @ M @ J, J.T @ M @ twist[k])
        off = twist[k] - along
        off *= np.sqrt((twist[k] @ M @ twist[k]) / (off @ M @ off))
        out[k] = back @ se3_exp(off) @ to @ T
    return out


def gaping(rig: JawRig, rng: np.random.Generator) -> np.ndarray:
    """Return the rotation of a wide open jaw about the incisal point of the closed one."""
    d1 = rng.uniform(0.8, 1.0, COUNT) * rig.d_range[0, 1]
    low2, high2, low3, high3 = rig.ranges(d1)
    d = np.stack([d1, rng.uniform(low2, high2), rng.uniform(low3, high3)], axis=1)
    T = rig.pose(rig.project(d))
    incisor = rig.landmarks[0]
    closed = transform_point(rig.T_rest, incisor)
    T[:, :3, 3] += closed - transform_point(T, incisor)
    return T


if __name__ == "__main__":
    main()
