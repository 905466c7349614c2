"""Turn a jaw rig into a Blender file that needs no add-on: sliders of a Geometry Nodes modifier move the mandible.

    blender -b -P blender_nodes.py -- actor/anim_capture.usdc jaw.blend

Needs `jawusd_reader.py` beside it. The file holds no scripts and works where scripts are switched off. The nodes
compute the exact model in Blender's single precision. The sliders are inputs of the modifier "Jaw" on the mandible's
mesh; drivers copy them to its other meshes. The nodes move vertices, not objects. Slider limits are those of the whole
range; only the add-on shows what is valid at an opening.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import bpy

if TYPE_CHECKING:
    from pxr import Usd

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import jawusd_reader
from jawusd_reader import PARAMETERS, Rows, Triple, dot, long_angle_series, polynomial, triple

MODIFIER = "Jaw"
_LABELS = ("Opening", "Laterotrusion", "Protrusion")
_TABLES = "JawTables"


def make_file(usd: str, blend: str) -> None:
    """Write a Blender file with the rig of a USD file, its captured motion as keys of the sliders.

    Args:
        usd: Any file that holds one rig and its meshes, `actor.usda`, an animation of it or `actor.usdz`.

    Raises:
        jawusd_reader.ReaderError: There is not exactly one rig, or it has no mandible.
    """
    bpy.ops.wm.read_homefile(use_empty=True)
    jawusd_reader.find_blender_pxr(bpy.utils.resource_path)
    from pxr import Usd

    stage = Usd.Stage.Open(usd)
    prims = jawusd_reader.find_rigs(stage)
    if len(prims) != 1:
        raise jawusd_reader.ReaderError(f"{usd} holds {len(prims)} jaw rigs, expected one")
    bpy.ops.wm.usd_import(filepath=usd)
    scene = bpy.context.scene
    scene.render.fps = max(1, round(stage.GetTimeCodesPerSecond()))
    scene.render.fps_base = scene.render.fps / stage.GetTimeCodesPerSecond()
    if stage.HasAuthoredTimeCodeRange():
        scene.frame_start, scene.frame_end = int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode())
    meshes = _mandible_meshes(stage.GetPrimAtPath(prims[0].GetRelationship("jaw:mandible").GetTargets()[0]))
    add_sliders(jawusd_reader.from_prim(prims[0]), meshes, prims[0])
    bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(blend))


def add_sliders(rig: jawusd_reader.Rig, meshes: Sequence[bpy.types.Object], prim: Usd.Prim) -> None:
    """Give the meshes of a mandible the modifier; the first one carries the sliders, with the keys of the prim."""
    inputs = _add_nodes(rig, meshes)
    first = meshes[0]
    for name, identifier in zip(PARAMETERS, inputs):
        path = _path(identifier)
        attribute = prim.GetAttribute(f"jaw:{name}")
        first.modifiers[MODIFIER][identifier] = float(attribute.Get() or 0.0)
        for time in attribute.GetTimeSamples():
            first.modifiers[MODIFIER][identifier] = attribute.Get(time)
            first.keyframe_insert(path, frame=time)
        for mesh in meshes[1:]:
            _copy(mesh, path, first, path)
    action = first.animation_data.action if first.animation_data else None
    for layer in action.layers if action else ():
        for strip in layer.strips:
            for curve in [curve for bag in strip.channelbags for curve in bag.fcurves]:
                for point in curve.keyframe_points:
                    point.interpolation = "LINEAR"


def add_driven_nodes(
    kind: str, arrays: Mapping[str, Iterable[float]], meshes: Sequence[bpy.types.Object], actor: bpy.types.Object
) -> None:
    """Give the meshes of a mandible the modifier, driven by the properties d1, d2, d3 of an actor.

    Args:
        kind: Of the model.
        arrays: The model's arrays, of any shape.
    """
    flat = {name: [float(x) for x in _flattened(values)] for name, values in arrays.items()}
    for name, identifier in zip(PARAMETERS, _add_nodes(jawusd_reader.Rig(kind, flat), meshes)):
        for mesh in meshes:
            _copy(mesh, _path(identifier), actor, f'["{name}"]')


def _flattened(values: Iterable[float]) -> Iterable[float]:
    return values.ravel() if hasattr(values, "ravel") else values


def _add_nodes(rig: jawusd_reader.Rig, meshes: Sequence[bpy.types.Object]) -> list[str]:
    """Give the meshes the modifier; return the identifiers of its three inputs."""
    group, inputs = _node_group(rig)
    for mesh in meshes:
        mesh.modifiers.new(MODIFIER, "NODES").node_group = group
    return inputs


def _path(identifier: str) -> str:
    return f'modifiers["{MODIFIER}"]["{identifier}"]'


def _copy(mesh: bpy.types.Object, path: str, source: bpy.types.Object, source_path: str) -> None:
    """Drive a property by another one."""
    driver = mesh.driver_add(path).driver
    driver.type = "SUM"  # of one value: no Python
    variable = driver.variables.new()
    variable.targets[0].id = source
    variable.targets[0].data_path = source_path


def _mandible_meshes(prim: Usd.Prim) -> list[bpy.types.Object]:
    """Return the imported meshes below a prim, freed of the cached motion and of the rest pose of their parents."""
    names = [child.GetName() for child in prim.GetChildren()]
    meshes = [bpy.data.objects[name] for name in names if name in bpy.data.objects]
    meshes = [found for found in meshes if found.type == "MESH"]
    if not meshes:
        raise jawusd_reader.ReaderError(f"no mesh below {prim.GetPath()} was imported")
    # A prim with an only mesh comes as one object, else as an empty with the meshes below it.
    mandible = bpy.data.objects.get(prim.GetName()) or meshes[0]
    for constraint in list(mandible.constraints):
        if constraint.type == "TRANSFORM_CACHE":
            mandible.constraints.remove(constraint)
    mandible.matrix_basis.identity()
    return meshes


def _node_group(rig: jawusd_reader.Rig) -> tuple[bpy.types.NodeTree, list[str]]:
    """Return the node group of a rig, and the identifiers of its three sliders."""
    group = bpy.data.node_groups.new(MODIFIER, "GeometryNodeTree")
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    identifiers = []
    for name, label, (low, high) in zip(PARAMETERS, _LABELS, rig.d_range):
        socket = group.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
        socket.min_value, socket.max_value = low, high
        socket.description = f"{label} [mm]"
        identifiers.append(socket.identifier)
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    nodes = _Nodes(group)
    given = group.nodes.new("NodeGroupInput")
    d = triple([_Number(nodes, given.outputs[name]) for name in PARAMETERS])
    motion = rig.formula.motion(d, {name: nodes.store(name, rows) for name, rows in rig.formula.tables.items()}, nodes)
    closed = _image(rig.matrices[1], triple(nodes.separated(nodes.node("GeometryNodeInputPosition").outputs[0])))
    setter = group.nodes.new("GeometryNodeSetPosition")
    group.links.new(given.outputs["Geometry"], setter.inputs["Geometry"])
    combined = nodes.node("ShaderNodeCombineXYZ", *_image(rig.matrices[0], motion.carry(closed)))
    group.links.new(combined.outputs[0], setter.inputs["Position"])
    result = group.nodes.new("NodeGroupOutput")
    group.links.new(setter.outputs["Geometry"], result.inputs["Geometry"])
    for index, node in enumerate(group.nodes):
        node.location = (200 * (index % 24), -200 * (index // 24))
        node.hide = True
    return group, identifiers


def _image(T: Rows, p: Triple[_Number]) -> Triple[_Number]:
    """Return the image of a point under a constant transform."""
    return triple([dot(p, triple(row[:3])) + row[3] for row in T[:3]])


class _Number(jawusd_reader.Symbol):
    """A socket with operators, each of which adds a node."""

    def __init__(self, nodes: _Nodes, socket: bpy.types.NodeSocket) -> None:
        self.nodes, self.socket = nodes, socket

    def operation(self, name: str, *operands: _Number | float) -> _Number:
        """Add an arithmetic node."""
        return self.nodes.math(name.upper(), *operands)


class _Table(NamedTuple):
    """A table in a hidden mesh: one point a row, and named attributes that hold three columns each."""

    geometry: bpy.types.NodeSocket
    attributes: list[str]
    width: int


class _Nodes:
    """Write formulas as nodes: `Operations` on `_Number`, of which a wide one is a field over the points of a table."""

    def __init__(self, group: bpy.types.NodeTree) -> None:
        self._group = group
        self._carriers: dict[int, tuple[bpy.types.Mesh, bpy.types.NodeSocket]] = {}

    def node(self, kind: str, *values: _Number | float, **settings: str | bool) -> bpy.types.Node:
        """Add a node; return it."""
        node = self._group.nodes.new(kind)
        for name, setting in settings.items():
            setattr(node, name, setting)
        for socket, value in zip([socket for socket in node.inputs if socket.enabled], values):
            if isinstance(value, _Number):
                self._group.links.new(value.socket, socket)
            else:
                socket.default_value = value
        return node

    def math(self, operation: str, *values: _Number | float) -> _Number:
        """Return the result of a scalar operation."""
        return _Number(self, self.node("ShaderNodeMath", *values, operation=operation).outputs[0])

    def separated(self, vector: bpy.types.NodeSocket) -> list[_Number]:
        """Return the three components of a vector."""
        node = self.node("ShaderNodeSeparateXYZ")
        self._group.links.new(vector, node.inputs[0])
        return [_Number(self, socket) for socket in node.outputs]

    def store(self, name: str, rows: Rows) -> _Table:
        """Store a table; those with as many rows share a mesh."""
        if len(rows) not in self._carriers:
            mesh = bpy.data.meshes.new(f"{_TABLES}{len(rows)}")
            mesh.from_pydata([(0.0, 0.0, 0.0)] * len(rows), [], [])
            carrier = bpy.data.objects.new(mesh.name, mesh)  # in no collection: it is not visible
            carrier.use_fake_user = True
            node = self.node("GeometryNodeObjectInfo", transform_space="ORIGINAL")
            node.inputs["Object"].default_value = carrier
            self._carriers[len(rows)] = (mesh, node.outputs["Geometry"])
        mesh, geometry = self._carriers[len(rows)]
        width, attributes = len(rows[0]), []
        for first in range(0, width, 3):
            attributes.append(f"{name}{first}")
            stored = mesh.attributes.new(attributes[-1], "FLOAT_VECTOR", "POINT")
            flat = [row[k] if k < width else 0.0 for row in rows for k in range(first, first + 3)]
            stored.data.foreach_set("vector", flat)
        return _Table(geometry, attributes, width)

    def sqrt(self, x: _Number) -> _Number:
        """Return the square root."""
        return self.math("SQRT", x)

    def exp(self, x: _Number) -> _Number:
        """Return the exponential."""
        return self.math("EXPONENT", x)

    def clip(self, x: _Number, low: float, high: float) -> _Number:
        """Return x limited to [low, high]."""
        return self.math("MINIMUM", self.math("MAXIMUM", x, low), high)

    def angle_coefficients(self, squared: _Number) -> Triple[_Number]:
        """Return a, b and c of Rodrigues' formula, to single precision up to 2 rad."""
        return triple(self.polynomials(long_angle_series(), squared))

    def columns(self, table: _Table) -> list[tuple[_Number]]:
        """Return the columns of a table as fields."""
        return [(x,) for name in table.attributes for x in self.separated(self._field(name))][: table.width]

    def polynomials(self, coefficients: Sequence[Sequence[float]], x: _Number) -> list[_Number]:
        """Return several polynomials of x."""
        return [polynomial(each, x) for each in coefficients]

    def weighted_sum(self, factors: Sequence[_Number], weights: _Table) -> Triple[_Number]:
        """Return the sum of the rows of a table with three columns, each times its factor."""
        scale = self.node("ShaderNodeVectorMath", operation="SCALE")
        self._group.links.new(self._field(weights.attributes[0]), scale.inputs[0])
        self._group.links.new(factors[0].socket, scale.inputs["Scale"])
        return triple(self.separated(self._total(weights.geometry, scale.outputs[0])))

    def lookup(self, x: _Number, knots: _Table, tables: Sequence[_Table]) -> list[list[_Number]]:
        """Return row i of each table, where i is the number of knots at or below x."""
        reached = 1.0 - self.math("GREATER_THAN", self.columns(knots)[0][0], x)
        field = self.node("ShaderNodeCombineXYZ", reached).outputs[0]
        interval = self.separated(self._total(knots.geometry, field))[0]
        return [self._row(table, interval) for table in tables]

    def split(self, row: Sequence[_Number], width: int) -> Sequence[_Number]:
        """Return a row: it is separate numbers."""
        return row

    def _row(self, table: _Table, index: _Number) -> list[_Number]:
        numbers = []
        for name in table.attributes:
            node = self.node("GeometryNodeSampleIndex", data_type="FLOAT_VECTOR", domain="POINT", clamp=True)
            self._group.links.new(table.geometry, node.inputs["Geometry"])
            self._group.links.new(self._field(name), next(s for s in node.inputs if s.name == "Value" and s.enabled))
            self._group.links.new(index.socket, node.inputs["Index"])
            numbers += self.separated(next(socket for socket in node.outputs if socket.enabled))
        return numbers[: table.width]

    def _field(self, name: str) -> bpy.types.NodeSocket:
        node = self.node("GeometryNodeInputNamedAttribute", data_type="FLOAT_VECTOR")
        node.inputs["Name"].default_value = name
        return node.outputs["Attribute"]

    def _total(self, geometry: bpy.types.NodeSocket, field: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Return the sum of a vector field over the points of a geometry."""
        node = self.node("GeometryNodeAttributeStatistic", data_type="FLOAT_VECTOR", domain="POINT")
        self._group.links.new(geometry, node.inputs["Geometry"])
        self._group.links.new(field, next(s for s in node.inputs if s.name == "Attribute" and s.enabled))
        return next(socket for socket in node.outputs if socket.name == "Sum" and socket.enabled)


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if len(given) != 2:
        sys.exit("usage: blender -b -P blender_nodes.py -- RIG.usd JAW.blend")
    make_file(*given)
