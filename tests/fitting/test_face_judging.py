"""Verdicts on the jaw of a face model whose alignment is noisy: true frames are valid, planted wrong ones are not."""

import csv
import json

import numpy as np
import pytest
from example_people import person, save
from run_jawusd import face_csv, run

from jawusd.base.errors import FormatError
from jawusd.fitting.align import align, rig_points
from jawusd.fitting.face_judging import alignment_error_mm, judge_jaw_track
from jawusd.formats.alignment import read_jaw_track, save_alignment
from jawusd.geometry import make_transform, random_rotation, se3_inverse, so3_exp, so3_log, transform_points

SIGMA = {"incisor": 0.8, "molar_left": 1.2, "molar_right": 1.2, "chin": 2.0, "condyle_left": 2.0, "condyle_right": 2.0}
UNIT_MM = 1000.0


class Face:
    """A rig, and a face model of the same head in metres and other axes with a noisy alignment."""

    def __init__(self, seed):
        rng = np.random.default_rng([seed, 0xFACE])
        self.rig = person("someone", 0.8 + 0.4 * rng.random(), 0.8 + 0.4 * rng.random(), rng.normal(0, 2))
        self.back = se3_inverse(make_transform(random_rotation(rng), rng.normal(0, 200, 3)))
        points = rig_points(self.rig)
        chin = {"chin": points["incisor"] + [0.0, -34.0, -2.0]}
        seen = {name: p + SIGMA[name] * rng.normal(size=3) for name, p in {**points, **chin}.items() if name in SIGMA}
        marked = {name: self.in_model(p) for name, p in seen.items()}
        self.joint = self.in_model(0.5 * (points["condyle_left"] + points["condyle_right"]))
        self.alignment = align(self.rig, marked, chin, sigma_mm=SIGMA, unit_mm=UNIT_MM, joint=self.joint)
        d = self.rig.project(rng.uniform(*self.rig.d_range.T, (400, 3)))
        self.true = self.rig.pose(d)

    def in_model(self, point):
        return transform_points(self.back, point[None])[0] / UNIT_MM

    def motions(self, poses):
        """Return motions of the jaw (F, 4, 4) in the model's frame and unit."""
        T = self.back @ poses @ se3_inverse(self.rig.T_rest) @ se3_inverse(self.back)
        T[:, :3, 3] /= UNIT_MM
        return T

    def judge(self, path, motions):
        """Store motions as axis-angle and translation about the joint, and judge them."""
        R, j = motions[:, :3, :3], self.joint
        shift = motions[:, :3, 3] - (j - R @ j)
        np.savez(path, jaw_pose=so3_log(R), jaw_translation=shift, expression=np.zeros((len(R), 9)))
        return judge_jaw_track(self.rig, path, self.alignment)


@pytest.fixture(scope="module")
def faces():
    return [Face(seed) for seed in range(20)]


def test_true_frames_are_valid_and_wrong_ones_are_not(faces, tmp_path):
    """Over 20 heads; wrong are twice the opening, 15 mm to the side, 12 mm forward, and the opposite rotation."""
    valid, passed = [], []
    for face in faces:
        judged = face.judge(tmp_path / "jaw.npz", face.motions(face.true))
        valid.append(judged.verdicts.valid.mean())
        high = face.rig.d_range[:, 1]
        wrong = face.rig.pose(np.array([[2.0 * high[0], 0, 0], [5, high[1] + 15, 0], [5, 0, high[2] + 12]]))
        back = face.motions(face.rig.pose(np.array([[0.7 * high[0], 0, 0]])))
        back[:, :3, :3] = np.swapaxes(back[:, :3, :3], 1, 2)
        planted = np.concatenate([face.motions(wrong), back, face.motions(face.true)])
        passed.append(face.judge(tmp_path / "bad.npz", planted).verdicts.valid[:4])
    assert np.mean(valid) >= 0.95
    assert not np.any(passed)


def test_the_error_that_an_alignment_causes_is_stated(faces):
    """Squared displacement of the landmarks over its expectation, of 20 heads."""
    z2 = []
    for face in faces:
        T = face.motions(face.true)
        T[:, :3, 3] *= face.alignment.unit_mm
        S = face.alignment.matrix
        found = S @ T @ se3_inverse(S) @ face.rig.T_rest
        off = transform_points(found, face.rig.landmarks) - transform_points(face.true, face.rig.landmarks)
        stated = alignment_error_mm(face.rig, found, face.alignment)
        z2.append((off**2).sum(axis=(1, 2)).mean() / 5 / (stated**2).mean())
    assert 0.5 < np.mean(z2) < 1.6


def test_tracks_are_read_and_others_refused(faces, tmp_path):
    face, path = faces[0], tmp_path / "jaw.npz"
    T = face.motions(face.true[:5])
    np.savez(path, T_model_jaw=T, frames=[3, 4, 5, 6, 9])
    frames, motion = read_jaw_track(path, None)
    assert frames.tolist() == [3, 4, 5, 6, 9] and np.array_equal(motion, T)
    np.savez(path, jaw_pose=so3_log(T[:, :3, :3])[:, None])
    _, found = read_jaw_track(path, tuple(face.joint))
    np.testing.assert_allclose(found[:, :3, :3], so3_exp(so3_log(T[:, :3, :3])), atol=1e-12)
    np.testing.assert_allclose(transform_points(found, face.joint[None])[:, 0], np.tile(face.joint, (5, 1)), atol=1e-12)
    with pytest.raises(FormatError, match='no "joint"'):
        read_jaw_track(path, None)
    np.savez(path, pose=T)
    with pytest.raises(FormatError, match='neither "jaw_pose"'):
        read_jaw_track(path, None)
    other = face.alignment.model_copy(update={"actor": "somebody"})
    with pytest.raises(FormatError, match='of "somebody"'):
        judge_jaw_track(face.rig, path, other)


def test_validate_face_writes_a_table_and_a_strip(faces, tmp_path):
    face = faces[1]
    model, track, aligned = save(face.rig, tmp_path / "model.npz"), tmp_path / "jaw.npz", tmp_path / "T.json"
    save_alignment(aligned, face.alignment)
    poses = face.rig.pose(np.array([[5.0, 0, 0], [6, 0, 0], [2 * face.rig.d_range[0, 1], 0, 0]]))
    np.savez(track, T_model_jaw=face.motions(poses), frames=[10, 11, 12])
    table, strip = tmp_path / "verdicts.csv", tmp_path / "strip.png"
    words = ("validate", model, "--face", track, "--align", aligned)
    found = json.loads(run(*words, "--csv", table, "--strip", strip, "--json", code=1))
    assert (found["frames"], found["invalid"]) == (3, 1) and found["widened_mm"] > 0
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["frame"] for row in rows] == ["10", "11", "12"] and [row["valid"] for row in rows] == ["1", "1", "0"]
    assert float(rows[2]["alignment_mm"]) > float(rows[0]["alignment_mm"]) > 0
    assert strip.read_bytes().startswith(b"\x89PNG")
    run(*words, "--csv", table, code=10)  # the output exists
    assert "--align" in run("validate", model, "--face", track, code=2)
    assert "--face" in run("validate", model, "--align", aligned, code=2)
    weights = face_csv(tmp_path / "face.csv", [(0.3, 0, 0, 0)] * 70)
    assert "70 frames: 70 inside" in run("validate", model, "--face", weights)
