"""Takes of the synthetic studio with their truth and without masks: lips that close over the teeth, or many looks."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from looks import TintedRenderer, draw_look, plain_look
from subjects.scanner import Scanner, encoded

from jawusd.cameras.calibration import save_calibration
from jawusd.formats.atomic import write_bytes_atomic, write_npz_atomic, write_text_atomic
from jawusd.geometry import LANDMARKS, transform_point, transform_points
from jawusd.media.writers import VideoWriter
from jawusd.meshes.raster import draw_depth_labels
from jawusd.synthetic.anatomy import build_anatomy
from jawusd.synthetic.annotations import choose_picks
from jawusd.synthetic.kinematics import smoothstep
from jawusd.synthetic.person import Person
from jawusd.synthetic.take import FPS, Scene, perform

ROWS = ("upper", "lower")
EVERY = 28  # frames from one closing to the next
_SHARE_STEP = 4  # pixels of a picture per pixel in which what is in sight is counted
_OPEN_MM = 3.0  # how much wider than at its narrowest the jaw may be open where lips close


def closing(frames, rng, opening_mm):
    """Return how far the lips are closed in every frame, 0 .. 1, shape (F,), and first and last frame of closings.

    Lips do not close over a jaw that is wide open: of every stretch of frames, the narrowest one is chosen.
    """
    share, spans = np.zeros(frames), []
    for first in range(12, frames - 22, EVERY):
        down, shut, up = rng.integers(3, 8), rng.integers(3, 9), rng.integers(3, 8)
        middles = np.arange(first + down + shut // 2, min(first + EVERY, frames - up - shut) - 6)
        wide = opening_mm[middles]
        middle = rng.choice(middles[wide < wide.min() + _OPEN_MM])
        a, b = middle - shut // 2, middle - shut // 2 + shut
        t = np.arange(frames)
        share = np.maximum(share, smoothstep((t - a + down) / down) * smoothstep((b + up - t) / up))
        spans.append((int(a - down), int(b + up)))
    return share, spans


def closed_lips(take, incisor, share, rng):
    """Return the take with lips closed by a share (I,), 0 .. 1, where it is not 0."""
    lips = list(take.lips)
    for k in np.flatnonzero(share):
        T = take.T_skull_mandible[k]
        low = transform_point(T, incisor)[1]
        meet = min(-0.8, 0.5 * low - 1.5)  # height of the line of the lips
        shut = replace(
            lips[k],
            upper_mm=meet - 0.3,
            lower_mm=incisor[1] - (meet + 0.3 + incisor[1] - low),
            width_mm=lips[k].width_mm - 1.5,
        )
        mixed = {
            name: (1 - share[k]) * getattr(lips[k], name) + share[k] * getattr(shut, name)
            for name in ("upper_mm", "lower_mm", "width_mm")
        }
        lips[k] = replace(lips[k], **mixed)
    return replace(take, lips=lips)


def write_lips_capture(folder, seed, frames=100, size_px=(640, 360)):
    """Write a take in which the lips close over the teeth, with picks; see `write_take`."""
    return write_take(Path(folder), f"lips_{seed}", seed, frames, plain_look(size_px), True)


def write_look_capture(folder, seed, frames, every):
    """Write a take of a drawn look without picks, with one of every `every` frames; see `write_take`."""
    return write_take(Path(folder), f"look_{seed}", seed, frames, draw_look(seed), False, every)


def write_take(folder, name, seed, frames, look, lips_close, every=1):
    """Write capture.toml, scans, calibration, videos, and truth/truth.npz with what is in sight of both arches.

    Picks are written if the lips close. Only every so many of the frames are written.
    """
    rng, person, cameras = np.random.default_rng([seed, 0x11B5]), Person(seed), look.cameras
    with TintedRenderer(look) as renderer:
        anatomy = build_anatomy(person)
        take = perform(person, anatomy.occlusion, frames, (0,) * len(cameras), seed)
        first = take.tracked[0] - take.first_instant
        rows = np.arange(first, first + frames, every)
        incisor = person.joint.incisor
        opening = incisor[1] - transform_points(take.T_skull_mandible[rows], incisor[None])[:, 0, 1]
        share, spans = np.zeros(len(take.phase)), np.zeros((0, 2), int)
        if lips_close:
            share[rows], spans = closing(frames, rng, opening)
            take = closed_lips(take, incisor, share, rng)
        scene = Scene(person, anatomy, renderer)
        head = take.T_world_skull[rows]
        jaw = head @ take.T_skull_mandible[rows]
        arches, picks = (anatomy.upper, anatomy.lower), None
        if lips_close:
            things = scene.occluders(take, first)
            picks = [choose_picks(arch, T, cameras, things, 4, 1.0, rng) for arch, T in zip(arches, (head[0], jaw[0]))]
        in_sight = np.zeros((len(rows), 2, len(cameras)))
        sizes_px = [camera.size_px[:: -1 if turns % 2 else 1] for camera, turns in zip(cameras, look.turns)]
        with contextlib.ExitStack() as stack:
            videos = [
                stack.enter_context(VideoWriter(folder / "video" / f"{c.name}.mp4", size, FPS / every, quality_crf=20))
                for c, size in zip(cameras, sizes_px)
            ]
            for f, row in enumerate(rows):
                poses = scene.pose(take, row)
                for c, camera in enumerate(cameras):
                    picture = scene.draw(c, take, row, poses, None)
                    developed = np.rot90(look.developed(picture.color, rng), look.turns[c])
                    videos[c].write(np.ascontiguousarray(developed))
                    seen = [int((mask > 127).sum()) for mask in (picture.upper, picture.lower)]
                    in_sight[f, :, c] = seen / np.maximum(_bare_px(arches, (head[f], jaw[f]), camera), 1.0)
    scanner = Scanner("ply", "painted", 0, 0.0, False)
    for row, arch in zip(ROWS, arches):
        write_bytes_atomic(folder / "scans" / f"{row}_teeth.ply", encoded(arch.mesh, scanner))
    save_calibration(folder / "calibration.toml", look.placed())
    truth = {
        "frames": np.arange(len(rows)), "T_world_upper": head, "T_world_lower": jaw, "in_sight": in_sight,
        "T_upper_lower": take.T_skull_mandible[rows], "closings": np.array(spans), "closed": share[rows],
        "landmark_names": np.array(LANDMARKS), "landmarks": person.landmarks,
    }  # fmt: skip
    write_npz_atomic(folder / "truth" / "truth.npz", truth)
    write_text_atomic(folder / "capture.toml", described(name, FPS / every, len(rows), cameras, picks))
    return folder / "capture.toml"


def _bare_px(arches, poses, camera):
    """Return how many pixels the crowns of both arches cover, one before the other, without lips, shape (2,)."""
    size = np.array(camera.size_px) // _SHARE_STEP
    depth, labels = np.zeros(size[::-1], np.float32), np.zeros(size[::-1], np.uint8)
    for k, (arch, pose) in enumerate(zip(arches, poses)):
        points = transform_points(pose, arch.mesh.vertices)
        flat = np.column_stack([camera.project(points) / _SHARE_STEP, camera.depth(points)]).astype(np.float32)
        crown = np.ascontiguousarray(arch.mesh.faces[(arch.tooth[arch.mesh.faces] != 0).all(1)])
        draw_depth_labels(flat, crown, 0, 0, False, depth, labels, k + 1)
    return _SHARE_STEP**2 * np.array([(labels == 1).sum(), (labels == 2).sum()], float)


def described(name, fps, frames, cameras, picks=None):
    """Return the capture.toml of synchronous videos without masks; picks of both arches are in frame 0."""
    lines = [
        'format = "jawusd-capture/1"', f'name = "{name}"', 'units = "mm"', f"fps = {fps}",
        'calibration = "calibration.toml"', f"frames = [0, {frames}]", "",
        "[scans]", *(f'{jaw}_teeth = "scans/{jaw}_teeth.ply"' for jaw in ROWS), "",
    ]  # fmt: skip
    for camera in cameras:
        lines += ["[[camera]]", f'name = "{camera.name}"', f'video = "video/{camera.name}.mp4"', ""]
    offsets = ", ".join(f"{camera.name} = 0" for camera in cameras)
    lines += ["[sync]", 'method = "offsets"', 'reference = "cam0"', f"offsets = {{ {offsets} }}", ""]
    if picks is not None:
        lines += ["[bootstrap]", "frame = 0", ""]
    for jaw, own in zip(ROWS, picks or ((), ())):
        for pick in own:
            views = ", ".join(f'{{ camera = "{v.camera}", x = {v.x:.2f}, y = {v.y:.2f} }}' for v in pick.views)
            lines += [f"[[bootstrap.{jaw}]]", f"vertex = {pick.vertex}", f"views = [{views}]", ""]
    return "\n".join(lines)
