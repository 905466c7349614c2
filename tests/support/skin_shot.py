"""Shots of the synthetic studio whose skin slides and lags over the bone, with lips that stay closed for seconds."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from lips_take import ROWS, closed_lips, described
from subjects.scanner import Scanner, encoded

from jawusd.cameras.calibration import save_calibration
from jawusd.formats.atomic import write_bytes_atomic, write_npz_atomic, write_text_atomic
from jawusd.geometry import LANDMARKS
from jawusd.media.writers import VideoWriter
from jawusd.synthetic.anatomy import Face, build_anatomy, opened_bite
from jawusd.synthetic.exercises import smooth_noise, smoothed
from jawusd.synthetic.kinematics import smoothstep
from jawusd.synthetic.person import Person
from jawusd.synthetic.render import Renderer
from jawusd.synthetic.take import FPS, Scene, build_cameras, perform

_NOISE = 1.3  # of the sensor [grey levels of 255]
_RAMP = 6  # frames in which lips close or part
#: Centres of expressions in the plane of the lips [mm] and their sizes [mm]: mentalis, depressor, side, smile.
_CENTRES, _SIZES = [[0, -42], [16, -34], [-14, -30], [-34, -12]], [3.0, 2.0, 2.0, 2.0]
_LEAST_OPENING, _CLOSED_RANGE = 0.18, np.array([0.4, 0.6, 0.6])


def slides(face, lips, T_jaw, rng):
    """Return displacements of the face's vertices (I, V, 3) [mm] from where blend skinning puts them.

    Skin follows three quarters of the bone's motion at the chin and all of it at the lips, late. It moves with
    expressions, and with the shape of the lips only up to 15 mm around them.
    """
    count = len(lips)
    rest = np.stack([face.rest(one).reshape(-1, 3) for one in lips])
    moved = np.stack([face.posed(one, T) for one, T in zip(lips, T_jaw)]) - rest
    row = np.repeat(np.arange(face.rows), len(rest[0]) // face.rows)
    away = smoothstep((row - face.rows + 32) / 10.0)[:, None]  # 0 on the lips, 1 on the skin
    at = rest[0, :, :2]
    wave = np.sin(at @ rng.normal(0, 0.05, (2, 3)) + rng.uniform(0, 6, 3)).sum(1)[:, None]
    follow = 1 - away * (0.25 + 0.04 * wave)
    keep = np.exp(-1 / (FPS * (0.008 + away * (0.015 + 0.004 * wave))))
    of_lips = (1 - smoothstep((row - face.rows + 31) / 14.0)[:, None]) * (rest - rest.mean(0))
    late = moved.copy()
    for i in range(1, count):
        late[i] = keep * late[i - 1] + (1 - keep) * moved[i]
    found = follow * late * (1 - np.linalg.norm(late, axis=2, keepdims=True) / 300)
    show = 0.5 * np.abs(smooth_noise(rng, count, 8.0, len(_SIZES)))
    for k, (centre, size) in enumerate(zip(_CENTRES, _SIZES)):
        near = away * np.exp(-(((at - centre) / 15.0) ** 2).sum(1))[:, None]
        way = rng.normal(size=3) * [1, 1, 0.5]
        found = found + size * show[:, k, None, None] * near * way / np.linalg.norm(way)
        found = found + 0.12 * rng.normal() * show[:, k, None, None] * near * late  # it changes how skin follows
    return found - moved + of_lips - (rest - rest.mean(0))


def closed_share(frames, closings, first=0):
    """Return how far the lips are closed in every frame, 0 .. 1, shape (F,), by ranges of frames after a first one."""
    share, t = np.zeros(frames), np.arange(frames) - first
    for a, b in closings:
        share = np.maximum(share, smoothstep((t - a + _RAMP) / _RAMP) * smoothstep((b + _RAMP - t) / _RAMP))
    return share


def closed_take(person, occlusion, frames, closings, seed):
    """Return a take in which the lips are closed in ranges of its frames, over a jaw that moves less there."""
    rng = np.random.default_rng([seed, 0x5CE])
    take = perform(person, occlusion, frames, (0, 0, 0), seed)
    first = take.tracked[0] - take.first_instant
    t = np.arange(len(take.phase)) - first
    share = closed_share(len(t), closings, first)
    calm = smoothed(share[:, None])
    controls = take.controls * (1 - calm * (1 - _CLOSED_RANGE))
    parted = np.clip(1 - calm[:, 0], 0, 1) * _LEAST_OPENING  # teeth are in sight
    controls[:, 0] = np.maximum(controls[:, 0], np.where(t > 40, parted, 0))
    extra = smooth_noise(rng, len(t), 8.0, 3) * [person.noise.side_mm, person.noise.lift_mm, person.noise.lift_mm]
    controls = opened_bite(person, occlusion, person.limit(controls), extra)
    take = replace(take, controls=controls, T_skull_mandible=person.pose_with_extra(controls, extra))
    return closed_lips(take, person.joint.incisor, share, rng), first, share


def write_skin_shot(folder, seed, frames=260, size_px=(480, 360), closings=((110, 150), (195, 235)), freckles=0.4):
    """Write capture.toml, scans, calibration, videos, and truth/truth.npz; the bite is that of the person's rig."""
    folder, rng = Path(folder), np.random.default_rng([seed, 0x5C12])
    person, cameras = Person(seed), build_cameras(size_px)
    with Renderer(cameras) as renderer:
        anatomy = build_anatomy(person)
        take, first, share = closed_take(person, anatomy.occlusion, frames, closings, seed)
        slide_mm = slides(Face(person.joint.incisor), take.lips, take.T_skull_mandible, rng)
        scene = Scene(person, anatomy, renderer, freckles)
        rows = np.arange(first, first + frames)
        in_sight = np.zeros((frames, 2))
        with contextlib.ExitStack() as stack:
            videos = [
                stack.enter_context(VideoWriter(folder / "video" / f"{c.name}.mp4", size_px, FPS, quality_crf=20))
                for c in cameras
            ]
            for f, row in enumerate(rows):
                poses = scene.pose(take, row, slide_mm[row])
                for c in range(len(cameras)):
                    picture = scene.draw(c, take, row, poses, None)
                    noisy = picture.color + rng.normal(0.0, _NOISE, picture.color.shape)
                    videos[c].write(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
                    in_sight[f] += [(mask > 127).sum() for mask in (picture.upper, picture.lower)]
    scanner = Scanner("ply", "painted", 0, 0.0, False)
    for name, arch in zip(ROWS, (anatomy.upper, anatomy.lower)):
        write_bytes_atomic(folder / "scans" / f"{name}_teeth.ply", encoded(arch.mesh, scanner))
    save_calibration(folder / "calibration.toml", cameras)
    head = take.T_world_skull[rows]
    truth = {
        "frames": np.arange(frames), "T_world_upper": head, "T_upper_lower": take.T_skull_mandible[rows],
        "in_sight_px": in_sight, "closed": share[rows],
        "landmark_names": np.array(LANDMARKS), "landmarks": person.landmarks,
    }  # fmt: skip
    write_npz_atomic(folder / "truth" / "truth.npz", truth)
    write_text_atomic(folder / "capture.toml", described(f"skin_{seed}", FPS, frames, cameras))
    return folder / "capture.toml"
