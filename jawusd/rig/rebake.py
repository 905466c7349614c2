"""Make d and the mandible in a stage consistent again after one of them was edited."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pxr import Sdf, Usd, UsdGeom, Vt

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, FormatError, RigError, naming_file
from jawusd.evaluator import JawRig
from jawusd.rig import motion_read
from jawusd.rig.animation import author_motion, note_unseen
from jawusd.rig.asset_paths import paths_in, prim_spec_at
from jawusd.rig.attributes import key_times
from jawusd.rig.layers import new_layer, relative_path, set_attribute, write_layer
from jawusd.rig.layout import MOTION, PARAMETERS, SKELETON, TRANSFORMS, rig_prims
from jawusd.rig.read import find_rig_prim, open_stage, rig_of
from jawusd.rig.skel import bones_of
from jawusd.rig.untrusted import raises_format_error

Origin = Literal["d", "mandible"]
_SAME_MM = 1e-6  # difference [mm] below which keys of d count as equal


class StageMotion(NamedTuple):
    """A motion of a rig in a stage."""

    frames: Array  # increasing times, shape (F,)
    d: Array  # jaw parameters [mm], shape (F, 3), NaN in lost frames
    fps: float  # frames per second
    origin: Origin  # source of the motion: the keys of d or the mandible's transforms
    residual_mm: Array  # distance of the mandible's poses from the model, shape (F,); zero for d
    fitted: bool = False  # whether the rig's meshes were fitted to a stage without the rig
    prim: str = ""  # path of the rig's prim in the stage; empty if fitted


class Deviation(NamedTuple):
    """Deviation of a mandible from the pose given by d."""

    frames: int  # number of frames that deviate
    of: int  # number of frames compared
    largest_mm: float  # largest landmark distance


@raises_format_error
def deviation(path: AnyPath, rig: JawRig, prim_path: str | None = None) -> Deviation | None:
    """Return the deviation of a stage's mandible from the pose given by d; None if d has no keys.

    Raises:
        RigError: The file is not a stage.
        FormatError: No rig or several rigs, no mandible, or parameters that are not finite.
    """
    stage = open_stage(path)
    return _deviation(_actor(stage, path, rig, prim_path), rig)


def _deviation(actor: Usd.Prim, rig: JawRig) -> Deviation | None:
    stage, mandible = actor.GetStage(), motion_read.mandible_of(actor)
    parameters = [actor.GetAttribute(name) for name in PARAMETERS]
    moving = motion_read.moving_attributes(mandible, actor)
    sampled = motion_read.parameters_of(actor)
    if not all(parameters) or (sampled is None and _rank(stage, parameters) >= _rank(stage, moving)):
        return None
    times, away_mm, allowed_mm = motion_read.compared_with_parameters(actor, mandible, rig)
    return Deviation(int((~(away_mm <= allowed_mm)).sum()), len(times), float(away_mm.max()))


@raises_format_error
def motion_of_stage(
    path: AnyPath, rig: JawRig, prim_path: str | None = None, origin: Origin | None = None
) -> StageMotion:
    """Read the motion of a rig in a stage from whichever was edited: keys of d or transforms of the mandible.

    Args:
        prim_path: The rig's prim, if the stage has several rigs.
        origin: Source to read; None: the animated source or, if both are animated and disagree, the one in the stronger
            layer.

    Raises:
        RigError: The file is not a stage, or d and mandible disagree and are in the same layer.
        FormatError: No rig or several rigs, no mandible, or a motion that is not rigid or not finite.
    """
    stage = open_stage(path)
    actor = _actor(stage, path, rig, prim_path)
    mandible = motion_read.mandible_of(actor)
    if origin is None:
        origin = _origin(stage, actor, mandible, _deviation(actor, rig))
    sampled = motion_read.parameters_of(actor)
    if origin == "d":
        sampled = _constant_motion(stage, actor) if sampled is None else sampled
        return StageMotion(*sampled, origin, np.zeros(len(sampled[0])), prim=str(actor.GetPath()))
    frames = motion_read.frames_of_stage(stage)
    d, residual_mm = rig.encode(motion_read.poses_at(mandible, actor, frames))
    fps = float(stage.GetTimeCodesPerSecond())
    return StageMotion(frames.astype(np.float64), d, fps, origin, residual_mm, prim=str(actor.GetPath()))


def _origin(stage: Usd.Stage, actor: Usd.Prim, mandible: Usd.Prim, deviating: Deviation | None) -> Origin:
    if deviating is None:
        return "mandible"
    if not deviating.frames:
        return "d"
    moving = motion_read.moving_attributes(mandible, actor)
    if not any(key_times(attribute) for attribute in moving):
        return "d"
    ranks = [_rank(stage, attributes) for attributes in ([actor.GetAttribute(name) for name in PARAMETERS], moving)]
    if ranks[0] == ranks[1]:
        raise RigError(
            f"d and the mandible disagree by up to {deviating.largest_mm:.2f} mm, and both have keys in one layer.",
            hint="Choose the one to use: --from d or --from mandible.",
        )
    return "d" if ranks[0] < ranks[1] else "mandible"


def _actor(stage: Usd.Stage, path: AnyPath, rig: JawRig, prim_path: str | None) -> Usd.Prim:
    """Return the stage's rig prim; among several, the only one with the same model. Rejects rigs of other subjects."""
    alike = [p for p in rig_prims(stage) if p.GetAttribute("jaw:modelHash").Get() == rig.model_hash]
    found = alike[0] if prim_path is None and len(alike) == 1 else find_rig_prim(stage, path, prim_path)
    own, other = (str(meta.get("actor") or "") for meta in (rig.meta, rig_of(found).meta))
    if own and other and own != other:
        raise FormatError(
            f'{found.GetPath()} is the rig of "{other}", but the given rig is of "{own}"; their d and bounds differ.',
            hint="Give the rig of that subject, or transfer the motion with `jawusd retarget`.",
        )
    return found


