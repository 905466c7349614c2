"""Scans without paint: the command that labels them, the precedence of file, paint and shape, and labels in builds."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from package_copy import ROOT
from typer.testing import CliRunner

from jawusd.base.errors import FormatError, OutputError
from jawusd.cli.main import app
from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import (
    BASE,
    GUM,
    TOOTH,
    Mesh,
    ScanLabels,
    crown_face_mask,
    labels_path,
    load_scan_labels,
    save_scan_labels,
    tooth_labels,
)
from jawusd.meshes.meshio import load_mesh
from jawusd.pipeline.scans import all_labelled, label_scans, save_reviewed, store_labels, with_stored_labels
from jawusd.pipeline.subject import label_teeth, load_labelled, load_meshes
from jawusd.pipeline.workspace import input_hashes

ARCHES = ("upper", "lower")


@pytest.fixture
def painted(tmp_path):
    return shutil.copytree(ROOT / "examples" / "capture", tmp_path / "painted")


@pytest.fixture
def bare(tmp_path):
    """The example with its scans without paint, one of them a triangle soup."""
    folder = shutil.copytree(ROOT / "examples" / "capture", tmp_path / "bare")
    text = (folder / "capture.toml").read_text()
    scans = load_capture(folder).scans
    for arch, suffix in (("upper", ".ply"), ("lower", ".stl")):
        path = getattr(scans, f"{arch}_teeth")
        mesh = load_mesh(path)
        path.unlink()
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path.with_suffix(suffix))
        text = text.replace(path.name, path.with_suffix(suffix).name)
    (folder / "capture.toml").write_text(text)
    return folder


def test_unpainted_scans_get_the_labels_of_their_paint(painted, bare) -> None:
    meshes, findings = load_labelled(load_capture(bare))
    known = load_meshes(load_capture(painted))
    assert [finding.kind for finding in findings] == ["scan_labels_from_shape"] * 2
    for arch in ARCHES:
        mesh, old = meshes[f"{arch}_teeth"], known[f"{arch}_teeth"]
        np.testing.assert_array_equal(crown_face_mask(mesh), crown_face_mask(old))
        assert set(np.unique(tooth_labels(mesh))) == {GUM, TOOTH}
    assert load_labelled(load_capture(painted))[1] == []


def test_the_command_writes_labels_and_a_picture(bare) -> None:
    result = CliRunner().invoke(app, ["scans", str(bare), "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert (bare / "scan_labels.png").read_bytes()[:4] == b"\x89PNG" and found["picture"].endswith("scan_labels.png")
    upper, lower = found["scans"]
    assert (upper["merged_vertices"], upper["labels_by"]) == (0, "shape") and lower["merged_vertices"] > 1000
    scans = load_capture(bare).scans
    for arch, summary in zip(ARCHES, (upper, lower), strict=True):
        path = getattr(scans, f"{arch}_teeth")
        assert summary["labels_file"] == str(labels_path(path)) and summary["weak_border_percent"] == 0
        assert load_scan_labels(labels_path(path), load_mesh(path)).source == "automatic"
    again = CliRunner().invoke(app, ["scans", str(bare)])
    assert isinstance(again.exception, OutputError) and "scan_labels.png" in str(again.exception)
    assert "(by file)" in CliRunner().invoke(app, ["scans", str(bare), "-o", str(bare / "scans")]).stdout
    text = CliRunner().invoke(app, ["scans", str(bare), "--force"]).stdout
    assert "(by shape)" in text and "duplicate vertices merged" in text


def test_labels_in_a_folder_of_their_own(bare, tmp_path) -> None:
    label_scans(bare, bare / "other")
    assert not list((bare / "scans").glob("*.npz"))
    path = bare / "capture.toml"
    path.write_text(path.read_text().replace("[scans]", '[scans]\nlabels = "other"'))
    assert [finding.kind for finding in load_labelled(load_capture(bare))[1]] == ["scan_labels_from_file"] * 2


def test_a_file_goes_before_paint_and_an_old_one_is_refused(painted) -> None:
    capture = load_capture(painted)
    mesh = load_mesh(capture.scans.upper_teeth)
    before = input_hashes(capture, ["teeth"])
    labels = np.full(len(mesh.vertices), BASE, np.uint8)
    labels[:500] = TOOTH
    save_reviewed(capture.scans, {"upper": mesh}, "upper", labels)
    assert input_hashes(capture, ["teeth"]) != before  # tracked again
    meshes, findings = load_labelled(capture)
    np.testing.assert_array_equal(tooth_labels(meshes["upper_teeth"]), np.where(labels == TOOTH, TOOTH, GUM))
    assert [finding.kind for finding in findings] == ["scan_labels_from_file"]
    assert "its paint is ignored" in findings[0].message
    older = Mesh(mesh.vertices[1:], mesh.faces[:1])
    save_scan_labels(labels_path(capture.scans.upper_teeth), ScanLabels(labels[1:], "reviewed"), older)
    with pytest.raises(FormatError, match="another version of the scan"):
        load_meshes(capture)


def test_builds_keep_what_the_shape_says(painted, bare, tmp_path) -> None:
    capture, folder = load_capture(bare), tmp_path / "labels"
    assert all_labelled(load_capture(painted)) and store_labels(load_capture(painted), folder) == []
    assert not all_labelled(capture)
    assert sorted(path.name for path in store_labels(capture, folder)) == [
        "lower_teeth.labels.npz",
        "upper_teeth.labels.npz",
    ]
    kept = with_stored_labels(capture, folder)
    assert kept.scans.labels == folder and all_labelled(kept)
    label_scans(bare)  # now the scan has its own labels
    assert with_stored_labels(capture, folder) is capture and store_labels(capture, folder) == []
    assert not list(folder.iterdir())


def test_a_border_that_the_shape_hardly_shows_is_doubted() -> None:
    x, z = np.meshgrid(np.arange(-30, 30.1, 0.7), np.arange(-40, 5.1, 0.7), indexing="ij")
    hill = 9.0 * np.exp(-(((np.hypot(x, 1.2 * (z + 30)) - 26) / 5.0) ** 2))  # an arch without any crease
    n, m = x.shape
    a = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + m], 1), np.stack([a + 1, a + m + 1, a + m], 1)])
    mesh = Mesh(np.stack([x, hill, z], -1).reshape(-1, 3), faces)
    other = Mesh(mesh.vertices + [0, 12, 0], faces)
    files = {"upper_teeth": Path("u.ply"), "lower_teeth": Path("l.ply")}
    scan = label_teeth({"upper_teeth": other, "lower_teeth": mesh}, files, None)["lower"]
    doubts = [finding for finding in scan.findings if finding.kind == "scan_border_unclear"]
    assert len(doubts) == 1 and doubts[0].severity == "warning" and doubts[0].value > doubts[0].limit
