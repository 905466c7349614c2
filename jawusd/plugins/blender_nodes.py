"""Turn a jaw rig into a Blender file that needs no add-on: sliders of a Geometry Nodes modifier move the mandible.

    blender -b -P blender_nodes.py -- actor/anim_capture.usdc jaw.blend

Needs `jawusd_reader.py` beside it. The file holds no scripts and works where scripts are switched off. The nodes are
generated from the exact model, evaluated in Blender's single precision; the sliders lie on the mandible's mesh, in the
modifier "Jaw", and the other meshes of the mandible follow them. The nodes move vertices, the objects stay at rest.
Slider limits are those of the whole range: what is valid at an opening only the add-on can show.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
import jawusd_reader

MODIFIER = "Jaw"
SLIDERS = ("d1", "d2", "d3")
_LABELS = ("Opening", "Laterotrusion", "Protrusion")
_TABLES = "JawTables"


def make_file(usd: str, blend: str) -> None:
    """Write a Blender file with the rig of a USD file, its captured motion as keys of the sliders.

    Args:
        usd: any file that holds one rig and its meshes, `actor.usda`, an animation of it or `actor.usdz`.
        blend: the file to write.

    Raises:
        jawusd_reader.ReaderError: there is not one rig with a mandible.
    """
    bpy.ops.wm.read_homefile(use_empty=True)
    _find_pxr()
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


def add_sliders(rig: jawusd_reader.Rig, meshes: Sequence[bpy.types.Object], prim: Any) -> None:
    """Give the meshes of a mandible the modifier; the first one carries the sliders, with the keys of the prim."""
    group, inputs = _node_group(rig)
    for mesh in meshes:
        modifier = mesh.modifiers.new(MODIFIER, "NODES")
        modifier.node_group = group
    first = meshes[0]
    for name, identifier in zip(SLIDERS, inputs):
        path = f'modifiers["{MODIFIER}"]["{identifier}"]'
        attribute = prim.GetAttribute(f"jaw:{name}")
        first.modifiers[MODIFIER][identifier] = float(attribute.Get() or 0.0)
        for time in attribute.GetTimeSamples():
            first.modifiers[MODIFIER][identifier] = attribute.Get(time)
            first.keyframe_insert(path, frame=time)
        for mesh in meshes[1:]:
            driver = mesh.driver_add(path).driver
            driver.type = "SUM"  # of one value: no Python
            variable = driver.variables.new()
            variable.targets[0].id = first
            variable.targets[0].data_path = path
    action = first.animation_data.action if first.animation_data else None
    for layer in action.layers if action else ():
        for strip in layer.strips:
            for curve in [curve for bag in strip.channelbags for curve in bag.fcurves]:
                for point in curve.keyframe_points:
                    point.interpolation = "LINEAR"


def _find_pxr() -> None:
    """Make Blender's own pxr importable where it is not: in Blender as a Python module."""
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    for kind in ("LOCAL", "SYSTEM"):
        folder = os.path.join(bpy.utils.resource_path(kind), "python", "lib", version, "site-packages")
        if os.path.isdir(os.path.join(folder, "pxr")) and folder not in sys.path:
            sys.path.append(folder)


