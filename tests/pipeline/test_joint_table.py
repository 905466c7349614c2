"""Offsets of the jaw joint per shape, compared with the skeleton's joint in OpenUSD and with vertices."""

import csv

import numpy as np
import pytest
from example_rig import FPS, example_rig, mandible_vertices, moved
from pxr import Usd, UsdSkel
from scipy.spatial.transform import Rotation

from jawusd.formats.arkit import ArkitMapping
from jawusd.formats.poses import save_joint_table
from jawusd.pipeline.bake import SHAPES, joint_deltas
from jawusd.rig.skel import write_skel

OWN = ArkitMapping(
    actor="example",
    neutral=(0.05, 0.02, 0.0, 0.04),
    dead_zone=(0.02, 0.0, 0.0, 0.0),
    rest_mm=(0.8, 0.1, 0.0),
    gain_mm=((14.0, 0, 0, 0), (0, 4.0, -4.0, 0.2), (0.3, 0, 0, 2.0)),
    opened_gain_mm=((0,) * 4,) * 3,
)


@pytest.mark.parametrize("mapping", [None, OWN])
def test_deltas_are_those_of_the_bone(tmp_path, mapping):
    rig = example_rig()
    save_joint_table(tmp_path / "joint.csv", joint_deltas(rig, mapping))
    with open(tmp_path / "joint.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["shape"], row["weight"]) for row in rows] == [(s, w) for s in SHAPES for w in ("0.5", "1")]
    numbers = {key: np.array([float(row[key]) for row in rows]) for key in rows[0] if key != "shape"}
    d0 = np.zeros(3) if mapping is None else rig.project(np.array(mapping.rest_mm))
    d = np.stack([numbers[f"d{i}"] for i in (1, 2, 3)], axis=1)
    write_skel(tmp_path / "skel.usda", rig, [], FPS, np.arange(len(d) + 1), np.vstack([d0, d]))
    stage = Usd.Stage.Open(str(tmp_path / "skel.usda"))
    bones = UsdSkel.Cache().GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Actor/Skel")))
    shown = [np.array(bones.ComputeJointSkelTransforms(float(frame))[1]).T for frame in range(len(d) + 1)]
    for k in range(len(rows)):
        delta = np.array([numbers[f"t{axis}"][k] for axis in "xyz"])
        np.testing.assert_allclose(delta, (shown[k + 1] - shown[0])[:3, 3], atol=1e-4)
        turn = shown[k + 1][:3, :3] @ shown[0][:3, :3].T
        angles = [numbers[f"r{axis}_deg"][k] for axis in "xyz"]
        np.testing.assert_allclose(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), turn, atol=1e-6)
        wxyz = [numbers[f"q{axis}"][k] for axis in "wxyz"]
        np.testing.assert_allclose(Rotation.from_quat(np.roll(wxyz, -1)).as_matrix(), turn, atol=1e-6)
    # as a rig applies a row: rotate vertices of the neutral face about the neutral joint, and translate them
    neutral = moved(rig.pose(d0)[None], mandible_vertices())[0]
    for k, T in enumerate(rig.pose(d)):
        R = Rotation.from_euler("xyz", [numbers[f"r{axis}_deg"][k] for axis in "xyz"], degrees=True).as_matrix()
        joint = shown[0][:3, 3]
        carried = (neutral - joint) @ R.T + joint + [numbers[f"t{axis}"][k] for axis in "xyz"]
        assert np.linalg.norm(carried - moved(T[None], mandible_vertices())[0], axis=1).max() < 1e-4


def test_shapes_mean_what_they_mean_to_animate():
    """Shares reach the full opening and both ends of laterotrusion; a mapping gives its d, inside the bound."""
    rig = example_rig()
    full = {row.shape: row for row in joint_deltas(rig) if row.weight == 1}
    d2_low, d2_high, _, d3_high = (float(x) for x in np.ravel(rig.ranges(0.0)))
    np.testing.assert_allclose(full["JawOpen"].d, [rig.d_range[0, 1], 0, 0], atol=0.05)
    np.testing.assert_allclose(
        [full["JawLeft"].d[1], full["JawRight"].d[1], full["JawForward"].d[2]], [d2_high, d2_low, d3_high], atol=0.05
    )
    rows = joint_deltas(rig, OWN)
    for row in rows:
        weights = np.array(OWN.neutral)
        weights[SHAPES.index(row.shape)] = row.weight
        wanted = OWN.d(weights)
        np.testing.assert_allclose(row.d, rig.project(wanted), atol=1e-9)
        assert row.clamped_mm == pytest.approx(np.linalg.norm(rig.project(wanted) - wanted), abs=1e-9)
        assert rig.is_inside(row.d)