def _constant_motion(stage: Usd.Stage, actor: Usd.Prim) -> tuple[Array, Array, float]:
    """Return the motion of a rig whose d is not animated: first and last frame, d at both [mm], frames per second."""
    frames = motion_read.frames_of_stage(stage)[[0, -1]]
    d = motion_read.parameters_at(actor, np.zeros(0))
    if not np.isfinite(d).all():
        raise FormatError("its d has values that are not finite.")
    times = np.unique(frames).astype(np.float64)
    return times, np.repeat(d, len(times), axis=0), float(stage.GetTimeCodesPerSecond())


def _rank(stage: Usd.Stage, attributes: list[Usd.Attribute]) -> float:
    """Return the number of layers that are stronger than all layers with opinions about any of the attributes."""
    layers = stage.GetLayerStack(includeSessionLayers=False)
    strongest = [stack[0].layer for stack in (attribute.GetPropertyStack() for attribute in attributes) if stack]
    return min((float(layers.index(layer)) for layer in strongest if layer in layers), default=np.inf)


def write_over(
    out: AnyPath,
    stage: AnyPath,
    rig: JawRig,
    frames: ArrayLike,
    d: Array,
    fps: float,
    prim_path: str,
    carried: ArrayLike = (),
    by_skin: ArrayLike = (),
) -> Path:
    """Write a motion for one rig in a stage as a layer over the stage, keeping the frame rate of the motion.

    Args:
        out: File to write; it sublayers the stage.
        frames: Increasing frame numbers, shape (F,).
        d: Jaw parameters [mm], shape (F, 3); rows with NaN are interpolated.
        carried, by_skin: Frames whose d was inferred; see `write_animation`.

    Raises:
        JawusdError: see `write_rebaked`.
    """
    step = float(open_stage(stage).GetTimeCodesPerSecond()) / fps
    known, times = np.isfinite(d).all(axis=1), np.asarray(frames, dtype=np.float64) * step
    motion = Rebaked(rig, times[known], d[known], prim_path)
    write_rebaked(out, stage, [motion], np.asarray(carried) * step, np.asarray(by_skin) * step, root=True)
    return Path(out)


class Rebaked(NamedTuple):
    """Motion for a rig in a stage: times (F,), d (F, 3) [mm], and the rig's prim if the stage has several rigs."""

    rig: JawRig
    times: Array
    d: Array
    prim: str | None = None


def write_rebaked(
    out: AnyPath,
    shot: AnyPath,
    motions: Sequence[Rebaked],
    carried: ArrayLike = (),
    by_skin: ArrayLike = (),
    *,
    root: bool = False,
) -> list[str]:
    """Write a layer for a stage with the d of its rigs and the corresponding ops of their mandibles.

    Instances are made editable, because their mandibles cannot be moved otherwise. Rigs with a selected skeleton are
    switched to transforms. The result lists the paths on which the stage's root layer has its own opinions, which are
    stronger than those of a sublayer.

    Args:
        motions: The motions, one for each rig to animate.
        carried, by_skin: Times whose d was inferred; see `write_animation`.
        root: Whether the layer sublayers the stage; if not, it is meant to become a sublayer of the stage.

    Raises:
        RigError: The file is not a stage, the output is the stage itself, or a mandible would not have the pose of its
            d.
        FormatError: No rig or several rigs, or no mandible.
        OutputError: The file cannot be written.
    """
    out = Path(out)
    if out.resolve() == Path(shot).resolve():
        raise RigError("the output is a layer over the stage, so it cannot replace the stage.", path=out)
    stage = open_stage(shot)
    layer = _layer_over(stage, np.concatenate([motion.times for motion in motions]))
    note_unseen(layer, carried, by_skin)
    with naming_file(shot):
        actors = [_actor(stage, shot, motion.rig, motion.prim) for motion in motions]
        for actor, motion in zip(actors, motions, strict=True):
            _author(layer, actor, motion)
        _check_moves(layer, [str(actor.GetPath()) for actor in actors], motions, shot)
    if root:
        layer.subLayerPaths.append(relative_path(Path(shot), out))
    write_layer(layer, out)
    return [] if root else _overridden_by_root(stage, layer)


