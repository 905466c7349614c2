"""Rigs of every released format version stay readable and give the same poses, in every evaluator."""

import json
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from pxr import Usd

from jawusd.plugins import jawusd_reader
from jawusd.rig import load_rig, validate_stage
from jawusd.rig.layout import FORMAT_VERSION
from jawusd.rig.read import find_rig_prim, read_table
from jawusd.rig.table import largest_distance

GOLDEN = Path(__file__).parents[1] / "golden"
FOLDERS = sorted(GOLDEN.glob("rig_v*"))


def test_the_present_version_has_a_golden_rig():
    assert {f"rig_v{FORMAT_VERSION}_anchored", f"rig_v{FORMAT_VERSION}_additive"} <= {path.name for path in FOLDERS}


@pytest.fixture(params=FOLDERS, ids=lambda path: path.name)
def golden(request):
    """Return a golden folder, its parameters, poses and margins."""
    said = json.loads((request.param / "poses.json").read_text())
    return request.param, np.array(said["d"]), np.array(said["poses"]), np.array(said["margins"])


def test_evaluator_gives_the_golden_poses(golden):
    folder, d, poses, margins = golden
    rig = load_rig(folder / "actor.usda")
    np.testing.assert_allclose(rig.pose(d), poses, atol=1e-9)
    np.testing.assert_allclose(rig.margin(d), margins, atol=1e-9)


def test_single_file_reader_gives_the_golden_poses(golden):
    folder, d, poses, margins = golden
    rig = jawusd_reader.load(folder / "actor.usda")
    np.testing.assert_allclose([rig.pose(*row) for row in d.tolist()], poses, atol=1e-9)
    np.testing.assert_allclose([rig.margin(*row) for row in d.tolist()], margins, atol=1e-9)


def test_onnx_graph_gives_the_golden_poses(golden):
    folder, d, poses, margins = golden
    pose, margin = onnxruntime.InferenceSession(str(folder / "actor.onnx")).run(["pose", "margin"], {"d": d})
    np.testing.assert_allclose(pose, poses, atol=1e-9)
    np.testing.assert_allclose(margin, margins, atol=1e-9)


def test_table_is_as_near_to_the_golden_poses_as_it_says(golden):
    folder, d, poses, margins = golden
    stage = Usd.Stage.Open(str(folder / "actor.usda"))
    table = read_table(find_rig_prim(stage, folder))
    rig = load_rig(folder / "actor.usda")
    inside = margins >= 0
    assert inside.sum() >= 5
    distance = largest_distance(table.pose(d[inside], rig.T_rest), poses[inside], rig.landmarks)
    assert distance.max() <= table.max_error_mm + 0.01


def test_golden_rigs_are_valid_but_for_the_encoder_they_lack(golden):
    findings = validate_stage(golden[0] / "actor.usda")
    assert {finding.rule for finding in findings} == {"Onnx", "UnresolvableDependency"}
    assert all("actor_encode.onnx" in finding.message for finding in findings)
