"""The face-solver example runs; its full comparison takes minutes."""

import sys

import pytest
import torch
from load_script import load_script
from package_copy import ROOT


@pytest.fixture
def example(monkeypatch):
    module = load_script(ROOT / "examples" / "03_face_solver.py")
    monkeypatch.setattr(module, "STEP", 70)
    monkeypatch.setattr(module, "WEIGHTS", (0.1,))
    full = torch.optim.LBFGS  # the last 240 of 300 steps change mean errors by less than a tenth of a millimetre
    monkeypatch.setattr(torch.optim, "LBFGS", lambda *given, **options: full(*given, **options | {"max_iter": 60}))
    return module


@pytest.mark.slow
def test_a_rig_beats_the_pull_to_the_closed_mouth(example, monkeypatch, tmp_path, capsys):
    picture = tmp_path / "errors.png"
    monkeypatch.setattr(sys, "argv", ["face_solver.py", "-o", str(picture)])
    example.main()
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if len(line.split()) == 9}
    assert float(rows["rig"][4]) < float(rows["neutral"][4]) < float(rows["turning"][4])
    assert float(rows["d"][4]) < float(rows["neutral"][4])
    assert picture.read_bytes()[:4] == b"\x89PNG"
