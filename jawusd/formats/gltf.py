"""Write binary glTF 2.0 (.glb) for the web: meshes under named nodes, and their animation.

Lengths are in metres in the file and in mm here; y is up. Nodes are animated by translations and quaternions, which
viewers interpolate linearly and by slerp. Reference: Khronos Group, "glTF 2.0 Specification", 2021.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath
from jawusd.formats.atomic import write_bytes_atomic
from jawusd.geometry.so3 import continuous_wxyz

_MM = 1e-3  # one millimetre in metres
_FLOAT, _UINT16, _UINT32 = 5126, 5123, 5125
_Values = NDArray[np.float32] | NDArray[np.uint16] | NDArray[np.uint32]
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963  # glTF's codes for the targets of buffer views


@dataclass(frozen=True)
class Material:
    """Material whose colour is multiplied by vertex colours, if there are any."""

    color: tuple[float, float, float]  # linear red, green and blue, 0 to 1
    roughness: float


@dataclass(frozen=True, eq=False)
class Surface:
    """Mesh whose faces are grouped by material."""

    name: str
    vertices: Array  # vertex positions [mm], shape (V, 3)
    normals: Array  # unit normals of the vertices, shape (V, 3)
    parts: Mapping[str, NDArray[np.int32]]  # faces (F, 3) by name of their material
    colors: Array | None = None  # linear RGB of the vertices, multiplied by the material's colour, shape (V, 3)
    uv: Array | None = None  # texture coordinates of the vertices, u to the right, v upwards, shape (V, 2)


@dataclass(frozen=True, eq=False)
class Node:
    """Node: surfaces that move together."""

    name: str
    pose: Array  # pose at rest [mm], shape (4, 4)
    surfaces: Sequence[Surface]
    times_s: Array = field(default_factory=lambda: np.empty(0))  # increasing key times, >= 0, shape (n,)
    poses: Array = field(default_factory=lambda: np.empty((0, 4, 4)))  # poses at the key times [mm], shape (n, 4, 4)


def save_glb(
    path: AnyPath,
    name: str,
    materials: Mapping[str, Material],
    nodes: Sequence[Node],
    generator: str,
    extras: Mapping[str, object],
) -> None:
    """Write nodes under a named root, atomically; times that are equal in single precision are dropped.

    `name` is also that of the animation, `extras` its metadata. Surfaces refer to materials by name.

    Raises:
        OutputError: the file cannot be written.
    """
    builder = _Builder()
    order = list(materials)
    meshes: list[dict[str, object]] = []
    top: list[int] = []
    listed: list[dict[str, object]] = [{"name": name, "children": top}]
    channels: list[dict[str, object]] = []
    samplers: list[dict[str, int]] = []
    for node in nodes:
        at, below = len(listed), range(len(listed) + 1, len(listed) + 1 + len(node.surfaces))
        top.append(at)
        listed.append({"name": node.name, "children": list(below), **_placed(node.pose)})
        for surface in node.surfaces:
            listed.append({"name": surface.name, "mesh": len(meshes)})
            meshes.append({"name": surface.name, "primitives": builder.primitives(surface, order)})
        for target, times, values in _motion(node):
            channels.append({"sampler": len(samplers), "target": {"node": at, "path": target}})
            samplers.append({"input": builder.add(times, limits=True), "output": builder.add(values)})
    document: dict[str, object] = {
        "asset": {"version": "2.0", "generator": generator},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": listed,
        "meshes": meshes,
        "materials": [_look(key, materials[key]) for key in order],
        "accessors": builder.accessors,
        "bufferViews": builder.views,
        "buffers": [{"byteLength": len(builder.data)}],
    }
    if channels:
        document["animations"] = [{"name": name, "channels": channels, "samplers": samplers, "extras": dict(extras)}]
    write_bytes_atomic(path, _container(document, bytes(builder.data)))


def frame_rate(path: AnyPath) -> float | None:
    """Return the frame rate in the animation metadata of a .glb from `save_glb`; None for other files."""
    try:
        with open(path, "rb") as file:
            magic, length = struct.unpack("<4s8xI4x", file.read(20))
            document = json.loads(file.read(length)) if magic == b"glTF" else {}
        fps = float(document["animations"][0]["extras"]["fps"])
    except (OSError, ValueError, TypeError, LookupError, RecursionError, struct.error):
        return None
    return fps if 0 < fps < math.inf else None


class _Builder:
    """Builder of the binary buffer, buffer views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, object]] = []

    def add(self, values: _Values, *, target: int | None = None, limits: bool = False) -> int:
        """Append an array, shape (n,) or (n, k); return the index of its accessor."""
        kind = {np.dtype("<f4"): _FLOAT, np.dtype("<u2"): _UINT16, np.dtype("<u4"): _UINT32}[values.dtype]
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        self.data += np.ascontiguousarray(values).tobytes()
        self.data += bytes(-len(self.data) % 4)
        rows = values.reshape(len(values), -1)
        accessor: dict[str, object] = {
            "bufferView": len(self.views) - 1,
            "componentType": kind,
            "count": len(rows),
            "type": _TYPES[rows.shape[1]],
        }
        if limits:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        if kind == _UINT16:
            accessor["normalized"] = True
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def primitives(self, surface: Surface, materials: Sequence[str]) -> list[dict[str, object]]:
        """Append a surface; return its primitives, one per material, with shared vertices."""
        attributes = {
            "POSITION": self.add(np.asarray(surface.vertices * _MM, "<f4"), target=_VERTICES, limits=True),
            "NORMAL": self.add(np.asarray(surface.normals, "<f4"), target=_VERTICES),
        }
        if surface.uv is not None:  # glTF's v coordinate points down
            attributes["TEXCOORD_0"] = self.add(np.asarray(surface.uv * [1, -1] + [0, 1], "<f4"), target=_VERTICES)
        if surface.colors is not None:
            opaque = np.column_stack([np.clip(surface.colors, 0, 1), np.ones(len(surface.colors))])
            attributes["COLOR_0"] = self.add(np.round(65535 * opaque).astype("<u2"), target=_VERTICES)
        return [
            {
                "attributes": attributes,
                "indices": self.add(np.asarray(faces, "<u4").ravel(), target=_INDICES),
                "material": materials.index(material),
            }
            for material, faces in surface.parts.items()
            if len(faces)
        ]


def _motion(node: Node) -> list[tuple[str, NDArray[np.float32], NDArray[np.float32]]]:
    """Return the target, times [s] and values of each animation channel of a node."""
    if not len(node.times_s):
        return []
    times, first = np.unique(np.asarray(node.times_s, "<f4"), return_index=True)
    poses = node.poses[first]
    wxyz = continuous_wxyz(poses[:, :3, :3])
    moved = np.asarray(poses[:, :3, 3] * _MM, "<f4")
    return [("translation", times, moved), ("rotation", times, np.asarray(np.roll(wxyz, -1, axis=1), "<f4"))]


def _placed(pose: Array) -> dict[str, list[float]]:
    wxyz = continuous_wxyz(pose[None, :3, :3])[0]
    return {"translation": (pose[:3, 3] * _MM).tolist(), "rotation": np.roll(wxyz, -1).tolist()}


def _look(name: str, material: Material) -> dict[str, object]:
    surface = {"baseColorFactor": [*material.color, 1.0], "metallicFactor": 0.0, "roughnessFactor": material.roughness}
    # Both sides are drawn, since scans are open surfaces.
    return {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}


def _container(document: Mapping[str, object], data: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
