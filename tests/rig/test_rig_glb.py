"""Binary glTF against the specification by a reader of our own, and by trimesh."""

import json
import struct

import numpy as np
import pytest
import trimesh
from example_rig import FPS, example_meshes, example_motion, example_rig, mandible_vertices, moved, scanned_meshes
from scipy.spatial.transform import Rotation, Slerp

from jawusd.base.errors import RigError
from jawusd.formats.mesh import crown_face_mask
from jawusd.geometry import make_transform
from jawusd.rig.animation import write_animation
from jawusd.rig.bake import decoder_layer, interface_layer
from jawusd.rig.geo import build_geometry, linear_from_srgb
from jawusd.rig.glb import write_glb
from jawusd.rig.layers import write_layer
from jawusd.rig.table import build_table

KINDS = {5123: "<u2", 5126: "<f4", 5125: "<u4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Parsed:
    """Read a .glb according to the specification."""

    def __init__(self, path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and size % 4 == 0
        self.document = json.loads(data[20 : 20 + size])
        rest, kind = struct.unpack_from("<I4s", data, 20 + size)
        self.buffer = data[28 + size :]
        assert kind == b"BIN\0" and rest == len(self.buffer) == self.document["buffers"][0]["byteLength"]

    def values(self, accessor):
        found = self.document["accessors"][accessor]
        view = self.document["bufferViews"][found["bufferView"]]
        kind, width = np.dtype(KINDS[found["componentType"]]), WIDTHS[found["type"]]
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] == found["count"] * width * kind.itemsize
        out = np.frombuffer(self.buffer, kind, found["count"] * width, view["byteOffset"]).reshape(-1, width)
        if "min" in found:
            assert found["min"] == out.min(axis=0).tolist() and found["max"] == out.max(axis=0).tolist()
        return out / 65535 if found.get("normalized") else out

    def node(self, name):
        return next(node for node in self.document["nodes"] if node["name"] == name)

    def motion(self):
        """Return times [s] and poses (n, 4, 4) [mm] of the mandible."""
        (animation,) = self.document["animations"]
        found = {}
        for channel in animation["channels"]:
            assert self.document["nodes"][channel["target"]["node"]]["name"] == "Mandible"
            sampler = animation["samplers"][channel["sampler"]]
            found[channel["target"]["path"]] = self.values(sampler["input"])[:, 0], self.values(sampler["output"])
        (times, moved_m), (again, xyzw) = found["translation"], found["rotation"]
        assert np.array_equal(times, again) and (np.diff(times) > 0).all()
        return times, make_transform(Rotation.from_quat(xyzw).as_matrix(), moved_m * 1000.0)

    def primitives(self, name):
        mesh = self.document["meshes"][self.node(name)["mesh"]]
        return {self.document["materials"][part["material"]]["name"]: part for part in mesh["primitives"]}


def actor(folder, meshes):
    """Write the layers that display an actor; return its file."""
    rig = example_rig()
    write_layer(build_geometry(meshes, rig.T_rest), folder / "geo.usdc")
    write_layer(decoder_layer(rig, build_table(rig, mandible_vertices(), 17)), folder / "rig.usdc")
    return write_layer(interface_layer(rig, "someone", meshes, FPS), folder / "actor.usda")


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    """Return an actor of scans, and its take as .glb."""
    folder = tmp_path_factory.mktemp("actor")
    path = actor(folder, scanned_meshes())
    frames, d = example_motion()
    return path, Parsed(write_glb(folder / "take.glb", path, example_rig(), frames, d, FPS))


def test_the_mandible_moves_as_the_model_does(take):
    frames, d = example_motion()
    times, poses = take[1].motion()
    rows = [int(np.argmin(np.abs(times - frame / FPS))) for frame in frames]
    assert np.abs(times[rows] - frames / FPS).max() < 1e-6 and times[0] == pytest.approx(frames[0] / FPS)
    points = mandible_vertices()
    exact = moved(example_rig().pose(d), points)
    assert np.linalg.norm(moved(poses[rows], points) - exact, axis=2).max() < 1e-4
    # between keys, as readers interpolate: linear, and slerp
    at = np.linspace(times[0], times[-1], 997)
    turned = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(np.clip(at, times[0], times[-1])).as_matrix()
    placed = np.stack([np.interp(at, times, column) for column in poses[:, :3, 3].T], axis=1)
    wanted = np.stack([np.interp(at * FPS, frames, column) for column in d.T], axis=1)
    landmarks = example_rig().arrays["landmarks"]
    exact = moved(example_rig().pose(wanted), landmarks)
    assert np.linalg.norm(moved(make_transform(turned, placed), landmarks) - exact, axis=2).max() < 0.02


def test_trimesh_shows_the_meshes_at_rest(take, tmp_path):
    """Painted scans: crowns and gum separately, in metres, the mandible in the closed bite."""
    meshes, rig = example_meshes(), example_rig()
    path = write_glb(tmp_path / "a.glb", actor(tmp_path, meshes), rig, [0, 1], [[0, 0, 0], [5, 0, 0]], FPS)
    scene = trimesh.load_scene(path)
    shown = {name: [] for name in ("SkullMesh", "UpperTeethMesh", "MandibleMesh", "LowerTeethMesh")}
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        title = next(key for key in shown if name.startswith(key))
        shown[title].append(scene.geometry[name].copy().apply_transform(T).triangles * 1000)
    for title, key in zip(shown, ("skull", "upper_teeth", "mandible", "lower_teeth")):
        mesh = meshes[key]
        T = rig.T_rest if key in ("mandible", "lower_teeth") else np.eye(4)
        expected = moved(T[None], mesh.vertices)[0][mesh.faces]
        found = np.concatenate(shown[title])
        order = [np.lexsort(np.round(x.reshape(-1, 9), 3).T) for x in (found, expected)]
        np.testing.assert_allclose(found[order[0]], expected[order[1]], atol=2e-5)
    parts = Parsed(path).primitives("LowerTeethMesh")
    crown = crown_face_mask(meshes["lower_teeth"])
    parsed = Parsed(path)
    assert len(parsed.values(parts["Enamel"]["indices"])) == 3 * crown.sum()
    assert len(parsed.values(parts["Gum"]["indices"])) == 3 * (~crown).sum()
    assert set(parsed.primitives("SkullMesh")) == {"Bone"}


def test_colours_and_texture_coordinates_lie_at_their_corners(take):
    parsed, upper = take[1], scanned_meshes()["upper_teeth"]
    (part,) = parsed.primitives("UpperTeethMesh").values()
    corners = parsed.values(part["indices"])[:, 0]
    read = {name: parsed.values(accessor)[corners] for name, accessor in part["attributes"].items()}
    vertex = upper.faces.ravel()
    np.testing.assert_allclose(1000 * read["POSITION"], upper.vertices[vertex], atol=1e-4)
    np.testing.assert_allclose(read["TEXCOORD_0"], upper.uv.reshape(-1, 2) * [1, -1] + [0, 1], atol=1e-6)
    np.testing.assert_allclose(read["COLOR_0"][:, :3], linear_from_srgb(upper.colors)[vertex], atol=1e-5)
    assert (read["COLOR_0"][:, 3] == 1).all()
    np.testing.assert_allclose(np.linalg.norm(read["NORMAL"], axis=1), 1, atol=1e-6)
    white = next(m for m in parsed.document["materials"] if m["name"] == "Scan")
    assert white["pbrMetallicRoughness"]["baseColorFactor"] == [1, 1, 1, 1]


@pytest.mark.parametrize("first", [0, 1, 1001, 86_400])
def test_frame_numbers_are_kept(take, tmp_path, first):
    path = write_glb(tmp_path / "a.glb", take[0], example_rig(), [first, first + 2], [[0, 0, 0], [5, 0, 0]], FPS)
    parsed = Parsed(path)
    times, _ = parsed.motion()
    np.testing.assert_allclose(times[[0, -1]] * FPS, [first, first + 2], atol=0.01)
    assert parsed.document["animations"][0]["extras"] == {
        "fps": FPS,
        "frames": [first, first + 2],
        "frame_at_zero": 0,
    }


@pytest.mark.parametrize("first", [-5, 2_073_600])
def test_numbers_that_gltf_cannot_keep_start_at_zero(take, tmp_path, first):
    """Before frame 0, and a time of day at 24 fps, which single precision resolves to a quarter of a frame."""
    path = write_glb(tmp_path / "a.glb", take[0], example_rig(), [first, first + 2], [[0, 0, 0], [5, 0, 0]], FPS)
    times, _ = Parsed(path).motion()
    np.testing.assert_allclose(times[[0, -1]], [0, 2 / FPS], atol=1e-6)
    assert Parsed(path).document["animations"][0]["extras"]["frame_at_zero"] == first


def test_lost_frames_are_bridged_and_empty_takes_refused(take, tmp_path):
    path, rig = take[0], example_rig()
    d = np.array([[0.0, 0, 0], [np.nan] * 3, [8, 0, 0], [np.nan] * 3])
    times, poses = Parsed(write_glb(tmp_path / "a.glb", path, rig, [10, 11, 12, 13], d, FPS)).motion()
    assert times[-1] == pytest.approx(13 / FPS)
    for second, expected in ((11 / FPS, [4.0, 0, 0]), (13 / FPS, [8.0, 0, 0])):
        shown = poses[int(np.argmin(np.abs(times - second)))]
        np.testing.assert_allclose(shown, rig.pose(np.array(expected)), atol=1e-4)
    with pytest.raises(RigError, match="nothing to animate"):
        write_glb(tmp_path / "b.glb", path, rig, [10], d[1:2], FPS)
    alone = write_animation(tmp_path / "geoless.usdc", path, [0], [[0, 0, 0]], FPS)
    (path.parent / "geo.usdc").rename(path.parent / "away.usdc")
    with pytest.raises(RigError, match="no meshes"):
        write_glb(tmp_path / "b.glb", alone, rig, [10], d[:1], FPS)
    (path.parent / "away.usdc").rename(path.parent / "geo.usdc")
    assert not (tmp_path / "b.glb").exists()
