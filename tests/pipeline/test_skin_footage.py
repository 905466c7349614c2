"""The jaw behind closed lips by the skin in the footage itself."""

import numpy as np
import pytest
from face_takes import Performer
from run_jawusd import run
from skin_dots import DottedFace

from jawusd.base.errors import FittingError
from jawusd.fitting.face import on_bone
from jawusd.fitting.shot_skin import in_head
from jawusd.geometry import transform_points
from jawusd.pipeline.solve_skin import SkinOfFootage


def errors_mm(rig, d, T_true):
    incisor = rig.landmarks[:1]
    return np.linalg.norm(transform_points(rig.pose(d), incisor) - transform_points(T_true, incisor), axis=-1)[:, 0]


@pytest.mark.slow
def test_the_jaw_behind_closed_lips_is_learned_from_frames_with_visible_teeth():
    face, rig = DottedFace(1), Performer(1).rig
    true, rng = rig.encode(face.T_jaw).d, np.random.default_rng(0)
    d = np.where(face.seen[:, None], true + 0.1 * rng.normal(size=true.shape), 0.0)
    heads = np.where(face.seen[:, None, None], face.T_world_head, face.T_world_head[0])
    skin, told = SkinOfFootage(rig, face.cameras, face, lambda done, total: told.append((done, total))), []
    found = skin(np.arange(len(d), dtype=float), d, face.seen, heads)
    closed = face.closed > 0.95
    error = errors_mm(rig, rig.project(found.d[closed]), face.T_jaw[closed])
    rows, seen = np.arange(len(d)), np.flatnonzero(face.seen)
    between = np.stack([np.interp(rows, seen, column) for column in d[seen].T], axis=1)
    carried = errors_mm(rig, between[closed], face.T_jaw[closed])
    X = in_head(skin.followed(rows.tolist(), d, face.seen, heads), heads, face.seen)
    X = X[:, np.isfinite(X[..., 0]).mean(axis=0) > 0.9]
    whole = np.isfinite(X).all(axis=(1, 2))
    T_skull_face, in_mandible_mm, points = on_bone(rig, X[face.seen & whole], rig.pose(d[face.seen & whole]))
    chin = rig.ik(in_mandible_mm, transform_points(T_skull_face, X[closed & whole][:, points])).d
    assert error.mean() < 0.65 * errors_mm(rig, chin, face.T_jaw[closed & whole]).mean()
    assert error.mean() < 2.0 < carried.mean() / 2 and found.familiar[closed].all()
    assert told[-1] == (len(d), len(d))
    summary = skin.summary()
    errors = summary["errors_mm"]
    assert summary["points"] >= 12 and errors["skin"] < 0.4 * errors["carried"]


def test_one_camera_or_hidden_teeth_are_refused():
    face, rig = DottedFace(1, frames=2, closings=()), Performer(1).rig
    one = dict(list(face.cameras.items())[:1])
    with pytest.raises(FittingError, match="two or more cameras"):
        SkinOfFootage(rig, one, face)
    with pytest.raises(FittingError, match="no frame shows the teeth"):
        SkinOfFootage(rig, face.cameras, face).followed([0, 1], np.zeros((2, 3)), np.zeros(2, bool), face.T_world_head)


def test_a_map_needs_a_face_and_skin_of_the_footage_needs_the_images(tmp_path):
    words = ["solve", tmp_path / "rig.npz", tmp_path]
    for options in (["--skin", "skin.npz"], ["--skin", "footage", "--skin-only"], ["--face", "face.csv"]):
        assert "needs both --skin and --face" in run(*words, *options, code=2)