def _mandible_meshes(prim: Any) -> list[bpy.types.Object]:
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
    for name, label, (low, high) in zip(SLIDERS, _LABELS, rig.d_range):
        socket = group.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
        socket.min_value, socket.max_value = low, high
        socket.description = f"{label} [mm]"
        identifiers.append(socket.identifier)
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    nodes = _Nodes(group)
    given = group.nodes.new("NodeGroupInput")
    d = [given.outputs[name] for name in SLIDERS]
    omega, translate = (_anchored if rig.kind == "anchored" else _additive)(nodes, rig.arrays, d)
    moved = nodes.affine(rig.matrices[1], nodes.position())
    moved = nodes.vector("ADD", nodes.rotate(omega, moved), translate)
    setter = group.nodes.new("GeometryNodeSetPosition")
    group.links.new(given.outputs["Geometry"], setter.inputs["Geometry"])
    group.links.new(nodes.affine(rig.matrices[0], moved), setter.inputs["Position"])
    result = group.nodes.new("NodeGroupOutput")
    group.links.new(setter.outputs["Geometry"], result.inputs["Geometry"])
    for index, node in enumerate(group.nodes):
        node.location = (200 * (index % 24), -200 * (index // 24))
        node.hide = True
    return group, identifiers


class _Nodes:
    """Write arithmetic as nodes: values are sockets or numbers, vectors are sockets or triples."""

    def __init__(self, group: bpy.types.NodeTree) -> None:
        self._group = group

    def _node(self, kind: str, *values: Any, **settings: Any) -> bpy.types.Node:
        node = self._group.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for socket, value in zip([socket for socket in node.inputs if socket.enabled], values):
            if isinstance(value, bpy.types.NodeSocket):
                self._group.links.new(value, socket)
            else:
                socket.default_value = value
        return node

    def math(self, operation: str, *values: Any) -> Any:
        return self._node("ShaderNodeMath", *values, operation=operation).outputs[0]

    def vector(self, operation: str, *values: Any) -> Any:
        node = self._node("ShaderNodeVectorMath", *values, operation=operation)
        return next(socket for socket in node.outputs if socket.enabled)

    def sum(self, *values: Any) -> Any:
        total = values[0]
        for value in values[1:]:
            total = self.math("ADD", total, value)
        return total

    def combine(self, *values: Any) -> Any:
        return self._node("ShaderNodeCombineXYZ", *values).outputs[0]

    def separate(self, vector: Any) -> Any:
        return self._node("ShaderNodeSeparateXYZ", vector).outputs

    def scaled(self, vector: Any, factor: Any) -> Any:
        return self.vector("SCALE", vector, factor)

    def polynomial(self, coefficients: Sequence[float], x: Any) -> Any:
        """Return c0 + x (c1 + x (c2 + ...))."""
        value = coefficients[-1]
        for c in reversed(coefficients[:-1]):
            value = self.math("MULTIPLY_ADD", value, x, c)
        return value

    def position(self) -> Any:
        return self._node("GeometryNodeInputPosition").outputs[0]

    def affine(self, rows: Sequence[Sequence[float]], vector: Any) -> Any:
        turned = self.combine(*(self.vector("DOT_PRODUCT", vector, tuple(row[:3])) for row in rows[:3]))
        return self.vector("ADD", turned, tuple(row[3] for row in rows[:3]))

    def rotate(self, omega: Any, vector: Any) -> Any:
        angle = self.vector("LENGTH", omega)
        rotation = self._node("FunctionNodeAxisAngleToRotation", omega, angle).outputs[0]
        return self._node("FunctionNodeRotateVector", vector, rotation).outputs[0]

    def table(self, name: str, columns: dict[str, list], points: list) -> Any:
        """Return the geometry of a hidden mesh that carries a table: points, and named columns."""
        mesh = bpy.data.meshes.new(f"{_TABLES}{name}")
        mesh.from_pydata(points, [], [])
        for key, values in columns.items():
            vector = isinstance(values[0], Sequence)
            stored = mesh.attributes.new(key, "FLOAT_VECTOR" if vector else "FLOAT", "POINT")
            flat = [x for value in values for x in value] if vector else values
            stored.data.foreach_set("vector" if vector else "value", flat)
        carrier = bpy.data.objects.new(mesh.name, mesh)  # in no collection: nobody sees it
        carrier.use_fake_user = True
        node = self._node("GeometryNodeObjectInfo", transform_space="ORIGINAL")
        node.inputs["Object"].default_value = carrier
        return node.outputs["Geometry"]

    def column(self, key: str, data_type: str) -> Any:
        node = self._node("GeometryNodeInputNamedAttribute", data_type=data_type)
        node.inputs["Name"].default_value = key
        return node.outputs["Attribute"]

    def total(self, geometry: Any, field: Any) -> Any:
        """Return the sum of a vector field over the points of a geometry."""
        node = self._node("GeometryNodeAttributeStatistic", data_type="FLOAT_VECTOR", domain="POINT")
        self._group.links.new(geometry, node.inputs["Geometry"])
        self._group.links.new(field, next(s for s in node.inputs if s.name == "Attribute" and s.enabled))
        return next(socket for socket in node.outputs if socket.name == "Sum" and socket.enabled)

    def sample(self, geometry: Any, field: Any, index: Any, data_type: str) -> Any:
        """Return a field at the point of an index."""
        node = self._node("GeometryNodeSampleIndex", data_type=data_type, domain="POINT", clamp=True)
        self._group.links.new(geometry, node.inputs["Geometry"])
        self._group.links.new(field, next(s for s in node.inputs if s.name == "Value" and s.enabled))
        self._group.links.new(index, node.inputs["Index"])
        return next(socket for socket in node.outputs if socket.enabled)


def _rows(flat: Sequence[float], width: int) -> list[list[float]]:
    return [list(flat[i : i + width]) for i in range(0, len(flat), width)]


def _anchored(n: _Nodes, arrays: dict[str, list[float]], d: Sequence[Any]) -> tuple[Any, Any]:
    """Return rotation vector and translation of the anchored model: omega = f(u), t = u + p - R p."""
    u = _displacement(n, arrays, d)
    opening = n.math("MULTIPLY", u[1], -1.0)
    gx, gz = _path(n, arrays, opening)
    away = n.combine(opening, n.math("SUBTRACT", u[0], gx), n.math("SUBTRACT", u[2], gz))
    q = n.vector("DIVIDE", away, tuple(arrays["spline_scales"]))
    centres, weights = _rows(arrays["spline_centres"], 3), _rows(arrays["spline_weights"], 3)
    table = n.table("Spline", {"weight": weights[: len(centres)]}, centres)
    radius = n.vector("LENGTH", n.vector("SUBTRACT", n.position(), q))
    cube = n.math("POWER", radius, 3.0)
    omega = n.total(table, n.scaled(n.column("weight", "FLOAT_VECTOR"), cube))
    for x, row in zip(n.separate(q), weights[len(centres) :]):
        omega = n.vector("ADD", omega, n.scaled(tuple(row), x))
    # f(0) is taken off, so that the closed bite is exact; summed here in double precision
    cubes = [sum(x * x for x in centre) ** 1.5 for centre in centres]
    omega = n.vector("SUBTRACT", omega, tuple(sum(c * w[i] for c, w in zip(cubes, weights)) for i in range(3)))
    p = tuple(arrays["incisor"])
    translate = n.vector("SUBTRACT", n.vector("ADD", n.combine(*u), p), n.rotate(omega, p))
    return omega, translate


def _path(n: _Nodes, arrays: dict[str, list[float]], opening: Any) -> list[Any]:
    low, high = arrays["path_limits"]
    scale = arrays["path_scale_mm"][0]
    inside = n.math("MINIMUM", n.math("MAXIMUM", opening, low), high)
    s, beyond = n.math("DIVIDE", inside, scale), n.math("SUBTRACT", opening, inside)
    out = []
    for c in _rows(arrays["path_coefficients"], 5):
        slope = n.polynomial([(k + 1) * c[k] / scale for k in range(5)], s)
        out.append(n.math("MULTIPLY_ADD", slope, beyond, n.polynomial([0.0, *c], s)))
    return out


def _displacement(n: _Nodes, arrays: dict[str, list[float]], d: Sequence[Any]) -> list[Any]:
    d1, d2, d3 = d
    e = arrays["glide_softness_mm"][0]
    low, high = arrays["path_limits"]
    gx, gz = _path(n, arrays, d1)
    soft = jawusd_reader.LIMIT_SOFTNESS_MM
    s = n.math("ADD", _soft_ramp(n, n.math("SUBTRACT", d1, low), soft), low)
    s = n.math("SUBTRACT", s, _soft_ramp(n, n.math("SUBTRACT", d1, high), soft))
    s = n.math("DIVIDE", s, arrays["path_scale_mm"][0])
    side, front = n.math("SUBTRACT", _root(n, d2, e), e), _soft_ramp(n, d3, e)
    c, w = arrays["glide_arch"], arrays["glide_drop"]
    bow = n.math("DIVIDE", n.math("MULTIPLY", d2, d2), jawusd_reader.ARCH_BOW_MM)
    rho = n.sum(
        n.math("MULTIPLY", side, n.polynomial(c[:3], s)),
        n.math("MULTIPLY", d2, n.polynomial(c[3:5], s)),
        n.math("MULTIPLY", bow, n.polynomial(c[5:], s)),
    )
    parts = zip((side, front, _bent(n, side), _bent(n, front)), w)
    drop = n.sum(*(n.math("MULTIPLY", part, weight) for part, weight in parts))
    share = n.math("DIVIDE", _soft_ramp(n, d1, jawusd_reader.FADE_SOFTNESS_MM), arrays["glide_fade_mm"][0])
    fade = n.math("EXPONENT", n.math("MULTIPLY", n.math("MULTIPLY", share, share), -1.0))
    down = n.math("MULTIPLY_ADD", drop, fade, d1)
    return [n.math("ADD", gx, d2), n.math("MULTIPLY", down, -1.0), n.sum(gz, rho, d3)]


def _root(n: _Nodes, x: Any, e: float) -> Any:
    return n.math("SQRT", n.math("MULTIPLY_ADD", x, x, e * e))


def _soft_ramp(n: _Nodes, x: Any, e: float) -> Any:
    return n.math("MULTIPLY", n.math("SUBTRACT", n.math("ADD", x, _root(n, x, e)), e), 0.5)


def _bent(n: _Nodes, x: Any) -> Any:
    square = n.math("MULTIPLY", x, x)
    grown = n.math("SQRT", n.math("MULTIPLY_ADD", square, 1.0 / jawusd_reader.DROP_SATURATION_MM2, 1.0))
    return n.math("DIVIDE", n.math("MULTIPLY", square, jawusd_reader.DROP_BEND), grown)


def _additive(n: _Nodes, arrays: dict[str, list[float]], d: Sequence[Any]) -> tuple[Any, Any]:
    """Return rotation vector and translation of the additive model: exp of the sum of three curves."""
    curves = [_curve(n, arrays, i, x) for i, x in enumerate(d, start=1)]
    omega, v = (n.vector("ADD", n.vector("ADD", a, b), c) for a, b, c in zip(*curves))
    # the left Jacobian of SO(3): v + b omega x v + c omega x (omega x v); its coefficients as series, exact to 1e-8
    # up to 1 rad
    square = n.vector("DOT_PRODUCT", omega, omega)
    first = n.polynomial([1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800], square)
    second = n.polynomial([1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800], square)
    once = n.vector("CROSS_PRODUCT", omega, v)
    twice = n.vector("CROSS_PRODUCT", omega, once)
    return omega, n.vector("ADD", n.vector("ADD", v, n.scaled(once, first)), n.scaled(twice, second))


def _curve(n: _Nodes, arrays: dict[str, list[float]], i: int, x: Any) -> tuple[Any, Any]:
    """Return the two halves of a cubic Hermite curve at x that goes on straight outside its knots."""
    knots = arrays[f"curve{i}_knots"]
    twists, slopes = (_rows(arrays[f"curve{i}_{part}"], 6) for part in ("twists", "slopes"))
    halves = {"y0": (twists, 0), "m0": (slopes, 0), "y1": (twists, 3), "m1": (slopes, 3)}
    columns = {key: [row[at : at + 3] for row in rows] for key, (rows, at) in halves.items()}
    table = n.table(f"Curve{i}", columns, [(knot, 0.0, 0.0) for knot in knots])
    inside = n.math("MINIMUM", n.math("MAXIMUM", x, knots[0]), knots[-1])
    beyond = n.math("SUBTRACT", x, inside)
    # the number of knots at or below x, less one
    reached = n.combine(n.math("SUBTRACT", 1.0, n.math("GREATER_THAN", n.separate(n.position())[0], inside)), 0.0, 0.0)
    count = n.separate(n.total(table, reached))[0]
    low = n.math("MINIMUM", n.math("SUBTRACT", count, 1.0), len(knots) - 2.0)
    high = n.math("ADD", low, 1.0)
    start, end = (n.separate(n.sample(table, n.position(), k, "FLOAT_VECTOR"))[0] for k in (low, high))
    h = n.math("SUBTRACT", end, start)
    t = n.math("DIVIDE", n.math("SUBTRACT", inside, start), h)
    basis = (
        n.polynomial([1.0, 0.0, -3.0, 2.0], t),
        n.polynomial([0.0, 0.0, 3.0, -2.0], t),
        n.math("MULTIPLY", n.polynomial([0.0, 1.0, -2.0, 1.0], t), h),
        n.math("MULTIPLY", n.polynomial([0.0, 0.0, -1.0, 1.0], t), h),
    )
    last = n.math("GREATER_THAN", x, knots[-1])
    out = []
    for half in ("0", "1"):
        value, slope = (n.column(f"{name}{half}", "FLOAT_VECTOR") for name in "ym")
        parts = [n.sample(table, field, k, "FLOAT_VECTOR") for field in (value, slope) for k in (low, high)]
        total = n.scaled(parts[0], basis[0])
        for part, weight in zip(parts[1:], basis[1:]):
            total = n.vector("ADD", total, n.scaled(part, weight))
        # straight on with the slope of the end that was passed
        ends = columns[f"m{half}"]
        step = tuple(b - a for a, b in zip(ends[0], ends[-1]))
        straight = n.vector("ADD", n.scaled(step, last), tuple(ends[0]))
        out.append(n.vector("ADD", total, n.scaled(straight, beyond)))
    return out[0], out[1]


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    if len(given) != 2:
        sys.exit("usage: blender -b -P blender_nodes.py -- RIG.usd JAW.blend")
    make_file(*given)
