"""The index of a library: what is found, what is read again, and that nothing outside is touched."""

import json
import os

import numpy as np
import pytest
from example_people import person, save

from jawusd.base.errors import FormatError, VersionError
from jawusd.evaluator import load
from jawusd.library.index import INDEX_FILE, load_donors, scan_library


class Counted:
    """A loader that remembers what it read."""

    def __init__(self):
        self.read = []

    def __call__(self, path):
        self.read.append(path)
        return load(path)


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "people"
    save(person("Anna"), place / "anna" / "model.npz")
    save(person("Bert", ranges=0.8, opening=0.9, wider_mm=3), place / "team" / "bert" / "model.npz")
    return place


def test_every_subfolder_is_a_person(folder):
    library = scan_library(folder, load)
    assert [(e.path, e.actor) for e in library.entries] == [
        ("anna/model.npz", "Anna"),
        ("team/bert/model.npz", "Bert"),
    ]
    anna, bert = library.entries
    assert anna.ranges_mm["opening"] == [0.0, 42.0] and bert.ranges_mm["opening"][1] == pytest.approx(37.8)
    assert bert.condylar_distance_mm - anna.condylar_distance_mm == pytest.approx(6)
    x, y, z = anna.landmarks_mm["incisor"]
    assert (x, y, z) == pytest.approx((0, 0, 0), abs=1e-9) and anna.landmarks_mm["condyle_left"][0] > 40
    written = json.loads((folder / INDEX_FILE).read_text())
    assert written["format"] == "jawusd-library/1" and [rig["actor"] for rig in written["rigs"]] == ["Anna", "Bert"]


def test_only_what_changed_is_read_again(folder):
    first = scan_library(folder, load)
    before = os.stat(folder / INDEX_FILE).st_mtime_ns
    loader = Counted()
    assert scan_library(folder, loader).entries == first.entries
    assert loader.read == [] and os.stat(folder / INDEX_FILE).st_mtime_ns == before
    save(person("Anna", ranges=0.9), folder / "anna" / "model.npz")
    library = scan_library(folder, loader)
    assert [path.parent.name for path in loader.read] == ["anna"] and library.reread == 1
    assert library.entries[0].ranges_mm != first.entries[0].ranges_mm
    (folder / "anna" / "model.npz").unlink()
    assert [entry.actor for entry in scan_library(folder, loader).entries] == ["Bert"]


def test_persons_are_found_by_name_folder_and_path(folder):
    save(person("Bert"), folder / "other" / "model.npz")
    library = scan_library(folder, load)
    assert library.find("Anna") is library.find("anna") is library.find("anna/model.npz")
    assert library.find("team/bert").path == "team/bert/model.npz"
    with pytest.raises(FormatError, match="several rigs"):
        library.find("Bert")
    with pytest.raises(FormatError, match="it contains Anna"):
        library.find("Nobody")
    assert [entry.path for entry in library.search("BERT")] == ["other/model.npz", "team/bert/model.npz"]


def test_a_path_in_the_index_is_never_opened(folder, tmp_path):
    save(person("Outside"), tmp_path / "outside" / "model.npz")
    scan_library(folder, load)
    index = json.loads((folder / INDEX_FILE).read_text())
    for path in ("../outside/model.npz", str(tmp_path / "outside" / "model.npz")):
        index["rigs"].append({**index["rigs"][0], "path": path, "actor": "Outside"})
    (folder / INDEX_FILE).write_text(json.dumps(index))
    loader = Counted()
    library = scan_library(folder, loader)
    assert [entry.actor for entry in library.entries] == ["Anna", "Bert"] and loader.read == []
    assert "outside" not in (folder / INDEX_FILE).read_text().lower()


def test_links_that_leave_the_library_are_not_followed(folder, tmp_path):
    outside = save(person("Outside"), tmp_path / "outside" / "model.npz")
    (folder / "linked").symlink_to(outside.parent)
    (folder / "file").mkdir()
    (folder / "file" / "model.npz").symlink_to(outside)
    (folder / "stage").mkdir()
    (folder / "stage" / "actor.usda").write_text("#usda 1.0\n")
    (folder / "stage" / "rig.usdc").symlink_to(tmp_path / "outside" / "rig.usdc")
    loader = Counted()
    library = scan_library(folder, loader)
    assert [entry.actor for entry in library.entries] == ["Anna", "Bert"]
    assert set(library.skipped) == {"file/model.npz", "stage/actor.usda"}
    assert all("link that points outside the library" in why for why in library.skipped.values())
    assert {path.parent.name for path in loader.read} == {"anna", "bert"}


def test_an_index_that_is_a_link_is_refused(folder, tmp_path):
    (tmp_path / "precious").write_text("{}")
    (folder / INDEX_FILE).symlink_to(tmp_path / "precious")
    with pytest.raises(FormatError, match="is a link"):
        scan_library(folder, load)
    assert (tmp_path / "precious").read_text() == "{}"


class Bomb:
    """Leaves a mark when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return (open, (self.mark, "w"))


def test_a_model_with_a_pickle_is_skipped_unread(folder, tmp_path):
    mark = tmp_path / "mark"
    (folder / "evil").mkdir()
    np.savez(folder / "evil" / "model.npz", meta=np.array(Bomb(str(mark)), dtype=object))
    library = scan_library(folder, load)
    assert list(library.skipped) == ["evil/model.npz"] and not mark.exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda index: index.pop("rigs"),
        lambda index: index["rigs"][0].update(path=7),
        lambda index: index["rigs"][0].update(extra=1),
        lambda index: index["rigs"][0]["ranges_mm"].update(opening=["a", 2]),
        lambda index: index["rigs"][0]["ranges_mm"].update(opening=[1.0]),
        lambda index: index["rigs"][0]["ranges_mm"].update(opening=[0.0, 10**400]),
        lambda index: index["rigs"][0]["landmarks_mm"].update(incisor=[1.0]),
        lambda index: index["rigs"][0]["landmarks_mm"].pop("incisor"),
    ],
)
def test_a_damaged_index_is_refused(folder, change):
    scan_library(folder, load)
    index = json.loads((folder / INDEX_FILE).read_text())
    change(index)
    (folder / INDEX_FILE).write_text(json.dumps(index))
    with pytest.raises(FormatError, match="corrupt"):
        scan_library(folder, load)


def test_other_files_in_its_place_are_refused(folder):
    (folder / INDEX_FILE).write_text('{"format": "jawusd-library/2", "rigs": []}')
    with pytest.raises(VersionError):
        scan_library(folder, load)
    (folder / INDEX_FILE).write_text("[" * 100_000)
    with pytest.raises(FormatError, match="corrupt"):
        scan_library(folder, load)
    with pytest.raises(FormatError, match="does not exist"):
        scan_library(folder / "nowhere", load)


def test_persons_whose_capture_lacks_a_movement_are_no_donors(folder):
    rig = person("Carl")
    rig.meta["warnings"] = [{"code": "not_shown", "message": "no protrusion"}]
    save(rig, folder / "carl" / "model.npz")
    library = scan_library(folder, load)
    assert [entry.not_shown for entry in library.entries] == [False, True, False]
    assert [donor.name for donor in load_donors(library, load)] == ["anna/model.npz", "team/bert/model.npz"]
