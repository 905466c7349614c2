"""Face captures of synthetic persons, made from where the chin is and not from any jaw parameters."""

import numpy as np

from jawusd.evaluator import JawRig
from jawusd.fitting import FittingConfig, fit_model
from jawusd.formats.arkit import JAW_COLUMNS
from jawusd.formats.face_table import FaceTable
from jawusd.geometry import make_transform, transform_points
from jawusd.synthetic.exercises import record, smooth_noise
from jawusd.synthetic.person import Person

JAW_FPS, FACE_FPS = 24, 60
CHIN_MM = [0.0, -32.0, -4.0]  # of the incisal point, x left, y up, z anterior


class Face:
    """How an app sees one person: gains, cross-talk, resting weights and dead zones drawn from a seed."""

    def __init__(self, seed):
        rng = np.random.default_rng([seed, 0xFACE])
        self.rng = rng
        self.size_mm = np.array([45.0, 12.0, 9.0]) * rng.normal(1.0, 0.15, 3)  # chin down, aside, forward for weight 1
        self.cross = rng.normal(0.0, 0.12, (3, 3)) * (1 - np.eye(3))
        self.sides = rng.uniform(0.8, 1.25, 2)  # gains of left and right
        self.resting = rng.uniform(0.0, 0.06, 4)
        self.dead = rng.uniform(0.0, 0.05, 4)
        # opening turns the chin back; the app knows how far that is in the mean of people
        self.back = 0.55 + 0.08 * rng.normal()

    def weights(self, chin_mm, noise=0.015):
        """Return open, left, right, forward (F, 4) of chin displacements (F, 3) from the closed bite."""
        aside, up, forward = chin_mm.T
        seen = np.stack([-up, aside, forward - self.back * up], axis=1) / self.size_mm
        seen = seen + seen @ self.cross.T
        opening, side, forward = seen.T
        raw = np.stack([opening, self.sides[0] * side, -self.sides[1] * side, forward], axis=1)
        raw = np.maximum(raw - self.dead, 0.0) + self.resting
        raw = raw + noise * smooth_noise(self.rng, len(raw), 20.0, 4) + 0.005 * self.rng.normal(size=raw.shape)
        return np.clip(raw, 0.0, 1.0)


class Performer:
    """A synthetic person with a fitted rig, who is captured by jaw and face at once."""

    def __init__(self, seed):
        self.person, self.face = Person(seed), Face(seed)
        poses = record(self.person, 833, 1).T_noisy
        landmarks = self.person.landmarks
        model = fit_model(
            (np.arange(len(poses)), poses),
            T_anatomical_skull=make_transform(np.eye(3), -landmarks[0]),
            landmarks=landmarks,
            mandible_vertices=self.person.mandible_points,
            config=FittingConfig(holdout_folds=0),
        )
        self.rig = JawRig(model.arrays, model.meta)

    def perform(self, kind, frames=833, seed=1, noise=0.015):
        """Return the face capture at 60 fps, and true and measured poses at 24, of one performance."""
        take = record(self.person, frames, seed, kind)
        incisor = self.person.landmarks[0]
        chin = transform_points(take.T_true, (incisor + CHIN_MM)[None])[:, 0]
        rest = transform_points(self.person.pose(0, 0, 0), (incisor + CHIN_MM)[None])[0]
        at = np.arange(int((frames - 1) / JAW_FPS * FACE_FPS) + 1) / FACE_FPS
        moved = np.stack([np.interp(at, np.arange(frames) / JAW_FPS, x) for x in (chin - rest).T], axis=1)
        weights = self.face.weights(moved, noise)
        face = FaceTable(at * FACE_FPS, weights, JAW_COLUMNS, float(FACE_FPS))
        return face, take.T_true, take.T_noisy

    def incisal_error(self, d, times, T_true):
        """Return the mean distance [mm] of the incisal point, d (F, 3) at times [s] against true poses at 24 fps."""
        at = np.round(np.arange(len(T_true)) / JAW_FPS * FACE_FPS, 9)
        own = np.stack([np.interp(at, times * FACE_FPS, x) for x in self.rig.project(d).T], axis=1)
        incisor = self.person.landmarks[:1]
        apart = transform_points(self.rig.pose(own), incisor) - transform_points(T_true, incisor)
        return float(np.linalg.norm(apart, axis=-1).mean())
