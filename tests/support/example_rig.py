"""A small rig for tests: the example model, coarse meshes around its landmarks, and a motion inside its bounds."""

import numpy as np
from example_model import example_arrays, example_meta, touching_arrays

from jawusd.evaluator import JawRig
from jawusd.formats.mesh import Mesh, tooth_labels
from jawusd.rig.validate import validate_stage

FPS = 24.0


def example_rig(kind="anchored"):
    """Return the evaluator of the example model."""
    return JawRig(example_arrays(kind), example_meta(kind))


def touching_rig(kind="anchored"):
    """Return that of a person whose scans meet."""
    return JawRig({**example_arrays(kind), **touching_arrays(kind)}, example_meta(kind))


def example_meshes():
    """Return four coarse closed meshes; the teeth are painted red and green at the crowns and grey at the gum."""
    landmarks = example_arrays()["landmarks"]
    incisor, molar_left, molar_right, condyle_left, condyle_right = landmarks
    middle = landmarks.mean(axis=0)
    mandible = _joined([_ball(p, (7, 9, 6)) for p in (condyle_left, condyle_right, middle, incisor)])
    lower = _painted(_joined([_ball(p, (4, 6, 4)) for p in (incisor, molar_left, molar_right)]))
    upper = _painted(_joined([_ball(p + [0, 8, 1], (4, 6, 4)) for p in (incisor, molar_left, molar_right)]))
    skull = _joined([_ball(middle + [0, 60, 0], (70, 50, 80))])
    return {"skull": skull, "upper_teeth": upper, "mandible": mandible, "lower_teeth": lower}


def scanned_meshes():
    """Return the same, the upper scan in natural colours and with texture coordinates instead of paint."""
    meshes = example_meshes()
    upper, rng = meshes["upper_teeth"], np.random.default_rng(3)
    natural = np.where((tooth_labels(upper) > 0)[:, None], (226, 214, 190), (196, 112, 108))
    colors = (natural + rng.integers(-12, 13, natural.shape)).astype(np.uint8)
    uv = rng.random((len(upper.faces), 3, 2)).astype(np.float32)
    return {**meshes, "upper_teeth": Mesh(upper.vertices, upper.faces, colors, tooth_labels(upper), uv)}


def example_proxies():
    """Return stand-ins of fewer faces for the teeth and the skull: balls of their sizes."""
    meshes = example_meshes()
    out = {}
    for name in ("skull", "upper_teeth", "lower_teeth"):
        vertices, faces = _ball(meshes[name].vertices.mean(axis=0), np.ptp(meshes[name].vertices, axis=0) / 2)
        out[name] = Mesh(vertices, faces, labels=(vertices[:, 1] > vertices[:, 1].mean()).astype(np.uint8))
    return out


def mandible_vertices():
    """Return all vertices that move with the jaw, shape (V, 3)."""
    meshes = example_meshes()
    return np.concatenate([meshes[name].vertices for name in ("mandible", "lower_teeth")])


def example_motion(count=40, first=30):
    """Return frame numbers and parameters: opening while chewing to both sides, everywhere inside the bounds."""
    s = np.linspace(0, 1, count)
    d = np.stack([12 * np.sin(np.pi * s) ** 2, 2.5 * np.sin(4 * np.pi * s), 0.8 + 0.8 * np.sin(3 * np.pi * s)], axis=1)
    return np.arange(first, first + count), d


def assert_valid_usd(path):
    """Check a file with every UsdValidation validator, jawusd's own among them."""
    assert validate_stage(path) == []


def moved(T, points):
    """Return the images (n, V, 3) of points (V, 3) under transforms (n, 4, 4)."""
    return np.einsum("nij,vj->nvi", T[:, :3, :3], points) + T[:, None, :3, 3]


def _ball(centre, radii, rings=8, segments=12):
    polar, turn = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(segments) / segments
    grid = np.stack(
        np.broadcast_arrays(
            np.sin(polar)[:, None] * np.cos(turn), np.cos(polar)[:, None], -np.sin(polar)[:, None] * np.sin(turn)
        ),
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([grid, [[0, 1, 0], [0, -1, 0]]]) * radii + centre
    top, bottom = len(grid), len(grid) + 1
    faces = []
    for j in range(segments):
        k = (j + 1) % segments
        faces += [[top, j, k], [bottom, (rings - 2) * segments + k, (rings - 2) * segments + j]]
        for i in range(rings - 2):
            a, b, c, d = i * segments + j, i * segments + k, (i + 1) * segments + j, (i + 1) * segments + k
            faces += [[a, c, d], [a, d, b]]
    return vertices, np.array(faces)


def _joined(parts):
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    return Mesh(vertices, np.concatenate([faces + offset for (_, faces), offset in zip(parts, offsets)]))


def _painted(mesh):
    """Paint the upper half of each 86-vertex ball: red, and green in front; the rest stays grey."""
    height = mesh.vertices[:, 1].reshape(-1, 86) - mesh.vertices[:, 1].reshape(-1, 86).mean(axis=1, keepdims=True)
    colors = np.full((len(mesh.vertices), 3), 128, dtype=np.uint8)
    colors[height.reshape(-1) > -1.0] = (200, 40, 40)
    colors[height.reshape(-1) > 3.0] = (40, 200, 40)
    return Mesh(mesh.vertices, mesh.faces, colors)


def choose_variants(source, out, **chosen):
    """Write a layer over one of a rig that chooses variants of the actor, `motion="skeleton"`; return its path."""
    from pxr import Sdf, Usd

    below = Usd.Stage.Open(str(source))
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.defaultPrim = "Actor"
    layer.pseudoRoot.SetInfo("upAxis", "Y")
    layer.pseudoRoot.SetInfo("metersPerUnit", 0.001)
    layer.timeCodesPerSecond = below.GetTimeCodesPerSecond()
    layer.startTimeCode, layer.endTimeCode = below.GetStartTimeCode(), below.GetEndTimeCode()
    for name, variant in chosen.items():
        Sdf.CreatePrimInLayer(layer, "/Actor").variantSelections[name] = variant
    layer.subLayerPaths = [f"./{source.name}"]
    layer.Export(str(out))
    return out


def forget_checksums(folder):
    """Make a rig one whose layers may be changed, as rigs were before they had checksums."""
    from pxr import Sdf

    layer = Sdf.Layer.OpenAsAnonymous(str(folder / "actor.usda"))
    layer.customLayerData = {"creator": "an older jawusd"}
    layer.Export(str(folder / "actor.usda"))
