"""Animation layers: samples of d for tools that support the rig, and baked translations and quaternions for others.

All readers interpolate d linearly between samples; the baked ops follow the model along that motion. Matrix ops would
shear when interpolated, and a product of one transform per parameter would be wrong by millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Sdf, Ts

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, RigError
from jawusd.evaluator import JawRig
from jawusd.evaluator.curves import interpolate_linear
from jawusd.geometry.se3 import make_transform
from jawusd.geometry.so3 import so3_exp, wxyz_from_matrix
from jawusd.rig import layers
from jawusd.rig.attributes import MAX_FRAMES
from jawusd.rig.layers import new_layer, relative_path, rename_actor, stage_of, write_layer
from jawusd.rig.layout import ACTOR, MANDIBLE, MODEL_HASH_KEY, PARAMETERS, rig_prims
from jawusd.rig.read import load_rig, open_stage
from jawusd.rig.skel import add_skeleton_variant
from jawusd.rig.table import landmark_distance

#: Maximum landmark distance [mm] from the model between two baked samples, tested at these fractions of the interval.
BETWEEN_MM = 0.02
_FRACTIONS = (0.25, 0.5, 0.75)
_MAX_HALVINGS = 5
_USD_LERP_BELOW = 1e-5  # threshold of 1 - cosine below which GfSlerp interpolates linearly
_FARTHEST_FRAME = 1e9  # maximum absolute frame number
#: Keys in an animation layer's `customLayerData`: frames without d, with d inferred from their neighbours, and with d
#: estimated from facial skin.
LOST = "lostFrames"
CARRIED = "carriedFrames"
SKIN = "skinFrames"


def write_animation(
    out: AnyPath,
    actor: AnyPath,
    frames: ArrayLike,
    d: ArrayLike,
    fps: float,
    *,
    rig: JawRig | None = None,
    carried: ArrayLike = (),
    by_skin: ArrayLike = (),
    skinned: Iterable[str] = (),
) -> Path:
    """Write an animation layer (`.usdc` or `.usda`) that sublayers an actor; time codes are frame numbers.

    Args:
        actor: The `actor.usda` that the layer animates.
        frames: Increasing frame numbers (F,), possibly fractional: all frames, or only those of the keys.
        d: Parameters (F, 3) [mm]. Rows with NaN are lost frames, which are interpolated linearly and listed in the
            layer's `customLayerData["lostFrames"]`.
        rig: The evaluator; read from `actor` if None.
        carried: Frames whose d was interpolated from neighbouring frames; listed as `carriedFrames`.
        by_skin: Frames whose d was estimated from facial skin; listed as `skinFrames`.
        skinned: Paths of the meshes that are bound by `actor_skel.usdc`, a file in the same folder with the same
            motion. If there are any, a variant is added; see `add_skeleton_variant`.

    Raises:
        RigError: The actor is missing, frames do not increase, no frame has d, or the frame rate is not positive.
        FormatError: `actor` is not a rig.
        OutputError: The file cannot be written.
        ValueError: The shapes of frames and d do not match.
    """
    out, actor = Path(out), Path(actor)
    if not actor.is_file():
        raise RigError("there is no such file; the animation layer refers to the rig as a sublayer.", path=actor)
    rig = load_rig(actor) if rig is None else rig
    frames, d = np.asarray(frames, dtype=np.float64), np.asarray(d, dtype=np.float64)
    if frames.ndim != 1 or d.shape != (len(frames), 3):
        raise ValueError(f"expected frames (F,) and d (F, 3), got {frames.shape} and {d.shape}")
    known = np.isfinite(d).all(axis=1)
    if not known.any():
        raise RigError("no frame has parameters; there is nothing to animate.", path=out)
    if not np.isfinite(frames).all() or (np.diff(frames) <= 0).any():
        raise RigError("the frame numbers of an animation must increase.", path=out)
    if not fps > 0:
        raise RigError(f"the frame rate is {fps}; it must be greater than 0.", path=out)
    if frames[-1] - frames[0] > MAX_FRAMES or np.abs(frames).max() > _FARTHEST_FRAME:
        raise RigError(
            f"has frames {frames[0]:g} to {frames[-1]:g}; an animation may have at most {MAX_FRAMES} frames within "
            f"+-{_FARTHEST_FRAME:g}.",
            path=out,
        )
    layer = new_layer(fps)
    layer.subLayerPaths.append(relative_path(actor, out))
    layer.startTimeCode, layer.endTimeCode = float(frames[0]), float(frames[-1])
    note_unseen(layer, carried, by_skin, frames[~known])
    author_motion(layer, rig, frames[known], d[known], frames[[0, -1]])
    if paths := list(skinned):
        add_skeleton_variant(layer, rig, paths)
    return write_layer(rename_actor(layer, root_prim_of(actor)), out)


def note_unseen(layer: Sdf.Layer, carried: ArrayLike, by_skin: ArrayLike, lost: ArrayLike = ()) -> None:
    """Write the frames (F,) whose d was not measured to the layer's `customLayerData`; see `write_animation`."""
    for key, frames in ((CARRIED, carried), (SKIN, by_skin), (LOST, lost)):
        if len(np.atleast_1d(frames)):
            layer.customLayerData = {**layer.customLayerData, key: layers.int_array(np.floor(np.asarray(frames)))}


