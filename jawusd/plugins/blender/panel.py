"""The sidebar panel: sliders of the rigs in the scene, and whether their pose is valid."""

from __future__ import annotations

import bpy

from . import jaw, jawusd_reader


class JAWUSD_OT_key(bpy.types.Operator):
    """The operator behind the key button."""

    bl_idname = "jawusd.key"
    bl_label = "Key Jaw"
    bl_description = "Set a key on all three jaw parameters at the current frame"
    bl_options = {"REGISTER", "UNDO"}

    __annotations__ = {"actor": bpy.props.StringProperty()}  # Blender reads properties from annotations

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Insert the keys."""
        for name in jawusd_reader.PARAMETERS:
            bpy.data.objects[self.actor].keyframe_insert(f'["{name}"]')
        return {"FINISHED"}


class JAWUSD_PT_sliders(bpy.types.Panel):
    """Jaw parameters of every rig in the scene."""

    bl_label = "Jaw"
    bl_category = "Jaw"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Show the panel when the scene has a rig."""
        return bool(jaw.actors())

    def draw(self, context: bpy.types.Context) -> None:
        """Draw sliders, margin and key button of every rig."""
        for actor in jaw.actors():
            box = self.layout.box()
            box.label(text=actor.name)
            for name, label in zip(jawusd_reader.PARAMETERS, jawusd_reader.LABELS):
                box.prop(actor, f'["{name}"]', text=label)
            rig, d = jaw.rig_of(actor), [actor[name] for name in jawusd_reader.PARAMETERS]
            inside, distance = rig.is_inside(*d), abs(rig.margin(*d))
            word = "inside" if inside else "OUTSIDE"
            box.label(text=f"{word} the bound by {distance:.1f} mm", icon="INFO" if inside else "ERROR")
            captured, shown = actor.get("jawusd_fps"), context.scene.render.fps / context.scene.render.fps_base
            if captured and abs(captured - shown) > 0.01:
                box.label(text=f"captured at {captured:g} fps, the scene has {shown:g}", icon="TIME")
            box.operator(JAWUSD_OT_key.bl_idname).actor = actor.name


_CLASSES = (JAWUSD_OT_key, JAWUSD_PT_sliders)


def register() -> None:
    """Register operator and panel."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Unregister them."""
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
