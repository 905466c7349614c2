"""Fusion of a take's poses with its condylar motion, on joints that are not polynomial."""

from dataclasses import replace

import numpy as np
import pytest

from jawusd.geometry import (
    make_transform,
    relative_pose,
    se3_adjoint,
    se3_exp,
    se3_inverse,
    se3_log,
    so3_exp,
    transform_point,
)
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person
from jawusd.tracking.contour.quality import landmark_sigmas, relative_covariance
from jawusd.tracking.region.jaw_priors import CondyleFusion
from jawusd.tracking.region.tracker import RegionPose

HEAD = make_transform(so3_exp(np.array([0.3, -2.0, 0.4])), [12.0, -30.0, 210.0])
AXES = so3_exp(np.array([0.1, 0.2, -0.3]))  # of a scan that is not in anatomical axes
BITE_SCAN = make_transform(AXES, [5.0, -40.0, 9.0])
FRAMES = 150


class Take:
    """A take whose arches have rotational errors about the teeth, as in tracking by colour."""

    def __init__(self, seed, upper=0.3, turn_deg=0.8):
        person, rng = Person(seed), np.random.default_rng(seed)
        inverse = np.linalg.inv(BITE_SCAN)
        self.true = inverse @ record(person, FRAMES, seed=seed).T_true @ BITE_SCAN
        self.landmarks = transform_point(inverse, person.landmarks)
        exact = np.stack([np.broadcast_to(HEAD, self.true.shape), HEAD @ self.true], axis=1)
        centres = transform_point(exact, self.landmarks[:3].mean(0))
        scale = np.append(np.full(3, np.deg2rad(turn_deg)), np.full(3, 0.08))
        self.poses, self.covariance = exact.copy(), np.zeros((FRAMES, 2, 6, 6))
        for k in range(FRAMES):
            for r, share in enumerate((upper, 1.0)):
                A = se3_adjoint(make_transform(np.eye(3), centres[k, r]))
                root = A @ np.diag(share * scale)
                self.covariance[k, r] = root @ root.T
                self.poses[k, r] = se3_exp(root @ rng.standard_normal(6)) @ exact[k, r]
        A = se3_adjoint(se3_inverse(self.poses[:, 0]))
        self.between = A @ self.covariance.sum(1) @ np.swapaxes(A, 1, 2)
        self.fuse = CondyleFusion(self.landmarks, AXES)

    def off_mm(self, poses):
        relative = relative_pose(poses[:, 0], poses[:, 1])
        moved = transform_point(relative[:, None], self.landmarks) - transform_point(self.true[:, None], self.landmarks)
        return np.linalg.norm(moved, axis=-1)

    def nees(self, poses, between):
        twist = se3_log(self.true @ se3_inverse(relative_pose(poses[:, 0], poses[:, 1])))
        return np.einsum("fi,fij,fj->f", twist, np.linalg.inv(between), twist).mean() / 6


@pytest.mark.parametrize(("seed", "upper"), [(21, 0.3), (22, 0.3), (23, 1.0), (24, 1.0)])
def test_condyles_are_nearer_and_claims_stay_true(seed, upper):
    take = Take(seed, upper)
    poses, covariance, between = take.fuse(take.poses, take.covariance, take.between)
    before, after = take.off_mm(take.poses).mean(0), take.off_mm(poses).mean(0)
    assert (after[3:] < 0.8 * before[3:]).all() and (after[:3] < 1.02 * before[:3]).all()
    assert 0.5 < take.nees(poses, between) < 1.2
    smaller = np.trace(between, axis1=1, axis2=2) / np.trace(take.between, axis1=1, axis2=2)
    assert smaller.max() < 1.0
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_the_arch_that_is_known_stays():
    take = Take(25, upper=1e-3)
    poses, covariance, between = take.fuse(take.poses, take.covariance, take.between)
    incisor = take.landmarks[0]
    moved = np.linalg.norm(transform_point(poses, incisor) - transform_point(take.poses, incisor), axis=-1)
    assert moved[:, 0].max() < 1e-4 < 0.01 < moved[:, 1].mean()
    A = se3_adjoint(se3_inverse(poses[:, 0]))
    lower = A @ covariance[:, 1] @ np.swapaxes(A, 1, 2)
    assert lower == pytest.approx(between, rel=1e-3, abs=1e-3 * np.abs(between).max())


def test_lost_frames_stay_lost():
    take = Take(26)
    take.poses[5], take.covariance[5], take.between[5] = np.nan, np.nan, np.nan
    poses, covariance, between = take.fuse(take.poses, take.covariance, take.between)
    assert np.isnan(poses[5]).all() and np.isnan(covariance[5]).all() and np.isnan(between[5]).all()
    assert np.isfinite(np.delete(poses, 5, axis=0)).all()
    take.poses[:, 1] = np.nan
    nothing = take.fuse(take.poses, take.covariance, take.between * np.nan)
    assert np.isnan(nothing[0][:, 1]).all() and np.array_equal(nothing[0][:, 0], take.poses[:, 0], equal_nan=True)


def test_frames_whose_condyles_are_out_of_the_way_claim_less():
    take = Take(27)
    usual = take.fuse(take.poses, take.covariance, take.between)[2]
    wrong = se3_exp(np.append(np.deg2rad(-6.0) * AXES[0], np.zeros(3)))
    molars = make_transform(np.eye(3), take.landmarks[1:3].mean(0))
    take.poses[60, 1] = take.poses[60, 1] @ molars @ wrong @ se3_inverse(molars)
    between = take.fuse(take.poses, take.covariance, take.between)[2]
    ratio = np.trace(between, axis1=1, axis2=2) / np.trace(usual, axis1=1, axis2=2)
    assert ratio[60] > 2.0
    assert np.delete(ratio, 60) == pytest.approx(1.0, abs=0.1)


def test_unconfirmed_frames_keep_their_least_sigma():
    """The fusion makes the incisal point more certain, but not in frames that nothing confirms."""
    take, least_mm = Take(26), np.zeros(FRAMES)
    least_mm[[40, 41]] = 0.5, 2.0
    poses, covariance, between = take.fuse(take.poses, take.covariance, take.between)
    again = replace(take.fuse, least_mm=least_mm)(take.poses, take.covariance, take.between)
    sigma = landmark_sigmas(relative_pose(*again[0].swapaxes(0, 1)), again[2], take.landmarks)[:, 0]
    assert sigma[[40, 41]] == pytest.approx([0.5, 2.0]) and np.delete(sigma, [40, 41]).max() < 0.45
    wider = again[2] / between
    assert np.array_equal(again[0], poses) and again[1] == pytest.approx(covariance * wider[:, None, :1, :1])


def test_poses_that_nothing_confirms_become_uncertain_as_a_whole():
    take = Take(27)
    sure = RegionPose(take.poses[0], np.ones(2, bool), take.covariance[0])
    unsure = sure.unconfirmed(3.0, take.landmarks[0])
    between = relative_covariance(sure.poses[0], *unsure.covariance)
    assert landmark_sigmas(relative_pose(*sure.poses), between, take.landmarks)[0] == pytest.approx(3.0)
    assert unsure.least_mm == 3.0 and np.array_equal(unsure.poses, sure.poses)
    assert np.array_equal(sure.unconfirmed(1e-3, take.landmarks[0]).covariance, sure.covariance)
