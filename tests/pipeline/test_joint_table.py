"""Offsets of the jaw joint per shape, compared with the skeleton's joint in OpenUSD and with vertices."""

import csv

import numpy as np
import pytest
from example_rig import FPS, example_rig, mandible_vertices, moved
from pxr import Usd, UsdSkel
from scipy.spatial.transform import Rotation

from jawusd.base.errors import FittingError
from jawusd.fitting.skin import fit_skin
from jawusd.formats.arkit import JAW_COLUMNS
from jawusd.formats.poses import save_joint_table
from jawusd.pipeline.bake import SHAPES, joint_deltas
from jawusd.rig.skel import write_skel

REST = np.array([0.05, 0.02, 0.0, 0.04])
GAINS = np.array([[28.0, 0, 0, 0], [0, 8.0, -8.0, 0.2], [0.3, 0, 0, 4.0]])  # mm of d per weight


def learned(rig, names=JAW_COLUMNS):
    """Return a map learned from weights with these gains, and the face at rest in some frames."""
    weights = REST + np.random.default_rng(0).uniform(0, 1, (240, 4)) * np.array([0.9, 0.6, 0.6, 0.9])
    weights[::8] = REST
    return fit_skin(rig, weights, (weights - REST) @ GAINS.T, np.ones(240, bool), 0.02, names=names)


@pytest.mark.parametrize("own", [False, True])
def test_deltas_are_those_of_the_bone(tmp_path, own):
    rig = example_rig()
    skin = learned(rig) if own else None
    save_joint_table(tmp_path / "joint.csv", joint_deltas(rig, skin))
    with open(tmp_path / "joint.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["shape"], row["weight"]) for row in rows] == [(s, w) for s in SHAPES for w in ("0.5", "1")]
    numbers = {key: np.array([float(row[key]) for row in rows]) for key in rows[0] if key != "shape"}
    d0 = np.zeros(3) if skin is None else rig.project(skin(REST).d)
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
    """Shares reach the full opening and both ends of laterotrusion; a map gives its d, inside the bound."""
    rig = example_rig()
    full = {row.shape: row for row in joint_deltas(rig) if row.weight == 1}
    d2_low, d2_high, _, d3_high = (float(x) for x in np.ravel(rig.ranges(0.0)))
    np.testing.assert_allclose(full["JawOpen"].d, [rig.d_range[0, 1], 0, 0], atol=0.05)
    np.testing.assert_allclose(
        [full["JawLeft"].d[1], full["JawRight"].d[1], full["JawForward"].d[2]], [d2_high, d2_low, d3_high], atol=0.05
    )
    skin = learned(rig)
    for row in joint_deltas(rig, skin):
        weights = REST.copy()
        weights[SHAPES.index(row.shape)] = row.weight
        wanted = skin(weights).d
        np.testing.assert_allclose(row.d, rig.project(wanted), atol=1e-6)
        assert row.clamped_mm == pytest.approx(np.linalg.norm(rig.project(wanted) - wanted), abs=1e-6)
        assert rig.is_inside(row.d)
        np.testing.assert_allclose(wanted, GAINS @ (weights - REST), atol=0.4)


def test_a_map_from_other_columns_has_no_table():
    rig = example_rig()
    with pytest.raises(FittingError, match="not learned from JawForward.*arkit-fit"):
        joint_deltas(rig, learned(rig, ("JawOpen", "JawLeft", "JawRight", "MouthPucker")))
