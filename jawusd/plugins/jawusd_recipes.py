"""Drive a mandible with a jaw rig in Maya, Houdini or Unreal: short recipes on top of `jawusd_reader.py`.

Put both files where the program's Python finds them. `model.npz` is read without `pxr`.

    import jawusd_reader, jawusd_recipes as recipes
    rig = jawusd_reader.load("actor/model.npz")              # or actor.usda, where the program brings pxr

    # Maya: import or reference actor.usda, then
    controls = recipes.maya_controls(rig)                    # a group with d1, d2, d3 [mm]; set keys on them
    recipes.maya_bake(rig, controls, "Mandible", 1, 100)     # keys the mandible from them

    # Houdini: a null with d1, d2, d3, and the object that carries the mandible
    recipes.houdini_controls(rig, hou.node("/obj/jaw"))
    recipes.houdini_bake(rig, hou.node("/obj/jaw"), hou.node("/obj/mandible"), 1, 100)

    # Unreal: the mandible's binding in a level sequence, and d1, d2, d3 per frame
    recipes.unreal_keys(rig, binding, {0: (0, 0, 0), 24: (20, 0, 0)})

The mandible's own transform is replaced by T_skull_mandible, below a parent at the skull's pose. Lengths
are millimetres; where the parent does not scale them, give `scale`, 0.1 for centimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import jawusd_reader

if TYPE_CHECKING:
    import hou
    import unreal

Rows = Sequence[Sequence[float]]


def row_matrix(T: Rows, scale: float = 1.0) -> list[float]:
    """Return the 16 numbers of a pose for programs with row vectors, Maya and Houdini: transposed, lengths scaled."""
    rows = [[T[i][j] for i in range(3)] + [0.0] for j in range(3)]
    return [x for row in [*rows, [scale * T[i][3] for i in range(3)] + [1.0]] for x in row]


def unreal_pose(T: Rows, scale: float = 0.1) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return location and quaternion (x, y, z, w) of a pose in Unreal's left-handed axes with Z up.

    Its USD importer swaps y and z, a reflection S; R becomes S R S, whose axis is the swapped one turned round.
    """
    (x, y, z), (qw, qx, qy, qz) = jawusd_reader.decompose(T)
    return (scale * x, scale * z, scale * y), (-qx, -qz, -qy, qw)


def maya_controls(rig: jawusd_reader.Rig, name: str = "jaw_controls") -> str:
    """Make a group with the three parameters as keyable attributes and return its name."""
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


def maya_bake(rig: jawusd_reader.Rig, controls: str, mandible: str, first: int, last: int, scale: float = 1.0) -> None:
    """Key the mandible at every frame from first to last by what the controls say there."""
    from maya import cmds

    for frame in range(first, last + 1):
        d = [cmds.getAttr(f"{controls}.{parameter}", time=frame) for parameter in jawusd_reader.PARAMETERS]
        cmds.xform(mandible, matrix=row_matrix(rig.pose(*d), scale), objectSpace=True)
        cmds.setKeyframe(mandible, attribute=["translate", "rotate"], time=frame)


def houdini_controls(rig: jawusd_reader.Rig, node: hou.Node) -> None:
    """Give a node the three parameters."""
    import hou

    group = node.parmTemplateGroup()
    for parameter, label, (low, high) in zip(jawusd_reader.PARAMETERS, jawusd_reader.LABELS, rig.d_range):
        group.append(hou.FloatParmTemplate(parameter, label, 1, min=low, max=high))
    node.setParmTemplateGroup(group)


def houdini_bake(
    rig: jawusd_reader.Rig, controls: hou.Node, mandible: hou.Node, first: int, last: int, scale: float = 1.0
) -> None:
    """Key the mandible's object at every frame from first to last by what the controls say there."""
    import hou

    for frame in range(first, last + 1):
        d = [controls.parm(parameter).evalAtFrame(frame) for parameter in jawusd_reader.PARAMETERS]
        matrix = hou.Matrix4(row_matrix(rig.pose(*d), scale))
        for name, values in (("t", matrix.extractTranslates()), ("r", matrix.extractRotates())):
            for parm, value in zip(mandible.parmTuple(name), values):
                key = hou.Keyframe(value)
                key.setFrame(frame)
                parm.setKeyframe(key)


def unreal_keys(
    rig: jawusd_reader.Rig,
    binding: unreal.MovieSceneBindingProxy,
    keys: Mapping[int, Sequence[float]],
    scale: float = 0.1,
) -> None:
    """Give a mandible's binding in a level sequence a transform track through parameters (d1, d2, d3) [mm] by frame."""
    import unreal

    section = binding.add_track(unreal.MovieScene3DTransformTrack).add_section()
    section.set_range(min(keys), max(keys) + 1)
    channels = section.get_all_channels()  # location x y z, rotation roll pitch yaw, scale x y z
    for frame, d in sorted(keys.items()):
        location, quaternion = unreal_pose(rig.pose(*d), scale)
        turn = unreal.Quat(*quaternion).rotator()
        for channel, value in zip(channels, (*location, turn.roll, turn.pitch, turn.yaw)):
            channel.add_key(unreal.FrameNumber(frame), value)
