"""Skin of synthetic persons: points of the lower face that follow the jaw, expressions and head stabilisation."""

import numpy as np
from face_takes import JAW_FPS, Performer

from jawusd.geometry import so3_exp, transform_points
from jawusd.synthetic.exercises import record, schedule, smooth_noise

POINTS, EXPRESSIONS = 40, 8
#: Centre of each expression [mm] from the incisal point, and its size [mm]: mentalis, pucker, smile, press, depressor,
#: side, puff, and the stretch of closed lips over an open jaw.
_CENTRES = [[0, -28, 6], [0, -8, 8], [-18, -8, 2], [0, -6, 6], [14, -20, 2], [-10, -16, 4], [20, -14, 0], [0, -14, 6]]
_SIZES = [4, 4, 4, 3, 3, 2, 2, 3]
_PRESS, _STRETCH = 3, 7
_SEEN_MM = 3.5  # opening from which parted lips show the lower teeth


class Skin:
    """The skin of one person; its motion is not of the form that any fit assumes."""

    def __init__(self, seed):
        self.performer = Performer(seed)
        self.person, self.rig = self.performer.person, self.performer.rig
        rng = np.random.default_rng([seed, 0x5C1])
        incisor = self.person.landmarks[0]
        across, down = rng.uniform(-1, 1, (2, POINTS))
        patch = np.stack([28 * across, -22 + 20 * down - 6 * across**2, 6 - 9 * across**2], 1)
        patch[:3] = [[0, -34, 4], [-10, -32, 1], [10, -32, 1]]
        self.rest = incisor + patch
        chin = np.exp(-(((patch - [0, -32, 3]) / [26, 22, 18]) ** 2).sum(1))
        self.follow = (0.15 + 0.75 * chin) * (1 + rng.normal(0, 0.05, POINTS))  # fraction of the bone's motion
        self.lag_s = rng.uniform(0.005, 0.025, POINTS)
        self.cross = rng.normal(0, 0.12, (EXPRESSIONS, POINTS, 1))  # expressions change how the skin follows
        self.modes = np.empty((EXPRESSIONS, POINTS, 3))
        for k in range(EXPRESSIONS):
            near = np.exp(-(((patch - _CENTRES[k]) / [14, 12, 14]) ** 2).sum(1))[:, None]
            way = rng.normal(size=3)
            way = np.array([0, 1, 0.2]) if k == _STRETCH else way / np.linalg.norm(way)
            self.modes[k] = near * (way + 0.3 * rng.normal(size=(POINTS, 3))) * _SIZES[k]

    def points(self, T_true, rng, closed, noise_mm=0.3, head=(0.0, 0.0), away=(), strong=()):
        """Return skin points (F, 40, 3) in the skull frame as a tracker sees them.

        `head` is the error of stabilisation [mm, degrees]; expressions in `away` are not shown, those in `strong` are
        three times as large.
        """
        count = len(T_true)
        moved = transform_points(T_true, self.rest) - transform_points(self.person.pose(0, 0, 0), self.rest)
        late = np.empty_like(moved)
        late[0] = moved[0]
        keep = np.exp(-1 / (JAW_FPS * self.lag_s))[:, None]
        for i in range(1, count):
            late[i] = keep * late[i - 1] + (1 - keep) * moved[i]
        show = 0.5 * np.abs(smooth_noise(rng, count, 8.0, EXPRESSIONS))
        show[:, [_STRETCH, *away]] = 0.0
        show[:, list(strong)] *= 3.0
        show[:, _PRESS] += 0.8 * closed
        opening = -(moved @ [0, 1, 0])[:, 0]
        show[:, _STRETCH] += 0.08 * closed * np.clip(opening, 0, 12)
        size = np.linalg.norm(late, axis=2, keepdims=True)
        found = self.rest + self.follow[:, None] * late * (1 - size / 250)
        found = found + np.einsum("fk,kpj->fpj", show, self.modes)
        found = found + np.einsum("fk,kpj,fpj->fpj", show, self.cross, late)
        found = found + 0.2 * rng.normal(size=(POINTS, 3)) * np.linspace(-1, 1, count)[:, None, None]  # drift
        centre = self.person.landmarks.mean(0)
        turn = so3_exp(np.deg2rad(head[1]) / np.sqrt(3) * smooth_noise(rng, count, 24.0, 3))
        found = np.einsum("fij,fpj->fpi", turn, found - centre) + centre
        found = found + head[0] / np.sqrt(3) * smooth_noise(rng, count, 24.0, 3)[:, None]
        return found + noise_mm * rng.normal(size=found.shape)

    def calibration(self, seed=1, **options):
        """Return points (F, 40, 3), measured d (F, 3) and where the teeth are seen, of exercises, speech and a bite."""
        rng = np.random.default_rng([seed, 0xCA1])
        exercises = record(self.person, 1440, seed)
        T = np.concatenate([exercises.T_true, self.speech(720, rng), np.repeat(self.person.pose(0, 0, 0)[None], 60, 0)])
        closed = np.arange(len(T)) >= len(T) - 60
        d = self.rig.encode(T).d
        seen = (d[:, 0] > _SEEN_MM) | closed
        points = self.points(T, rng, closed.astype(float), **options)
        return points, np.where(seen[:, None], d + 0.15 * rng.normal(size=d.shape), np.nan), seen

    def closed_speech(self, frames=1440, seed=2, **options):
        """Return points (F, 40, 3) and true poses (F, 4, 4) of speech behind closed lips."""
        rng = np.random.default_rng([seed, 0x5BE])
        T = self.speech(frames, rng)
        return self.points(T, rng, np.ones(frames), **options), T

    def open_speech(self, frames=480, seed=3, **options):
        """Return points (F, 40, 3) and true poses (F, 4, 4) of the frames of other speech in which teeth are seen."""
        rng = np.random.default_rng([seed, 0x09E])
        T = self.speech(frames, rng)
        seen = self.rig.encode(T).d[:, 0] > _SEEN_MM
        return self.points(T, rng, np.zeros(frames), **options)[seen], T[seen]

    def speech(self, frames, rng):
        """Return poses (F, 4, 4) of speech, with movements outside the three parameters."""
        controls = self.person.limit(schedule(("speech",), frames, rng)[0])
        noise = self.person.noise
        extra = smooth_noise(rng, frames, 8.0, 3) * [noise.side_mm, noise.lift_mm, noise.lift_mm]
        return self.person.pose_with_extra(controls, extra)

    def errors_mm(self, d, T_true):
        """Return the distances [mm] of the rig's landmarks between d (F, 3) and true poses, shape (F, 5)."""
        apart = transform_points(self.rig.pose(d), self.rig.landmarks) - transform_points(T_true, self.rig.landmarks)
        return np.linalg.norm(apart, axis=-1)
