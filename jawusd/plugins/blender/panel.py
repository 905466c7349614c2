"""Panels, and the operators of their buttons: key, add handle, export, bake."""

from __future__ import annotations

import bpy
import numpy as np
from bpy_extras.io_utils import ExportHelper

from . import bake, handle, jaw, vendored

_CHIN_HALF_WIDTH_MM = 10.0


def _actor(operator: bpy.types.Operator) -> bpy.types.Object:
    return bpy.data.objects[operator.actor]


class JAWUSD_OT_key(bpy.types.Operator):
    """Operator of the key button."""

    bl_idname = "jawusd.key"
    bl_label = "Key Jaw"
    bl_description = "Set a key on all three jaw parameters at the current frame"
    bl_options = {"REGISTER", "UNDO"}

    __annotations__ = {"actor": bpy.props.StringProperty()}  # Blender reads properties from annotations

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Insert the keys."""
        for name in vendored.PARAMETERS:
            _actor(self).keyframe_insert(f'["{name}"]')
        return {"FINISHED"}


class JAWUSD_OT_handle(bpy.types.Operator):
    """Operator of the handle buttons."""

    bl_idname = "jawusd.handle"
    bl_label = "Add Jaw Handle"
    bl_description = "Add an empty with which you can drag the jaw; the sliders follow, inside the bound"
    bl_options = {"REGISTER", "UNDO"}

    __annotations__ = {
        "actor": bpy.props.StringProperty(),
        "at": bpy.props.EnumProperty(
            items=[("INCISOR", "Incisor", "The lower incisal point"), ("CHIN", "Chin", "The front of the mandible")]
        ),
    }

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add the handle."""
        actor = _actor(self)
        rig = jaw.rig_of(actor)
        point = rig.landmarks[0] if self.at == "INCISOR" else _chin(actor, rig)
        made = handle.add(actor, tuple(point.tolist()), f"{actor.name} {self.at.lower()}")
        context.view_layer.objects.active = made
        return {"FINISHED"}


def _chin(actor: bpy.types.Object, rig: vendored.JawRig) -> vendored.Array:
    """Return the lowest vertex of the mandible below the incisal point [mm], in the mandible frame."""
    meshes = jaw.meshes_of(jaw.mandible_of(actor))
    points = np.concatenate([np.array([v.co for v in mesh.data.vertices], dtype=np.float64) for mesh in meshes])
    side, up, _ = (rig.T_anatomical_skull @ rig.T_rest)[:3, :3] @ (points - rig.landmarks[0]).T
    return points[int(np.argmin(np.where(np.abs(side) < _CHIN_HALF_WIDTH_MM, up, np.inf)))]


class JAWUSD_OT_export(bpy.types.Operator, ExportHelper):
    """Operator of the export button."""

    bl_idname = "jawusd.export"
    bl_label = "Export Jaw Animation"
    bl_description = "Write d and the baked mandible of every frame to a USD layer over the rig, inside the bound"
    filename_ext = ".usdc"

    __annotations__ = {"actor": bpy.props.StringProperty()}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Write the layer."""
        from . import vendored_usd

        actor, scene = _actor(self), context.scene
        frames = range(scene.frame_start, scene.frame_end + 1)
        d = bake.parameters_over(actor, scene, frames)
        rig, rate = jaw.rig_of(actor), scene.render.fps / scene.render.fps_base
        try:
            inside = rig.keep_inside(np.array(frames, dtype=np.float64), d)
            vendored_usd.write_animation(self.filepath, actor[jaw.SOURCE], inside.times, inside.d, rate, rig=rig)
        except vendored.JawusdError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        moved = float(np.linalg.norm(inside.d[inside.given] - d, axis=1).max())
        self.report({"INFO"}, f"{len(frames)} frames, with d moved by up to {moved:.2f} mm to stay inside the bound")
        return {"FINISHED"}


class JAW_OT_bake_to_keys(bpy.types.Operator):
    """Operator of the bake button; scripts call `bpy.ops.jaw.bake_to_keys()`."""

    bl_idname = "jaw.bake_to_keys"
    bl_label = "Bake to Keys"
    bl_description = (
        "Key the mandible at every frame and detach it from the sliders: for FBX, glTF, game engines and render farms"
    )
    bl_options = {"REGISTER", "UNDO"}

    __annotations__ = {
        "actor": bpy.props.StringProperty(description="The actor; all actors in the file if empty"),
        "frames": bpy.props.EnumProperty(
            items=[
                ("SCENE", "Scene", "From the start to the end of the scene"),
                ("TAKE", "Take", "From the first to the last key of the sliders"),
            ]
        ),
    }

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Bake the mandibles of the chosen actors."""
        chosen, scene = [found for found in jaw.actors() if self.actor in ("", found.name)], context.scene
        if not chosen:
            self.report({"ERROR"}, f"There is no jaw rig {self.actor or 'in the file'}. Import one from USD.")
            return {"CANCELLED"}
        try:
            spans = [bake.frames_of(actor, scene, self.frames) for actor in chosen]
            for actor, frames in zip(chosen, spans):
                bake.bake(actor, scene, frames)
        except vendored.JawusdError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        names = ", ".join(f"{actor.name}: frames {span[0]} .. {span[-1]}" for actor, span in zip(chosen, spans))
        self.report({"INFO"}, f"{names}. {JAW_OT_use_sliders.bl_label} reconnects the sliders")
        return {"FINISHED"}


class JAW_OT_use_sliders(bpy.types.Operator):
    """Operator of the button that undoes a bake."""

    bl_idname = "jaw.use_sliders"
    bl_label = "Use Sliders"
    bl_description = "Remove the baked keys, so that the sliders move the jaw again"
    bl_options = {"REGISTER", "UNDO"}

    __annotations__ = {"actor": bpy.props.StringProperty()}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Reconnect the mandible to the sliders."""
        mandible = jaw.mandible_of(_actor(self))
        bake.remove_baked_keys(mandible)
        jaw.drive(mandible, _actor(self))
        return {"FINISHED"}


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
            box.operator(JAWUSD_OT_key.bl_idname).actor = actor.name
            row = box.row()
            for place in ("INCISOR", "CHIN"):
                button = row.operator(JAWUSD_OT_handle.bl_idname, text=f"Handle: {place.lower()}")
                button.actor, button.at = actor.name, place
            box.operator(JAWUSD_OT_export.bl_idname).actor = actor.name
            row = box.row()
            if driven:
                for frames in ("SCENE", "TAKE"):
                    button = row.operator(JAW_OT_bake_to_keys.bl_idname, text=f"Bake: {frames.lower()}")
                    button.actor, button.frames = actor.name, frames
                box.label(text="FBX, glTF and render farms need baked keys", icon="INFO")
            else:
                row.operator(JAW_OT_use_sliders.bl_idname).actor = actor.name
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
            self.layout.operator(JAW_OT_bake_to_keys.bl_idname)
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


_CLASSES = (
    JAWUSD_OT_key,
    JAWUSD_OT_handle,
    JAWUSD_OT_export,
    JAW_OT_bake_to_keys,
    JAW_OT_use_sliders,
    JAWUSD_PT_sliders,
    JAW_PT_export,
)


def register() -> None:
    """Register the operators and the panels."""
    for cls in _CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    """Unregister the panels and the operators."""
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
