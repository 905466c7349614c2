"""Mesh reading against trimesh's own exporters and hand-written files, and every guard."""

import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

from jawusd.base.errors import CaptureError, MissingDependencyError
from jawusd.formats.mesh import BOUNDARY, GUM, TOOTH, Mesh, crown_face_mask, tooth_labels
from jawusd.meshes import meshio


def arch(scale: float = 1.0) -> trimesh.Trimesh:
    """Make a closed mesh of a dental arch's size with shuffled vertices."""
    mesh = trimesh.creation.torus(22, 5, 30, 12)
    order = np.random.default_rng(0).permutation(len(mesh.vertices))
    new = np.argsort(order)
    return trimesh.Trimesh(mesh.vertices[order] * scale, new[mesh.faces], process=False)


def paint(mesh: trimesh.Trimesh) -> np.ndarray:
    colors = np.full((len(mesh.vertices), 3), (150, 150, 150), np.uint8)
    colors[mesh.vertices[:, 0] > 0] = (215, 45, 40)
    colors[mesh.vertices[:, 0] > 20] = (40, 190, 60)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    return colors


@pytest.mark.parametrize("name", ["a.ply", "a.PLY", "a.obj"])
def test_vertex_order_faces_and_colours_survive(tmp_path: Path, name: str) -> None:
    source = arch()
    colors = paint(source)
    path = tmp_path / name
    source.export(path, file_type=path.suffix[1:].lower())
    mesh = meshio.load_mesh(path)
    assert np.allclose(mesh.vertices, source.vertices, atol=1e-5) and mesh.vertices.dtype == np.float64
    assert np.array_equal(mesh.faces, source.faces) and mesh.faces.dtype == np.int32
    assert np.abs(mesh.colors.astype(int) - colors).max() <= 1
    labels = tooth_labels(mesh)
    x = source.vertices[:, 0]
    assert np.array_equal(labels, np.select([x > 20, x > 0], [BOUNDARY, TOOTH], GUM))


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize("coloured", [False, True])
def test_texture_coordinates_stay_at_their_corners(tmp_path: Path, inside_out: bool, coloured: bool) -> None:
    """Every third corner of an OBJ lies on a seam: the same point has another place in the texture."""
    source = arch()
    faces = source.faces[:, ::-1] if inside_out else source.faces
    rng = np.random.default_rng(1)
    places = rng.random((len(source.vertices) + faces.size, 2))
    at = np.where(np.arange(faces.size) % 3 == 0, len(source.vertices) + np.arange(faces.size), faces.ravel())
    colors = rng.integers(0, 256, (len(source.vertices), 3)) if coloured else None
    lines = []
    for row, vertex in enumerate(source.vertices):
        shown = "" if colors is None else " " + " ".join(f"{c / 255:.6f}" for c in colors[row])
        lines.append("v " + " ".join(f"{x:.9g}" for x in vertex) + shown)
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in places]
    for face, texture in zip(faces + 1, at.reshape(-1, 3) + 1, strict=True):
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in zip(face, texture, strict=True)))
    (tmp_path / "a.obj").write_text("\n".join(lines))
    mesh = meshio.load_mesh(tmp_path / "a.obj")
    assert np.allclose(mesh.vertices, source.vertices) and np.array_equal(mesh.faces, source.faces)
    expected = places[at].reshape(-1, 3, 2)
    np.testing.assert_allclose(mesh.uv, expected[:, ::-1] if inside_out else expected, atol=1e-8)
    if colors is None:
        assert mesh.colors is None
    else:
        np.testing.assert_array_equal(mesh.colors, colors)


def test_texture_coordinates_of_a_ply_stay_at_their_vertices(tmp_path: Path) -> None:
    source = arch()
    places = np.random.default_rng(1).random((len(source.vertices), 2))
    head = f"ply\nformat ascii 1.0\nelement vertex {len(places)}\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "texture_u", "texture_v"))
    head += f"element face {len(source.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = [" ".join(f"{x:.9g}" for x in row) for row in np.c_[source.vertices, places]]
    rows += [" ".join(map(str, [3, *face])) for face in source.faces]
    (tmp_path / "a.ply").write_text(head + "\n".join(rows) + "\n")
    mesh = meshio.load_mesh(tmp_path / "a.ply")
    np.testing.assert_allclose(mesh.vertices[mesh.faces], source.triangles, atol=1e-5)
    np.testing.assert_allclose(mesh.uv, places[source.faces], atol=1e-6)