def root_prim_of(actor: Path) -> str:
    """Return the name of the rig's root prim in an actor's file; raises RigError if not exactly one is a rig."""
    stage = open_stage(actor)
    names = [prim.GetName() for prim in rig_prims(stage) if prim.GetPath().IsRootPrimPath()]
    if len(names) != 1:
        raise RigError(
            "must have exactly one rig as a root prim; the animation layer refers to it as a sublayer.",
            path=actor,
            hint="Choose the rig of a shot with --prim.",
        )
    return names[0]


def bake_times(rig: JawRig, frames: Array, d: Array, span: Array) -> tuple[Array, Array]:
    """Return times (n,) of baked samples, and the poses T_skull_mandible (n, 4, 4) at these times.

    They are every whole frame of the span, every sample of d (F, 3) [mm], and more to stay within 0.02 mm of the model.
    """
    whole = np.arange(np.ceil(span[0]), np.floor(span[1]) + 1)
    times = np.union1d(np.union1d(whole, span), frames)
    poses = rig.pose(interpolate_linear(frames, d, times))
    for _ in range(_MAX_HALVINGS):
        start, step = times[:-1], np.diff(times)
        errors = []
        for share in _FRACTIONS:
            exact = rig.pose(interpolate_linear(frames, d, start + share * step))
            errors.append(landmark_distance(rig, exact, _as_shown_by_usd(poses[:-1], poses[1:], share)))
        coarse = np.max(errors, axis=0) > BETWEEN_MM
        if not coarse.any():
            break
        middles = (start + 0.5 * step)[coarse]
        where = np.flatnonzero(coarse) + 1
        times = np.insert(times, where, middles)
        poses = np.insert(poses, where, rig.pose(interpolate_linear(frames, d, middles)), axis=0)
    return times, poses


def author_motion(
    layer: Sdf.Layer, rig: JawRig, frames: Array, d: Array, span: Array, paths: tuple[str, str] = (ACTOR, MANDIBLE)
) -> None:
    """Write samples d (F, 3) [mm] at increasing times (F,), and the baked ops of a mandible over a span, into a layer.

    `paths` are those of the actor's and the mandible's prims.
    """
    actor = Sdf.CreatePrimInLayer(layer, paths[0])
    for i, parameter in enumerate(PARAMETERS):
        attribute = Sdf.AttributeSpec(
            actor, parameter, Sdf.ValueTypeNames.Double, Sdf.VariabilityVarying, declaresCustom=True
        )
        attribute.customData = {MODEL_HASH_KEY: rig.model_hash}
        _set_samples(layer, attribute, frames, d[:, i].tolist())
    times, poses = bake_times(rig, frames, d, span)
    mandible = Sdf.CreatePrimInLayer(layer, paths[1])
    translate = Sdf.AttributeSpec(mandible, "xformOp:translate", Sdf.ValueTypeNames.Double3)
    _set_samples(layer, translate, times, layers.translations(poses))
    orient = Sdf.AttributeSpec(mandible, "xformOp:orient", Sdf.ValueTypeNames.Quatd)
    _set_samples(layer, orient, times, layers.rotations(poses))


def _set_samples(
    layer: Sdf.Layer, attribute: Sdf.AttributeSpec, times: Array, values: list[float] | list[Gf.Vec3d] | list[Gf.Quatd]
) -> None:
    for time, value in zip(times.tolist(), values, strict=True):
        layer.SetTimeSample(attribute.path, time, value)


