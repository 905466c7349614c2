"""Panels: sliders of the rigs in the scene, validity of the poses, and a warning if an export would lose motion."""

from __future__ import annotations

import bpy

from . import bake, jaw, operators, vendored


class JAWUSD_PT_sliders(bpy.types.Panel):
    """Panel with the jaw parameters of every rig in the scene."""

    bl_label = "Jaw"
    bl_category = "Jaw"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Show the panel if the file contains a rig."""
        return bool(jaw.actors() or jaw.without_sliders())

    def draw(self, context: bpy.types.Context) -> None:
        """Draw sliders, distance to the bound and buttons of every rig."""
        for actor in jaw.actors():
            box = self.layout.box()
            box.label(text=actor.name)
            try:
                rig, driven = jaw.rig_of(actor), jaw.is_driven(jaw.mandible_of(actor))
            except vendored.JawusdError as error:
                box.label(text=str(error), icon="ERROR")
                continue
            for name, label in zip(vendored.PARAMETERS, vendored.LABELS):
                box.prop(actor, f'["{name}"]', text=label)
            for text, icon in _readout(rig, jaw.parameters(actor)):
                box.label(text=text, icon=icon)
            box.prop(actor, f'["{jaw.KEEP}"]', text="Keep valid")
            captured, shown = actor.get(jaw.FPS), context.scene.render.fps / context.scene.render.fps_base
            if captured and abs(captured - shown) > 0.01:
                box.label(text=f"captured at {captured:g} fps; the scene has {shown:g}", icon="TIME")
            box.operator(operators.JAWUSD_OT_key.bl_idname).actor = actor.name
            row = box.row()
            for place in ("INCISOR", "CHIN"):
                button = row.operator(operators.JAWUSD_OT_handle.bl_idname, text=f"Handle: {place.lower()}")
                button.actor, button.at = actor.name, place
            box.operator(operators.JAWUSD_OT_export.bl_idname).actor = actor.name
            row = box.row()
            if driven:
                for frames in ("SCENE", "TAKE"):
                    button = row.operator(operators.JAW_OT_bake_to_keys.bl_idname, text=f"Bake: {frames.lower()}")
                    button.actor, button.frames = actor.name, frames
                box.label(text="FBX, glTF and render farms need baked keys", icon="INFO")
            else:
                row.operator(operators.JAW_OT_use_sliders.bl_idname).actor = actor.name
                box.label(text="Baked to keys: the sliders do not move the jaw", icon="INFO")
        for text in jaw.without_sliders():
            self.layout.label(text=text, icon="LOCKED")


class JAW_PT_export(bpy.types.Panel):
    """Panel beside the export settings in the file browser, with a warning about motion that an export loses."""

    bl_label = "Jaw"
    bl_space_type = "FILE_BROWSER"
    bl_region_type = "TOOL_PROPS"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Show the panel when a file with a rig is exported to a format without drivers."""
        exporter = context.space_data.active_operator
        return exporter is not None and exporter.bl_idname in bake.SETTINGS and bool(jaw.actors())

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the warning, the bake button, and the relevant settings of the exporter."""
        warning, exporter = bake.warning(context.scene), context.space_data.active_operator
        if warning:
            self.layout.label(text=warning, icon="ERROR")
            self.layout.operator(operators.JAW_OT_bake_to_keys.bl_idname)
        for name, advice in bake.SETTINGS[exporter.bl_idname].items():
            self.layout.label(text=advice)
            self.layout.prop(exporter, name)


def _readout(rig: vendored.JawRig, d: tuple[float, float, float]) -> list[tuple[str, str]]:
    """Return lines of text, with icons, on how far parameters d [mm] are inside or outside the bound."""
    inside, distance = bool(rig.is_inside(d)), abs(float(rig.margin(d)))
    word = "inside" if inside else "OUTSIDE"
    lines = [(f"{word} the bound by {distance:.1f} mm", "INFO" if inside else "ERROR")]
    d2_min, d2_max, d3_min, d3_max = rig.ranges(*d)
    if d2_min == d2_min and d3_min == d3_min:
        lines.append((f"here: d2 {d2_min:.1f} .. {d2_max:.1f}, d3 {d3_min:.1f} .. {d3_max:.1f} mm", "BLANK1"))
    return lines


_CLASSES = (JAWUSD_PT_sliders, JAW_PT_export)


def register() -> None:
    """Register the panels."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Unregister the panels."""
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