def test_stl_keeps_the_triangles(tmp_path: Path) -> None:
    source = arch()
    source.export(tmp_path / "a.stl")
    mesh = meshio.load_mesh(tmp_path / "a.stl")
    assert mesh.colors is None and (tooth_labels(mesh) == TOOTH).all()
    assert np.allclose(mesh.vertices[mesh.faces], source.triangles, atol=1e-5)
    found = meshio.winding(mesh)
    assert found.closed and found.outward and found.volume_mm3 == pytest.approx(source.volume, rel=1e-5)


def test_textured_obj_with_quads_keeps_its_order(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(
        "mtllib missing.mtl\nv 0 0 0\nv 40 0 0\nv 40 30 0\nv 0 30 0\nv 5 5 5\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl x\nf 1/1 2/2 3/3 4/4\nf 1/2 3/1 5/4\n"
    )
    mesh = meshio.load_mesh(tmp_path / "a.obj")
    assert np.array_equal(mesh.vertices, [[0, 0, 0], [40, 0, 0], [40, 30, 0], [0, 30, 0], [5, 5, 5]])
    assert len(mesh.faces) == 3 and sorted(mesh.faces.ravel().tolist()) == [0, 0, 0, 1, 2, 2, 2, 3, 4]


def test_missing_damaged_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"gone\.ply: there is no such mesh"):
        meshio.load_mesh(tmp_path / "gone.ply")
    with pytest.raises(CaptureError, match=r"a\.glb: is not a supported mesh file; expected \.ply, \.stl, \.obj"):
        meshio.load_mesh(tmp_path / "a.glb")
    source = arch()
    source.export(tmp_path / "cut.ply")
    data = (tmp_path / "cut.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.stl").write_text("hello")
    for name in ("cut.ply", "text.stl"):
        with pytest.raises(CaptureError, match=rf"{name}: "):
            meshio.load_mesh(tmp_path / name)
    trimesh.PointCloud(source.vertices).export(tmp_path / "cloud.ply")
    with pytest.raises(CaptureError, match=r"cloud\.ply: .*no triangles"):
        meshio.load_mesh(tmp_path / "cloud.ply")


def write_ply(path: Path, vertices: list[str], faces: list[str]) -> Path:
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        + "\n".join(vertices + faces)
        + "\n"
    )
    return path


def test_numbers_that_cannot_be(tmp_path: Path) -> None:
    corners = ["0 0 0", "40 0 0", "40 30 0"]
    assert len(meshio.load_mesh(write_ply(tmp_path / "good.ply", corners, ["3 0 1 2"])).faces) == 1
    with pytest.raises(CaptureError, match=r"vertex 1 has a coordinate that is not finite"):
        meshio.load_mesh(write_ply(tmp_path / "nan.ply", ["0 0 0", "nan 0 0", "40 30 0"], ["3 0 1 2"]))
    with pytest.raises(CaptureError, match=r"index\.ply: "):
        meshio.load_mesh(write_ply(tmp_path / "index.ply", corners, ["3 0 1 7"]))


@pytest.mark.parametrize(
    ("scale", "unit"), [(1 / 1000, "metres"), (1 / 25.4, "inches"), (0.1, "centimetres"), (1000, "micrometres")]
)
def test_wrong_units_are_named(tmp_path: Path, scale: float, unit: str) -> None:
    arch(scale).export(tmp_path / "a.stl")
    wrong = rf"expected 20 to 150 mm for a scan\. Its lengths look like {unit}\..*must be in mm"
    with pytest.raises(CaptureError, match=wrong):
        meshio.load_mesh(tmp_path / "a.stl")


def test_bones_may_be_larger_than_scans(tmp_path: Path) -> None:
    arch(4).export(tmp_path / "a.stl")
    assert len(meshio.load_mesh(tmp_path / "a.stl", kind="bone").faces) == len(arch().faces)
    with pytest.raises(CaptureError, match="expected 20 to 150 mm for a scan"):
        meshio.load_mesh(tmp_path / "a.stl")
    arch(12).export(tmp_path / "b.stl")
    with pytest.raises(CaptureError, match="expected 50 to 500 mm for a bone"):
        meshio.load_mesh(tmp_path / "b.stl", kind="bone")