def _layer_over(stage: Usd.Stage, times: Array) -> Sdf.Layer:
    """Return an anonymous layer with the units, rate and time range of a stage, or of the times if it has no range."""
    layer = new_layer(float(stage.GetTimeCodesPerSecond()))
    layer.pseudoRoot.SetInfo(UsdGeom.Tokens.metersPerUnit, UsdGeom.GetStageMetersPerUnit(stage))
    layer.pseudoRoot.SetInfo(UsdGeom.Tokens.upAxis, UsdGeom.GetStageUpAxis(stage))
    layer.defaultPrim = stage.GetRootLayer().defaultPrim or stage.GetPseudoRoot().GetChildren()[0].GetName()
    layer.startTimeCode, layer.endTimeCode = float(times.min()), float(times.max())
    if stage.HasAuthoredTimeCodeRange():
        layer.startTimeCode, layer.endTimeCode = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    return layer


def _author(layer: Sdf.Layer, actor: Usd.Prim, motion: Rebaked) -> None:
    mandible = motion_read.mandible_of(actor)
    if not (away_mm := motion_read.skull_displacement_mm(actor, motion.rig)) <= motion_read.BAKED_MM:
        raise RigError(
            f"the skull of {actor.GetPath()} is moved by {away_mm:.2f} mm; "
            "a baked mandible would be displaced by as much.",
            hint="Move the actor instead of its skull, or animate it: jawusd encode, then jawusd animate.",
        )
    paths = str(actor.GetPath()), str(mandible.GetPath())
    author_motion(layer, motion.rig, motion.times, motion.d, motion.times[[0, -1]], paths)
    moved = layer.GetPrimAtPath(mandible.GetPath())
    order = Vt.TokenArray(["xformOp:translate", "xformOp:orient"])  # replaces any other transform ops
    set_attribute(moved, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, order, custom=False)
    if bones_of(mandible) is not None:
        if actor.GetVariantSet(MOTION).GetVariantSelection() != SKELETON:
            raise RigError(
                f"bones move {mandible.GetPath()} and would override the baked motion.",
                hint="Animate the actor itself: jawusd encode, then jawusd animate.",
            )
        layer.GetPrimAtPath(actor.GetPath()).variantSelections[MOTION] = TRANSFORMS
    for prefix in mandible.GetPath().GetPrefixes():
        if actor.GetStage().GetPrimAtPath(prefix).IsInstance():
            layer.GetPrimAtPath(prefix).instanceable = False


def _check_moves(layer: Sdf.Layer, prims: list[str], motions: Sequence[Rebaked], shot: AnyPath) -> None:
    """Raise RigError if a mandible, composed in its stage with a layer, lacks the pose given by d in the world."""
    root = Sdf.Layer.CreateAnonymous(".usda")
    root.timeCodesPerSecond = layer.timeCodesPerSecond
    root.subLayerPaths = [layer.identifier, str(Path(shot).resolve())]
    composed = Usd.Stage.Open(root)
    for prim, motion in zip(prims, motions, strict=True):
        away = _deviation(composed.GetPrimAtPath(prim), motion.rig)
        if away is not None and away.frames:
            raise RigError(
                f"the mandible of {prim} would still be {away.largest_mm:.2f} mm from the pose given by d.",
                hint="Prims above or below the mandible move it as well: `jawusd validate` lists them.",
            )


def _overridden_by_root(stage: Usd.Stage, layer: Sdf.Layer) -> list[str]:
    """Return the paths of a layer's attributes and prims on which the root layer of a stage has other opinions."""
    root = stage.GetRootLayer()

    def overridden(path: Sdf.Path) -> bool:
        if path.IsPrimPropertyPath() and (own := root.GetAttributeAtPath(path)):
            times = layer.ListTimeSamplesForPath(path)
            if path.name not in PARAMETERS:
                return bool(times) or own.default != layer.GetAttributeAtPath(path).default
            now = [stage.GetAttributeAtPath(path).Get(time) for time in times]
            then = [layer.QueryTimeSample(path, time) for time in times]
            return not np.allclose(now, then, rtol=0, atol=_SAME_MM)  # unchanged keys of d are no conflict
        over, own = prim_spec_at(layer, path), root.GetPrimAtPath(path)
        named = ("variantSelection", "instanceable")
        return over is not None and bool(own) and any(over.HasInfo(name) and own.HasInfo(name) for name in named)

    return [str(path) for path in paths_in(layer) if overridden(path)]
