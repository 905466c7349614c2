"""Editing scan labels with the brush: extent of strokes, undo, and saving from the page."""

import shutil

import numpy as np
import pytest
import trimesh
from package_copy import ROOT
from quiet_capture_page import QuietCapturePage

from jawusd.formats.capture import load_capture
from jawusd.formats.mesh import BASE, GUM, TOOTH, Mesh, crown_face_mask, labels_path, load_scan_labels, tooth_labels
from jawusd.geometry import transform_point
from jawusd.pipeline.state import no_progress
from jawusd.pipeline.subject import load_labelled
from jawusd.pipeline.view_capture import viewed_capture
from jawusd.viewer.capture_page import CaptureViewer
from jawusd.viewer.scan_labels import ScanBrush, surface_near


def balls(soup: bool) -> Mesh:
    """Two balls that nearly touch; in a triangle soup, faces share no vertices."""
    one, two = (trimesh.creation.icosphere(subdivisions=3, radius=2.0) for _ in range(2))
    vertices = np.concatenate([one.vertices, two.vertices + [4.01, 0, 0]])
    faces = np.concatenate([one.faces, two.faces + len(one.vertices)])
    if soup:
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    return Mesh(vertices, faces)


@pytest.mark.parametrize("soup", [False, True])
def test_a_stroke_stays_on_its_surface(soup: bool) -> None:
    mesh = balls(soup)
    tip = int(np.linalg.norm(mesh.vertices - [2.0, 0, 0], axis=1).argmin())
    near = surface_near(mesh, tip, 1.0)
    distance = np.linalg.norm(mesh.vertices - mesh.vertices[tip], axis=1)
    np.testing.assert_array_equal(near, np.flatnonzero((distance <= 1.0) & (mesh.vertices[:, 0] < 2.005)))
    assert surface_near(mesh, tip, 1e-9).tolist() == np.flatnonzero(distance == 0).tolist()


def test_strokes_are_taken_back_in_order() -> None:
    mesh = balls(False)
    before = np.full(len(mesh.vertices), GUM, np.uint8)
    brush = ScanBrush({"upper": mesh}, {"upper": before})
    assert brush.undo() is None and not brush.changed
    assert brush.paint("upper", 0, 1.0, TOOTH) > 10 and brush.paint("upper", 0, 1.0, TOOTH) == 0
    first = brush.labels["upper"].copy()
    assert brush.paint("upper", 0, 0.5, BASE) > 0 and len(brush.strokes) == 2 and brush.changed == {"upper"}
    masks = [brush.faces_with("upper", label) for label in (TOOTH, GUM, BASE)]
    assert (np.sum(masks, axis=0) == 1).all() and all(mask.any() for mask in masks)
    assert brush.undo() == "upper"
    np.testing.assert_array_equal(brush.labels["upper"], first)
    assert brush.undo() == "upper" and not brush.labels["upper"].any() and not before.any()


@pytest.mark.slow
def test_painted_labels_are_saved_and_used(tmp_path) -> None:
    folder = shutil.copytree(ROOT / "examples" / "capture", tmp_path / "capture")
    viewed = viewed_capture(folder, None, no_progress)
    viewer = CaptureViewer(viewed, "127.0.0.1", 0)
    try:
        page = QuietCapturePage(viewer)
        page.settle()
        panel = page.page.labels
        page.press(page.page.picks.picking, False)
        panel.painting.value = False
        page.press(panel.painting, True)
        assert set(page.page.poses) == {"upper", "lower"}
        crown = np.unique(viewed.scans["upper"].faces[viewed.crowns["upper"]])
        vertices = viewed.scans["upper"].vertices[crown]
        front = vertices[:, 2].argmax()  # seen from the front
        page.enter(panel.kinds, "gum")
        page.click(transform_point(page.page.poses["upper"], vertices[front]))
        assert panel.brush.changed == {"upper"} and "not saved: upper" in panel._state.content
        assert not page.page.picks.book.picks or page.page.picks.book.bootstrap() == viewed.source.bootstrap
        page.enter(panel.undo, True)
        assert not panel.brush.strokes
        page.click(transform_point(page.page.poses["upper"], vertices[front]))
        page.enter(panel.write, True)
        assert page.notices.pop()[0] == "Written" and "all saved" in panel._state.content
    finally:
        viewer.stop()
    scans = load_capture(folder).scans
    meshes, findings = load_labelled(load_capture(folder))
    for arch in ("upper", "lower"):
        mesh = meshes[f"{arch}_teeth"]
        stored = load_scan_labels(labels_path(getattr(scans, f"{arch}_teeth")), mesh)
        assert stored.source == "reviewed"
        np.testing.assert_array_equal(stored.labels, panel.brush.labels[arch])
    fewer = crown_face_mask(meshes["upper_teeth"]).sum()
    assert 0 < fewer < viewed.crowns["upper"].sum()
    assert (tooth_labels(meshes["lower_teeth"]) > 0).sum() == (viewed.labels["lower"] > 0).sum()
    assert [finding.kind for finding in findings] == ["scan_labels_from_file"] * 2
