"""The person's anatomy, from each kind of file."""

import json
from pathlib import Path

import numpy as np
import pytest
from example_model import example_arrays, example_meta
from example_rig import FPS, example_meshes, example_motion, example_rig
from package_copy import ROOT

from jawusd.base.errors import CaptureError, FormatError, RigError
from jawusd.formats.model import JawModel, save_model
from jawusd.geometry import LANDMARKS, landmark_frame
from jawusd.geometry.anatomy import MEAN_CONDYLES
from jawusd.pipeline.bake import bake_subject
from jawusd.pipeline.subject import (
    load_meshes,
    registered_subject,
    subject_of_build,
    subject_of_capture,
    subject_of_landmarks,
    subject_of_scans,
)
from jawusd.pipeline.workspace import open_capture
from jawusd.rig.bake import bake_rig

SCANS = {name: ROOT / "examples" / "capture" / "scans" / f"{name}.ply" for name in ("upper_teeth", "lower_teeth")}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with the files of a build that the report needs: model and geometry."""
    folder = tmp_path_factory.mktemp("built")
    frames, d = example_motion()
    bake_rig(folder, example_rig(), example_meshes(), name="someone", fps=FPS, frames=frames, d=d, table_size=17)
    meta = {**example_meta(), "actor": "someone", "fps": 24.0}
    zeros = np.zeros(len(frames))
    save_model(folder / "model.npz", JawModel(example_arrays(), np.array(frames), d, zeros, zeros == 0, meta))
    return folder


def test_a_build_is_enough_to_report_on_it(built):
    found, arrays = subject_of_build(built), example_arrays()
    assert (found.name, found.fps) == ("someone", 24.0)
    np.testing.assert_array_equal(found.landmarks, arrays["landmarks"])
    np.testing.assert_array_equal(found.T_anatomical_skull, arrays["T_anatomical_skull"])
    np.testing.assert_array_equal(found.T_rest, arrays["T_rest"])
    np.testing.assert_allclose(found.measured_points(), example_meshes()["mandible"].vertices, atol=1e-4)


def test_a_folder_without_model_or_geometry_is_one_clear_error(built, tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        subject_of_build(tmp_path)
    (tmp_path / "model.npz").write_bytes((built / "model.npz").read_bytes())
    with pytest.raises(RigError, match="no such file"):
        subject_of_build(tmp_path)


def test_loose_scans_say_the_same_as_the_capture_they_belong_to():
    capture = subject_of_capture(open_capture(ROOT / "examples" / "capture"))
    mandible = ROOT / "examples" / "capture" / "scans" / "mandible.ply"
    loose = subject_of_scans({**SCANS, "mandible": mandible}, "someone")
    np.testing.assert_array_equal(loose.landmarks, capture.landmarks)
    np.testing.assert_array_equal(loose.T_anatomical_skull, capture.T_anatomical_skull)
    np.testing.assert_array_equal(loose.T_rest, np.eye(4))
    assert len(loose.measured_points()) == len(capture.measured_points())
    without = subject_of_scans(SCANS, "someone")
    np.testing.assert_array_equal(without.measured_points(), without.meshes["lower_teeth"].vertices)
    # the rig looks for these words before it takes the condyles from the motion
    assert any(text.startswith("condyle_left") and MEAN_CONDYLES in text for text in without.inferred)


def with_landmarks(**named):
    """Return the example's capture without its bones, with named landmarks."""
    capture = open_capture(ROOT / "examples" / "capture")
    capture = capture.model_copy(update={"anatomy": capture.anatomy.model_copy(update={"landmarks": named})})
    meshes = load_meshes(capture)
    return subject_of_capture(capture, {name: meshes[name] for name in ("upper_teeth", "lower_teeth")})


def test_ears_place_the_condyles_of_a_subject_without_bones():
    found = with_landmarks(tragion_left=(75.0, 40.0, -95.0), tragion_right=(-75.0, 40.0, -95.0))
    np.testing.assert_allclose(found.landmarks[3:], [[55, 40, -82], [-55, 40, -82]], atol=1.5)
    assert any("from the tragions" in text for text in found.inferred)
    with pytest.raises(CaptureError, match="only one of tragion_left and tragion_right"):
        with_landmarks(tragion_left=(75.0, 40.0, -95.0))


def test_a_scan_that_is_none_is_named():
    with pytest.raises(CaptureError, match="nothing.ply"):
        subject_of_scans({**SCANS, "mandible": Path("nothing.ply")}, "someone")


def test_landmarks_alone_measure_at_the_landmarks(tmp_path):
    at = np.array([[1.0, -30, 5], [23, -30, -21], [-21, -30, -21], [51, 6, -75], [-49, 6, -75]])
    data = {"format": "jawusd-landmarks/1", "units": "mm", "landmarks": dict(zip(LANDMARKS, at.tolist(), strict=True))}
    (tmp_path / "l.json").write_text(json.dumps(data))
    found = subject_of_landmarks(tmp_path / "l.json", "someone")
    assert found.measured_points() is None and found.inferred == ("anatomical axes, from the landmarks",)
    np.testing.assert_array_equal(found.T_anatomical_skull, landmark_frame(at))


def _moved(applied):
    T = np.eye(4)
    T[:3, 3] = (0.3, -1.0, 0.5)
    return {"registration": {"applied": applied, "T": T.tolist()}}


def test_a_registration_taken_from_the_take_moves_lower_scan_and_teeth_but_no_condyles():
    subject = subject_of_scans(SCANS, "someone")
    moved = registered_subject(subject, _moved(True))
    assert np.allclose(moved.meshes["lower_teeth"].vertices - subject.meshes["lower_teeth"].vertices, (0.3, -1.0, 0.5))
    assert np.array_equal(moved.meshes["upper_teeth"].vertices, subject.meshes["upper_teeth"].vertices)
    away = moved.landmarks - subject.landmarks
    for name, shift in zip(LANDMARKS, away, strict=True):
        assert np.allclose(shift, 0.0 if name.startswith("condyle") else (0.3, -1.0, 0.5))
    assert registered_subject(subject, _moved(False)) is subject
    assert registered_subject(subject, {}) is subject


@pytest.mark.slow
def test_the_rig_holds_the_lower_scan_where_the_take_shows_it(tmp_path):
    """One model is baked as fitted without scans, the other with contact of the teeth."""
    usd = pytest.importorskip("pxr.Usd")
    subject = subject_of_scans(SCANS, "someone")
    model = JawModel(example_arrays(), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool))
    places = []
    for name, meta in (("given", {}), ("taken", {**_moved(True), "contact": {"missing": "not measured"}})):
        model.meta.clear()
        model.meta.update({**example_meta(), **meta})
        bake_subject(subject, model, tmp_path / name, fps=FPS, table_size=17)
        stage = usd.Stage.Open(str(tmp_path / name / "actor.usda"))
        (mesh,) = [prim for prim in stage.Traverse() if prim.GetName() == "LowerTeethMesh"]
        places.append(np.array(mesh.GetAttribute("points").Get()))
    assert np.allclose(places[1] - places[0], (0.3, -1.0, 0.5), atol=1e-4)
