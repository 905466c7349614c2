"""The sidebar panel: sliders of the rigs in the scene, and whether their pose is valid."""

from __future__ import annotations

import bpy

from . import carried, jaw, operators


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
        """Draw sliders, bound and buttons of every rig."""
        for actor in jaw.actors():
            box = self.layout.box()
            box.label(text=actor.name)
            try:
                rig = jaw.rig_of(actor)
            except carried.JawusdError as error:
                box.label(text=str(error), icon="ERROR")
                continue
            for name, label in zip(carried.PARAMETERS, carried.LABELS):
                box.prop(actor, f'["{name}"]', text=label)
            for text, icon in _readout(rig, jaw.parameters(actor)):
                box.label(text=text, icon=icon)
            box.prop(actor, f'["{jaw.KEEP}"]', text="Keep valid")
            captured, shown = actor.get(jaw.FPS), context.scene.render.fps / context.scene.render.fps_base
            if captured and abs(captured - shown) > 0.01:
                box.label(text=f"captured at {captured:g} fps, the scene has {shown:g}", icon="TIME")
            box.operator(operators.JAWUSD_OT_key.bl_idname).actor = actor.name
            row = box.row()
            for place in ("INCISOR", "CHIN"):
                button = row.operator(operators.JAWUSD_OT_handle.bl_idname, text=f"Handle: {place.lower()}")
                button.actor, button.at = actor.name, place
            box.operator(operators.JAWUSD_OT_export.bl_idname).actor = actor.name
            box.operator(operators.JAWUSD_OT_nodes.bl_idname).actor = actor.name


def _readout(rig: carried.JawRig, d: tuple[float, float, float]) -> list[tuple[str, str]]:
    """Return the lines, each with its icon, that say how parameters d [mm] lie to the bound."""
    inside, distance = bool(rig.is_inside(d)), abs(float(rig.margin(d)))
    word = "inside" if inside else "OUTSIDE"
    lines = [(f"{word} the bound by {distance:.1f} mm", "INFO" if inside else "ERROR")]
    d2_min, d2_max, d3_min, d3_max = rig.ranges(*d)
    if d2_min == d2_min and d3_min == d3_min:
        lines.append((f"here: d2 {d2_min:.1f} .. {d2_max:.1f}, d3 {d3_min:.1f} .. {d3_max:.1f} mm", "BLANK1"))
    return lines


def register() -> None:
    """Register the panel."""
    bpy.utils.register_class(JAWUSD_PT_sliders)


def unregister() -> None:
    """Unregister it."""
    bpy.utils.unregister_class(JAWUSD_PT_sliders)