def _as_shown_by_usd(T_a: Array, T_b: Array, share: float) -> Array:
    """Return the transforms that OpenUSD computes between two samples, at the fraction `share` of the interval.

    OpenUSD interpolates quaternions by slerp (Shoemake 1985). Nearly equal ones (GfSlerp: cosine above 1 - 1e-5) are
    interpolated linearly without normalising, and the angle is then taken from the real part alone (GfRotation), which
    causes errors up to 0.4 mm near the identity.
    """
    q_a, q_b = wxyz_from_matrix(T_a[:, :3, :3]), wxyz_from_matrix(T_b[:, :3, :3])
    cosine = np.einsum("ij,ij->i", q_a, q_b)
    q_b = q_b * np.where(cosine < 0, -1.0, 1.0)[:, None]
    cosine = np.minimum(np.abs(cosine), 1.0)
    far = 1 - cosine > _USD_LERP_BELOW
    angle = np.where(far, np.arccos(cosine), 1.0)
    w_a = np.where(far, np.sin((1 - share) * angle) / np.sin(angle), 1 - share)
    w_b = np.where(far, np.sin(share * angle) / np.sin(angle), share)
    q = w_a[:, None] * q_a + w_b[:, None] * q_b
    length = np.linalg.norm(q[:, 1:], axis=1)
    turn = 2 * np.arccos(np.clip(q[:, 0], -1, 1)) / np.where(length > 0, length, 1.0)
    R = so3_exp(turn[:, None] * q[:, 1:])
    return make_transform(R, (1 - share) * T_a[:, :3, 3] + share * T_b[:, :3, 3])


def write_splines(
    out: AnyPath,
    animation: AnyPath,
    frames: ArrayLike,
    d: ArrayLike,
    fps: float,
    slopes: ArrayLike | None = None,
    curved: ArrayLike | None = None,
) -> Path:
    """Write a layer that sublayers an animation layer and contains its keys as splines through the same samples.

    Other layers of a rig contain no splines, because OpenUSD before 25.05 and other readers cannot parse them.

    Args:
        animation: The animation layer written from the same keys.
        frames: Increasing key frames (F,).
        d: Keys (F, 3) [mm].
        slopes: Tangents at the keys (F, 3) [mm per frame]; zero if None.
        curved: Mask (F - 1,) of segments that are cubic, with these tangents; the others are linear. None: all are
            linear.

    Raises:
        RigError: The frames do not increase, or keys are not finite.
        OutputError: The file cannot be written.
        ValueError: The shapes of frames and d do not match.
    """
    out = Path(out)
    frames, d = np.asarray(frames, dtype=np.float64), np.asarray(d, dtype=np.float64)
    if d.shape != (len(frames), 3):
        raise ValueError(f"expected frames (F,) and d (F, 3), got {frames.shape} and {d.shape}")
    tangents = np.zeros_like(d) if slopes is None else np.asarray(slopes, dtype=np.float64)
    cubic = np.zeros(max(len(frames) - 1, 0), dtype=bool) if curved is None else np.asarray(curved, dtype=bool)
    if tangents.shape != d.shape or len(cubic) != max(len(frames) - 1, 0):
        raise ValueError(f"expected slopes (F, 3) and curved (F - 1,), got {tangents.shape} and {cubic.shape}")
    if not len(frames) or not np.isfinite(d).all() or not (np.diff(frames) > 0).all():
        raise RigError("keys must have increasing frames and finite values.", path=out)
    layer = new_layer(fps, f"/{root_prim_of(Path(animation))}")
    layer.startTimeCode, layer.endTimeCode = float(frames[0]), float(frames[-1])
    stage = stage_of(layer)
    actor = stage.OverridePrim(f"/{layer.defaultPrim}")
    for name, values, tangent in zip(PARAMETERS, d.T, tangents.T, strict=True):
        spline = _spline(frames, values, tangent, cubic)
        actor.CreateAttribute(name, Sdf.ValueTypeNames.Double, custom=True).SetSpline(spline)
    # Close the stage: on an anonymous layer it would fail to resolve the relative path below, with a warning.
    del stage, actor
    layer.subLayerPaths.append(relative_path(Path(animation), out))
    return write_layer(layer, out)


def _spline(frames: Array, values: Array, slopes: Array, curved: Mask) -> Ts.Spline:
    """Return a Bezier spline; handles as long as a third of a segment make it a cubic polynomial of time."""
    third = np.diff(frames) / 3.0
    before, after = np.concatenate([[0.0], third]), np.concatenate([third, [0.0]])
    cubic = np.append(curved, False)
    spline = Ts.Spline("double")
    for i, (frame, value) in enumerate(zip(frames.tolist(), values.tolist(), strict=True)):
        knot = Ts.Knot("double")
        knot.SetTime(frame)
        knot.SetValue(value)
        knot.SetNextInterpolation(Ts.InterpCurve if cubic[i] else Ts.InterpLinear)
        knot.SetPreTanWidth(float(before[i]))
        knot.SetPreTanSlope(float(slopes[i]))
        knot.SetPostTanWidth(float(after[i]))
        knot.SetPostTanSlope(float(slopes[i]))
        spline.SetKnot(knot)
    return spline