def test_photographic_colours_are_no_labels() -> None:
    source = arch()
    rng = np.random.default_rng(1)
    skin = np.clip(rng.normal((205, 125, 120), 4, (len(source.vertices), 3)), 0, 255).astype(np.uint8)
    skin[0] = (255, 0, 0)
    mesh = Mesh(source.vertices, source.faces, skin)
    assert (tooth_labels(mesh) == TOOTH).all()


def test_a_face_is_crown_with_two_tooth_corners() -> None:
    vertices = np.random.default_rng(2).normal(size=(4, 3))
    colors = np.array([(255, 0, 0), (0, 255, 0), (90, 90, 90), (200, 110, 110)], np.uint8)
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3], [2, 0, 1], [0, 3, 1]]), colors)
    assert crown_face_mask(mesh).tolist() == [True, False, True, True]
    assert crown_face_mask(Mesh(vertices, mesh.faces)).all()


def test_winding_tells_closed_from_open_and_out_from_in() -> None:
    source = arch()
    volume = source.volume
    inside_out = meshio.winding(Mesh(source.vertices, source.faces[:, ::-1]))
    assert inside_out.closed and not inside_out.outward and inside_out.volume_mm3 == pytest.approx(-volume)
    holed = meshio.winding(Mesh(source.vertices, source.faces[5:]))
    assert not holed.closed and holed.outward
    one_flipped = source.faces.copy()
    one_flipped[3] = one_flipped[3, ::-1]
    assert not meshio.winding(Mesh(source.vertices, one_flipped)).closed


def test_closed_meshes_inside_out_are_turned(tmp_path: Path) -> None:
    source = arch()
    inside_out = trimesh.Trimesh(source.vertices, source.faces[:, ::-1], process=False)
    inside_out.export(tmp_path / "a.ply")
    mesh = meshio.load_mesh(tmp_path / "a.ply")
    assert np.allclose(mesh.vertices, source.vertices, atol=1e-5) and np.array_equal(mesh.faces, source.faces)
    trimesh.Trimesh(source.vertices, source.faces[5:, ::-1], process=False).export(tmp_path / "open.ply")
    assert np.array_equal(meshio.load_mesh(tmp_path / "open.ply").faces, source.faces[5:, ::-1])


class FakeScan:
    """What open3sdcm returns for a scan with a texture: left half red, right half green."""

    def __init__(self) -> None:
        mesh = arch()
        self.vertices, self.faces = np.float32(mesh.vertices), np.uint64(mesh.faces)
        image = np.zeros((8, 16, 3), np.uint8)
        image[:, :8], image[:, 8:] = (0, 0, 255), (0, 255, 0)  # BGR
        self.texture = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
        x = mesh.vertices[mesh.faces.ravel(), 0]
        self.uv = np.column_stack([np.where(x > 0, 0.9, 0.1), np.full(len(x), 0.5)]).astype(np.float32)
        self.uv[:3] = np.nan


def test_dcm_is_read_with_its_texture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeScan()
    monkeypatch.setitem(sys.modules, "open3sdcm", SimpleNamespace(load=lambda path: fake))
    (tmp_path / "a.dcm").write_bytes(b"zip")
    mesh = meshio.load_mesh(tmp_path / "a.dcm")
    assert mesh.vertices.dtype == np.float64 and np.array_equal(mesh.faces, fake.faces.astype(int))
    sided = np.abs(mesh.vertices[:, 0]) > 1e-3
    right = mesh.vertices[:, 0] > 0
    assert (mesh.colors[sided & right, 1] > 200).all() and (mesh.colors[sided & ~right, 0] > 200).all()
    fake.texture = None
    assert meshio.load_mesh(tmp_path / "a.dcm").colors is None
    with pytest.raises(CaptureError, match="no such mesh"):
        meshio.load_mesh(tmp_path / "b.dcm")

    def fails(path: str) -> None:
        raise RuntimeError("encrypted")

    monkeypatch.setitem(sys.modules, "open3sdcm", SimpleNamespace(load=fails))
    with pytest.raises(CaptureError, match=r"cannot be read \(encrypted\)"):
        meshio.load_mesh(tmp_path / "a.dcm")


def test_dcm_without_its_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3sdcm", None)
    (tmp_path / "a.dcm").write_bytes(b"zip")
    with pytest.raises(MissingDependencyError, match=r"jawusd\[dcm\]"):
        meshio.load_mesh(tmp_path / "a.dcm")
