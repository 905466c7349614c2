"""`python -m jawusd.evaluator`: output, exit codes, bad input."""

import csv
import io
import json
import subprocess
import sys

import numpy as np
import pytest
from example_model import example_arrays, example_meta

from jawusd.evaluator import JawRig
from jawusd.evaluator.__main__ import main
from jawusd.formats.poses import read_poses, write_poses

RIG = JawRig(example_arrays(), example_meta())
D = np.array([[0.0, 0.0, 0.0], [20.0, 2.0, 1.0], [35.0, -1.0, 0.5]])


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.npz"
    np.savez(path, **example_arrays(), meta=np.array(json.dumps(example_meta())))
    return str(path)


@pytest.fixture
def poses(tmp_path):
    path = tmp_path / "poses.csv"
    write_poses(path, np.array([5, 6, 9]), RIG.pose(D))
    return str(path)


def test_encode_gives_parameters_and_residuals(model, poses, capsys):
    assert main(["encode", model, poses]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [row["frame"] for row in rows] == ["5", "6", "9"]
    np.testing.assert_allclose([[float(row[k]) for k in ("d1", "d2", "d3")] for row in rows], D, atol=1e-7)
    assert max(float(row["residual_mm"]) for row in rows) < 1e-7


def test_validate_says_yes_with_exit_code_0_and_no_with_1(model, poses, capsys, tmp_path):
    assert main(["validate", model, poses]) == 0
    assert "False" not in capsys.readouterr().out
    write_poses(tmp_path / "bad.csv", np.array([1, 2]), RIG.pose([[20.0, 2.0, 1.0], [20.0, 20.0, 1.0]]))
    assert main(["validate", model, str(tmp_path / "bad.csv"), "--json"]) == 1
    first, second = json.loads(capsys.readouterr().out)
    assert first["valid"] is True and first["reason"] == "inside"
    assert second["valid"] is False and second["reason"] == "outside"
    assert second["margin_mm"] == pytest.approx(float(RIG.margin([20.0, 20.0, 1.0])), abs=1e-7)


def test_a_pose_that_is_not_finite_is_a_verdict_not_an_error(model, capsys, tmp_path):
    columns = ",".join(f"m{r}{c}" for r in range(4) for c in range(4))
    (tmp_path / "nan.csv").write_text(f"frame,{columns}\n7," + ",".join(["nan"] * 16) + "\n")
    assert main(["validate", model, str(tmp_path / "nan.csv"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == [
        {"frame": 7, "valid": False, "reason": "not finite", "residual_mm": None, "margin_mm": None}
    ]


def test_pose_writes_a_table_the_pose_reader_takes(model, capsys, tmp_path):
    assert main(["pose", model, "--d", "20", "2", "1"]) == 0
    (tmp_path / "out.csv").write_text(capsys.readouterr().out)
    frames, T = read_poses(tmp_path / "out.csv")
    np.testing.assert_allclose(T, RIG.pose([[20.0, 2.0, 1.0]]), atol=1e-12)
    assert main(["pose", model, "--d", "20", "2", "1", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(facts["twist"], RIG.twist([20.0, 2.0, 1.0]))
    assert facts["margin_mm"] == pytest.approx(float(RIG.margin([20.0, 2.0, 1.0])))


def test_info_names_actor_and_ranges(model, capsys):
    assert main(["info", model, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["actor"] == "example" and facts["d_max_mm"][0] == 42.0
    assert main(["info", model]) == 0
    assert "actor: example" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,m00\n1,2\n", 'has no "m01"'),
        ("frame," + ",".join(f"m{r}{c}" for r in range(4) for c in range(4)) + "\nx" + ",0" * 16 + "\n", "line 2"),
        ('"', "not a CSV table"),
    ],
)
def test_bad_tables_are_refused_in_one_line(model, capsys, tmp_path, text, message):
    (tmp_path / "bad.csv").write_text(text)
    assert main(["encode", model, str(tmp_path / "bad.csv")]) == 3
    error = capsys.readouterr().err
    assert message in error and "bad.csv" in error and error.count("\n") == 1


def test_a_missing_model_is_exit_code_3(tmp_path, capsys):
    assert main(["info", str(tmp_path / "none.npz")]) == 3
    assert "no such file" in capsys.readouterr().err


def test_the_module_runs_as_a_program(model):
    done = subprocess.run(
        [sys.executable, "-m", "jawusd.evaluator", "info", model], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "kind: anchored" in done.stdout
    usage = subprocess.run([sys.executable, "-m", "jawusd.evaluator"], capture_output=True, text=True, check=False)
    assert usage.returncode == 2
