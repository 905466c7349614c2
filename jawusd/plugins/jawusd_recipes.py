"""Drive a mandible with a jaw rig in Maya, Houdini or Unreal: short recipes on top of `jawusd_reader.py`.

Put both files on the Python path of the program. `model.npz` can be read without `pxr`.

    import jawusd_reader, jawusd_recipes as recipes
    rig = jawusd_reader.load("actor/model.npz")              # or actor.usda, if the program includes pxr

    # Maya: import or reference actor.usda, then
    controls = recipes.maya_controls(rig)                    # a group with d1, d2, d3 [mm]; set keys on them
    recipes.maya_bake(rig, controls, "Mandible", 1, 100)     # keys the mandible accordingly

    # Houdini: a null with d1, d2, d3, and the mandible's object
    recipes.houdini_controls(rig, hou.node("/obj/jaw"))
    recipes.houdini_bake(rig, hou.node("/obj/jaw"), hou.node("/obj/mandible"), 1, 100)

    # Unreal: the mandible's binding in a level sequence, and keys of d1, d2, d3 by frame
    recipes.unreal_keys(rig, binding, {0: (0, 0, 0), 24: (20, 0, 0)})

Every whole frame gets a key, with linear interpolation between keys; with sparse keys, the jaw would leave its path by
millimetres. Parameters outside the bound are replaced by the nearest valid parameters, with a warning; `measured=True`
keeps them, for captured takes of the subject. Angles are continuous from frame to frame.

The mandible's transform is replaced by T_skull_mandible; its parent must have the pose of the skull. Lengths are in
millimetres; if the scene uses another unit and the parent does not scale, set `scale`, such as 0.1 for centimetres.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import jawusd_reader

if TYPE_CHECKING:
    import hou
    import unreal

Rows = Sequence[Sequence[float]]
Keys = Mapping[int, Sequence[float]]  # d1, d2, d3 [mm] by frame number

_MAYA_ROTATE_ORDERS = ("xyz", "yzx", "zxy", "xzy", "yxz", "zyx")


def every_frame(keys: Keys) -> dict[int, list[float]]:
    """Return d at every whole frame from the first to the last key, linearly interpolated as in USD."""
    found = {}
    known = sorted(keys)
    for start, end in zip(known, [*known[1:], known[-1] + 1]):
        for frame in range(start, end):
            share = (frame - start) / (end - start)
            found[frame] = [a + share * (b - a) for a, b in zip(keys[start], keys.get(end, keys[start]))]
    return found


def poses(rig: jawusd_reader.Rig, keys: Keys, *, measured: bool = False) -> dict[int, Rows]:
    """Return T_skull_mandible [mm] at every key of d1, d2, d3 [mm]; warn about keys outside the bound.

    These are moved to the nearest valid d, unless `measured`: measured poses may be slightly outside.
    """
    outside = {frame: -rig.margin(*d) for frame, d in keys.items() if not rig.is_inside(*d)}
    if outside:
        worst = max(outside, key=lambda frame: outside[frame])
        d = ", ".join(f"{x:.2f}" for x in keys[worst])
        what = "kept as they are" if measured else "moved to the nearest d inside"
        warnings.warn(
            f"{len(outside)} of {len(keys)} frames are outside the bound and {what}; "
            f"the farthest is frame {worst}, d = ({d}) mm, by {outside[worst]:.2f} mm",
            stacklevel=3,
        )
    moved = {frame: rig.project(*keys[frame]) for frame in outside if not measured}
    return {frame: rig.pose(*moved.get(frame, d)) for frame, d in keys.items()}


def nearest_turn(
    angles: Sequence[float], previous: Sequence[float] | None, middle: int = 1, full: float = 360.0
) -> list[float]:
    """Return the equivalent Euler angles nearest to those of the previous frame, if there is one.

    `middle` is the index of the angle that the program applies second, `full` a full turn in the unit of the angles.
    """
    if previous is None:
        return list(angles)
    other = [angle + 0.5 * full for angle in angles]
    other[middle] = 0.5 * full - angles[middle]
    same = [[a - full * round((a - b) / full) for a, b in zip(turn, previous)] for turn in (angles, other)]
    return min(same, key=lambda turn: math.dist(turn, previous))


def row_matrix(T: Rows, scale: float = 1.0) -> list[float]:
    """Return a pose as 16 numbers for programs with row vectors (Maya, Houdini): transposed, with scaled lengths."""
    rows = [[T[i][j] for i in range(3)] + [0.0] for j in range(3)]
    return [x for row in [*rows, [scale * T[i][3] for i in range(3)] + [1.0]] for x in row]


def unreal_pose(T: Rows, scale: float = 0.1) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return location and quaternion (x, y, z, w) of a pose in Unreal's left-handed axes with Z up.

    Unreal's USD importer swaps y and z, which is a reflection S. A rotation R becomes S R S, whose axis is that of R
    with y and z swapped and all signs changed.
    """
    (x, y, z), (qw, qx, qy, qz) = jawusd_reader.decompose(T)
    return (scale * x, scale * z, scale * y), (-qx, -qz, -qy, qw)


