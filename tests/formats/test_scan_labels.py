"""Labels of scans: what is written comes back, and other scans, damage and hostile values are refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from jawusd.base.errors import FormatError, OutputError, VersionError
from jawusd.formats.mesh import (
    BASE,
    BOUNDARY,
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


def strip() -> Mesh:
    vertices = np.random.default_rng(1).normal(size=(6, 3))
    return Mesh(vertices, np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]]))


LABELS = np.array([TOOTH, BOUNDARY, TOOTH, GUM, BASE, GUM], np.uint8)


def test_labels_come_back(tmp_path: Path) -> None:
    mesh, path = strip(), tmp_path / "a.labels.npz"
    save_scan_labels(path, ScanLabels(LABELS, "reviewed", 0.25), mesh)
    found = load_scan_labels(path, mesh)
    np.testing.assert_array_equal(found.labels, LABELS)
    assert (found.source, found.weak_share) == ("reviewed", 0.25)


def test_labels_go_before_paint_and_base_is_no_tooth() -> None:
    red = np.tile(np.array([215, 45, 40], np.uint8), (6, 1))
    mesh = Mesh(strip().vertices, strip().faces, red, LABELS)
    np.testing.assert_array_equal(tooth_labels(mesh), [TOOTH, BOUNDARY, TOOTH, GUM, GUM, GUM])
    np.testing.assert_array_equal(crown_face_mask(mesh), [True, True, False, False])
    with pytest.raises(ValueError, match="labels must have shape"):
        Mesh(mesh.vertices, mesh.faces, None, LABELS[:5])


def test_files_lie_beside_the_scan_or_in_a_folder() -> None:
    assert labels_path(Path("scans/up.stl")) == Path("scans/up.labels.npz")
    assert labels_path(Path("scans/up.stl"), Path("other")) == Path("other/up.labels.npz")


def test_another_version_of_the_scan_is_refused(tmp_path: Path) -> None:
    mesh, path = strip(), tmp_path / "a.labels.npz"
    save_scan_labels(path, ScanLabels(LABELS, "automatic"), mesh)
    with pytest.raises(FormatError, match="another version of the scan"):
        load_scan_labels(path, Mesh(mesh.vertices + 1e-9, mesh.faces))
    with pytest.raises(FormatError, match="another version of the scan"):
        load_scan_labels(path, Mesh(mesh.vertices[:5], mesh.faces[:3]))


@pytest.mark.parametrize(
    ("change", "message", "kind"),
    [
        ({"source": "guessed"}, "source is", FormatError),
        ({"weak_share": 2}, "weak_share is", FormatError),
        ({"weak_share": "x"}, "weak_share is", FormatError),
        ({"format": "jawusd-scan-labels/2"}, "reads formats up to", VersionError),
        ({"format": "jawusd-tracks/1"}, "format is", FormatError),
        ({"scan_sha256": None}, "another version", FormatError),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, change: dict, message: str, kind: type) -> None:
    mesh, path = strip(), tmp_path / "a.labels.npz"
    save_scan_labels(path, ScanLabels(LABELS, "automatic"), mesh)
    with np.load(path) as file:
        labels, meta = file["labels"], json.loads(str(file["meta"]))
    np.savez(path, labels=labels, meta=np.array(json.dumps({**meta, **change})))
    with pytest.raises(kind, match=message):
        load_scan_labels(path, mesh)
    np.savez(path, labels=labels + 9, meta=np.array(json.dumps(meta)))
    with pytest.raises(FormatError, match="must be 0 to 3"):
        load_scan_labels(path, mesh)


def test_labels_of_another_mesh_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must have shape \(6,\)"):
        save_scan_labels(tmp_path / "a.labels.npz", ScanLabels(LABELS[:3], "automatic"), strip())
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        save_scan_labels(tmp_path / "file" / "a.labels.npz", ScanLabels(LABELS, "automatic"), strip())
