"""Tracks of two cameras that nothing was tracked for; the third frame has no pose."""

from __future__ import annotations

import numpy as np

from jawusd.formats.tracks import Tracks
from jawusd.geometry import se3_exp


def make_tracks(count: int = 5, cameras: tuple[str, ...] = ("a", "b")) -> Tracks:
    """Return tracks of so many frames, the first one 30."""
    rng = np.random.default_rng(0)
    poses = [se3_exp(rng.normal(size=(count, 6)) * 0.2) for _ in range(6)]
    for pose in poses:
        pose[2] = np.nan
    cov = np.broadcast_to(np.eye(6) * 1e-3, (count, 6, 6)).copy()
    cov[2] = np.nan
    return Tracks(
        np.arange(30, 30 + count), *poses, np.ones((count, 2), np.int8), np.zeros(count, bool),
        np.full((count, 2, len(cameras)), 0.01), np.ones((count, 2, len(cameras)), bool),
        cov, cov.copy(), cov.copy(), np.full((count, 5), 0.05),
        np.full((count, 2), 0.5), np.full((count, 2), 800.0), cameras, {"config": {"gate_px": 2.5}},
    )  # fmt: skip