def maya_controls(rig: jawusd_reader.Rig, name: str = "jaw_controls") -> str:
    """Create a group with the three parameters as keyable attributes and return its name."""
    from maya import cmds

    group = cmds.group(empty=True, name=name)
    for parameter, label, (low, high) in zip(jawusd_reader.PARAMETERS, jawusd_reader.LABELS, rig.d_range):
        cmds.addAttr(
            group,
            longName=parameter,
            niceName=label,
            attributeType="double",
            minValue=low,
            maxValue=high,
            keyable=True,
        )
    return group


def maya_bake(
    rig: jawusd_reader.Rig,
    controls: str,
    mandible: str,
    first: int,
    last: int,
    scale: float = 1.0,
    *,
    measured: bool = False,
) -> None:
    """Key the mandible at every frame from first to last according to the controls; see `poses`."""
    from maya import cmds

    names = [f"{kind}{axis}" for kind in ("translate", "rotate") for axis in "XYZ"]
    middle = "xyz".index(_MAYA_ROTATE_ORDERS[cmds.getAttr(f"{mandible}.rotateOrder")][1])
    full = 360.0 if cmds.currentUnit(query=True, angle=True) == "deg" else 2.0 * math.pi
    keys = {
        frame: [cmds.getAttr(f"{controls}.{parameter}", time=frame) for parameter in jawusd_reader.PARAMETERS]
        for frame in range(first, last + 1)
    }
    previous = None
    for frame, T in poses(rig, keys, measured=measured).items():
        cmds.xform(mandible, matrix=row_matrix(T, scale), objectSpace=True)
        previous = nearest_turn(cmds.getAttr(f"{mandible}.rotate")[0], previous, middle, full)
        for name, value in zip(names, (*cmds.getAttr(f"{mandible}.translate")[0], *previous)):
            cmds.setKeyframe(
                mandible, attribute=name, time=frame, value=value, inTangentType="linear", outTangentType="linear"
            )


def houdini_controls(rig: jawusd_reader.Rig, node: hou.Node) -> None:
    """Add d1, d2 and d3 to a node as parameters."""
    import hou

    group = node.parmTemplateGroup()
    for parameter, label, (low, high) in zip(jawusd_reader.PARAMETERS, jawusd_reader.LABELS, rig.d_range):
        group.append(hou.FloatParmTemplate(parameter, label, 1, min=low, max=high))
    node.setParmTemplateGroup(group)


def houdini_bake(
    rig: jawusd_reader.Rig,
    controls: hou.Node,
    mandible: hou.Node,
    first: int,
    last: int,
    scale: float = 1.0,
    *,
    measured: bool = False,
) -> None:
    """Key the mandible's object at every frame from first to last according to the controls; see `poses`."""
    import hou

    orders = {
        "transform_order": mandible.parm("xOrd").evalAsString(),
        "rotate_order": mandible.parm("rOrd").evalAsString(),
    }
    keys = {
        frame: [controls.parm(parameter).evalAtFrame(frame) for parameter in jawusd_reader.PARAMETERS]
        for frame in range(first, last + 1)
    }
    previous = None
    for frame, T in poses(rig, keys, measured=measured).items():
        parts = hou.Matrix4(row_matrix(T, scale)).explode(**orders)
        previous = nearest_turn(parts["rotate"], previous, "xyz".index(orders["rotate_order"][1]))
        for name, values in (("t", parts["translate"]), ("r", previous)):
            for parm, value in zip(mandible.parmTuple(name), values):
                key = hou.Keyframe(value)
                key.setFrame(frame)
                key.setExpression("linear()", hou.exprLanguage.Hscript)
                parm.setKeyframe(key)


def unreal_keys(
    rig: jawusd_reader.Rig,
    binding: unreal.MovieSceneBindingProxy,
    keys: Keys,
    scale: float = 0.1,
    *,
    measured: bool = False,
) -> None:
    """Add a transform track to a mandible's binding in a level sequence, from keys of (d1, d2, d3) [mm] by frame.

    The track has a key at every frame from the first to the last; see `every_frame` and `poses`.
    """
    import unreal

    section = binding.add_track(unreal.MovieScene3DTransformTrack).add_section()
    section.set_range(min(keys), max(keys) + 1)
    channels = section.get_all_channels()  # channels: location x y z, rotation roll pitch yaw, scale x y z
    previous = None
    for frame, T in poses(rig, every_frame(keys), measured=measured).items():
        location, quaternion = unreal_pose(T, scale)
        rotator = unreal.Quat(*quaternion).rotator()
        previous = nearest_turn((rotator.roll, rotator.pitch, rotator.yaw), previous)
        for channel, value in zip(channels, (*location, *previous)):
            channel.add_key(unreal.FrameNumber(frame), value, interpolation=unreal.MovieSceneKeyInterpolation.LINEAR)
