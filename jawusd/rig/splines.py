"""The keys of an animation as USD splines, in an optional layer for tools that edit them.

Kept out of every delivered layer: OpenUSD before 25.05 ignores splines or cannot parse them, and other readers refuse
the whole file.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pxr import Sdf, Ts

from jawusd.errors import RigError
from jawusd.rig.layers import new_layer, relative_path, stage_of, write_layer
from jawusd.rig.layout import ACTOR, PARAMETERS


def write_splines(
    out: str | os.PathLike[str], animation: str | os.PathLike[str], frames: ArrayLike, d: ArrayLike, fps: float
) -> Path:
    """Write a layer that holds the keys of an animation as linear splines and sublayers that animation.

    The splines go through the same values as the animation's samples, so both show the same motion.

    Args:
        out: file to write.
        animation: the animation layer made from the same keys.
        frames: key frames (F,), increasing.
        d: keys (F, 3) [mm].
        fps: frames per second.

    Returns:
        The file.

    Raises:
        RigError: the keys do not increase or are not finite.
        OutputError: the file cannot be written.
        ValueError: frames and d of shapes that do not fit.
    """
    out = Path(out)
    frames, d = np.asarray(frames, dtype=np.float64), np.asarray(d, dtype=np.float64)
    if d.shape != (len(frames), 3):
        raise ValueError(f"frames (F,) and d (F, 3) are needed, got {frames.shape} and {d.shape}")
    if not len(frames) or not np.isfinite(d).all() or not (np.diff(frames) > 0).all():
        raise RigError("keys need increasing frames and finite values.", path=out)
    layer = new_layer(fps)
    layer.startTimeCode, layer.endTimeCode = float(frames[0]), float(frames[-1])
    stage = stage_of(layer)
    actor = stage.OverridePrim(ACTOR)
    for name, values in zip(PARAMETERS, d.T, strict=True):
        actor.CreateAttribute(name, Sdf.ValueTypeNames.Double, custom=True).SetSpline(_linear(frames, values))
    layer.subLayerPaths.append(relative_path(Path(animation), out))
    return write_layer(layer, out)


def _linear(frames: np.ndarray, values: np.ndarray) -> Ts.Spline:
    spline = Ts.Spline("double")
    for frame, value in zip(frames.tolist(), values.tolist(), strict=True):
        knot = Ts.Knot("double")
        knot.SetTime(frame)
        knot.SetValue(value)
        knot.SetNextInterpolation(Ts.InterpLinear)
        spline.SetKnot(knot)
    return spline
