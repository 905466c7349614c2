"""`jawusd align`, run as a program."""

import json

import numpy as np
from example_people import person, save
from run_jawusd import run

from jawusd.fitting.align import rig_points
from jawusd.formats.alignment import load_alignment


def points_file(path, rig, **changes):
    """Write the correspondences of a face model in metres, whose axes are y, z, x of the rig's."""
    marked = {name: 1e-3 * p[[1, 2, 0]] for name, p in rig_points(rig).items()}
    chin = rig_points(rig)["incisor"] + [0.0, -34.0, -2.0]
    points = {name: {"model": p.tolist(), "sigma_mm": 1.0} for name, p in marked.items()}
    points["chin"] = {"model": (1e-3 * chin[[1, 2, 0]]).tolist(), "rig": chin.tolist(), "sigma_mm": 3.0}
    joint = 0.5 * (marked["condyle_left"] + marked["condyle_right"])
    whole = {"format": "jawusd-correspondences/1", "unit_mm": 1000, "points": points, "joint": joint.tolist()}
    path.write_text(json.dumps({**whole, **changes}))
    return path


def test_align_writes_what_solvers_need(tmp_path):
    rig = person("someone")
    model, out = save(rig, tmp_path / "model.npz"), tmp_path / "T.json"
    points = points_file(tmp_path / "points.json", rig)
    text = run("align", model, points, "-o", out)
    assert "from 7 points" in text and "mm at the condyles" in text and "chin 0.0" in text
    found = load_alignment(out)
    expected = np.eye(4)[[1, 2, 0, 3]].T
    np.testing.assert_allclose(found.matrix, expected, atol=1e-9)
    assert (found.actor, found.unit_mm) == ("someone", 1000) and len(found.joint) == 3
    run("align", model, points, "-o", out, code=10)  # the output exists
    points_file(points, rig, points={"incisor": {"model": [0, 0, 0], "sigma_mm": 1}})
    refused = run("align", model, points, "-o", out, "--force", code=7)
    assert "points.json" in refused and "at least 3 that" in refused
