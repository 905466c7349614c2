"""Random-subject captures: short takes of random persons with random annotators, and their ground truth.

There are no pictures: masks are rasterised directly, with occlusion by crowns, gum, lips and tongue. A capture takes
seconds.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array
from jawusd.cameras.calibration import save_calibration
from jawusd.formats.atomic import write_bytes_atomic, write_npz_atomic, write_text_atomic
from jawusd.formats.mesh import Mesh, crown_face_mask
from jawusd.geometry import Camera, make_transform, se3_inverse, so3_exp, transform_points
from jawusd.meshes.raster import draw_depth_labels
from jawusd.synthetic.anatomy import Face, palate, tongue
from jawusd.synthetic.dental_arch import DentalArch
from jawusd.synthetic.person import draw_joint
from subjects.annotator import FINER, Annotator, MaskDrawer, draw_annotator, write_mask
from subjects.bite import Bite, build_bite
from subjects.dentition import without_gum
from subjects.scanner import Scanner, draw_scanner, encoded, scanned
from subjects.short_take import TEETH_FROM, Drawn, Motion, ShortPick, draw_cameras, draw_motion, pick_ends, pick_lines
from subjects.traits import Traits, draw_traits

FPS = 24.0
FIRST_FRAME = 12
JAWS = ("upper", "lower")
_GUMS, _SOFT = (40, 80), 90  # labels: teeth 1..14 and 41..54, gums of the arches, soft tissue
_PAD_PX = 24

#: A surface in the world: vertices, and faces with labels.
Surfaces = list[tuple[Array, list[tuple[NDArray[np.int32], int]]]]


@dataclass(frozen=True)
class ShortConfig:
    """Person and size of a take."""

    seed: int
    frames: int = 14
    unpainted: float = 0.0  # probability of scans without vertex colours
    without_picks: float = 0.15  # probability of captures without picks, in which the teeth must be searched
    cameras: int | None = None  # drawn unless given
    size_px: tuple[int, int] | None = None  # of the pictures, drawn unless given


@dataclass(frozen=True, eq=False)
class ShortCapture:
    """All random choices of one capture."""

    config: ShortConfig
    traits: Traits
    bite: Bite
    scanner: Scanner
    annotator: Annotator
    cameras: list[Camera]
    offsets: list[int]  # frame k of a camera shows the instant of frame k + offset of the first one
    delays: Array  # additional delay [frames], shape (C,)
    motion: Motion
    T_scan_bite: Array  # bite frame to the scanner's frame, shape (4, 4)
    scans: tuple[Mesh, Mesh]  # as delivered, in the scanner's frame

    @property
    def arches(self) -> tuple[DentalArch, DentalArch]:
        """Return both arches in the bite frame."""
        return self.bite.upper, self.bite.lower

    @cached_property
    def labels(self) -> list[list[tuple[NDArray[np.int32], int]]]:
        """Return the faces of every tooth and gum with their labels, for both arches."""
        return [_arch_labels(arch, row) for row, arch in enumerate(self.arches)]

    def poses(self, t: float) -> tuple[Array, Array]:
        """Return T_world_upper and T_world_lower (4, 4) of the scans at a time in frames."""
        head, back = self.motion.head(t), se3_inverse(self.T_scan_bite)
        return head @ back, head @ self.motion.jaw(t) @ back


def draw_capture(config: ShortConfig) -> ShortCapture:
    """Draw a random person, scanner, annotator, cameras and take."""
    rng = np.random.default_rng([config.seed, 0x5C09])
    traits = draw_traits(config.seed)
    bite = build_bite(traits)
    scanner = draw_scanner(config.seed, config.unpainted)
    cameras, T_world_bite = draw_cameras(rng, config.cameras, config.size_px)
    joint = draw_joint(np.random.default_rng([config.seed, 0x7A77]))
    motion = draw_motion(joint, bite, T_world_bite, config.frames, rng)
    turn = so3_exp(rng.normal(size=3) * 1.5)
    T_scan_bite = make_transform(turn, rng.uniform(-80.0, 80.0, 3))
    delays = np.zeros(len(cameras))
    if rng.random() < 0.3:
        delays[1:] = rng.uniform(-0.3, 0.3, len(cameras) - 1)
    meshes = [without_gum(arch) if traits.gums == "crowns" else arch.mesh for arch in (bite.upper, bite.lower)]
    scans = [scanned(mesh, scanner, np.random.default_rng([config.seed, 0x5CA3, k])) for k, mesh in enumerate(meshes)]
    placed = [Mesh(transform_points(T_scan_bite, mesh.vertices), mesh.faces, mesh.colors) for mesh in scans]
    return ShortCapture(
        config,
        traits,
        bite,
        scanner,
        draw_annotator(config.seed, len(cameras)),
        cameras,
        [0, *(int(k) for k in rng.integers(-4, 5, len(cameras) - 1))],
        delays,
        motion,
        T_scan_bite,
        (placed[0], placed[1]),
    )


def draw_shot(capture: ShortCapture, draw: int, frames: int, *, fixed_head: bool = False) -> ShortCapture:
    """Draw another take of the person and the scans of a capture, with other cameras, motion and annotator.

    With a fixed head, the head does not move relative to the cameras; everything else is the same.
    """
    own = int(np.random.SeedSequence([capture.config.seed, 0x5407, draw]).generate_state(1)[0])
    config = replace(capture.config, seed=own, frames=frames, without_picks=1.0)
    rng = np.random.default_rng([own, 0x5C09])
    cameras, T_world_bite = draw_cameras(rng, config.cameras, config.size_px)
    count = len(cameras)
    motion = draw_motion(capture.motion.joint, capture.bite, T_world_bite, frames, rng)
    return replace(
        capture,
        config=config,
        annotator=draw_annotator(own, count),
        cameras=cameras,
        offsets=[0] * count,
        delays=np.zeros(count),
        motion=replace(motion, head_rate=0.0) if fixed_head else motion,
    )


def write_short_capture(folder: str | os.PathLike[str], config: ShortConfig) -> ShortCapture:
    """Draw and write a capture; see `write_capture`."""
    capture = draw_capture(config)
    write_capture(folder, capture)
    return capture


def write_capture(folder: str | os.PathLike[str], capture: ShortCapture) -> None:
    """Write a capture folder with scans, masks, calibration, picks, capture.toml and truth.

    Raises:
        OutputError: the folder cannot be written.
        OSError: a mask cannot be written.
    """
    folder = Path(folder)
    suffix = capture.scanner.suffix
    for jaw, mesh in zip(JAWS, capture.scans, strict=True):
        write_bytes_atomic(folder / "scans" / f"{jaw}_teeth{suffix}", encoded(mesh, capture.scanner))
    save_calibration(folder / "calibration.toml", capture.cameras)
    _write_masks(folder, capture)
    write_npz_atomic(folder / "truth" / "truth.npz", _truth(capture))
    write_text_atomic(folder / "capture.toml", _description(capture))


def labelled(capture: ShortCapture, camera: int, t: float, finer: int = 1) -> Drawn:
    """Rasterise the visible labels at a time: labels (rows, columns), first column and row of the part, inverse depth.

    The picture is supersampled by `finer`; the part starts and ends at whole camera pixels.
    """
    given, T_skull = capture.cameras[camera], capture.motion.head(t)
    view = given.scaled((finer * given.size_px[0], finer * given.size_px[1]))
    T_jaw = capture.motion.jaw(t)
    parts = [
        (transform_points(T_skull, capture.bite.upper.mesh.vertices), capture.labels[0]),
        (transform_points(T_skull @ T_jaw, capture.bite.lower.mesh.vertices), capture.labels[1]),
        *_soft_parts(capture, T_skull, T_jaw, t),
    ]
    drawn = []
    for points, surfaces in parts:
        projected = np.column_stack([view.project(points), view.depth(points)])
        drawn.append((np.ascontiguousarray(projected, np.float32), surfaces))
    crowns = [pixels[arch.tooth != 0, :2] for (pixels, _), arch in zip(drawn, capture.arches)]
    size, teeth = np.array(given.size_px), np.concatenate(crowns) / finer
    low = finer * np.clip(np.floor(teeth.min(0)) - _PAD_PX, 0, size - 8).astype(int)
    high = finer * np.clip(np.ceil(teeth.max(0)) + _PAD_PX, low // finer + 8, size).astype(int)
    shape = (int(high[1] - low[1]), int(high[0] - low[0]))
    labels, depth = np.zeros(shape, np.uint8), np.zeros(shape, np.float32)
    for pixels, surfaces in drawn:
        for faces, label in surfaces:
            draw_depth_labels(pixels, faces, int(low[0]), int(low[1]), False, depth, labels, label)
    return labels, (int(low[0]), int(low[1])), depth


def _arch_labels(arch: DentalArch, row: int) -> list[tuple[NDArray[np.int32], int]]:
    """Return the faces of the teeth and of the gum of an arch with their labels."""
    faces = arch.mesh.faces
    crown = crown_face_mask(arch.mesh)
    tooth = np.asarray(arch.tooth[faces], int)
    own = np.where(tooth[:, 0] != 0, tooth[:, 0], tooth[:, 1])
    number = np.where(own > 0, own, 7 - own)  # left 1..7, right 8..14
    parts = [(np.ascontiguousarray(faces[crown & (number == k)]), k - 1 + TEETH_FROM[row]) for k in range(1, 15)]
    return [*(part for part in parts if len(part[0])), (np.ascontiguousarray(faces[~crown]), _GUMS[row])]


def _soft_parts(capture: ShortCapture, T_skull: Array, T_jaw: Array, t: float) -> Surfaces:
    """Return palate, tongue and, unless retracted, lips."""
    motion = capture.motion
    roof, now = palate(), motion.controls[int(np.clip(round(t), 0, len(motion.controls) - 1))]
    blob = tongue(*(motion.tongue_mm * np.clip((now[0] - 0.1) / 0.15, 0.0, 1.0)).tolist())
    incisor = capture.bite.incisor
    set_back = np.array([0.0, incisor[1] - 1.6, min(incisor[2] + 2.9, 0.0)])
    parts = [
        (transform_points(T_skull, roof.vertices + [0.0, 2.0, 0.0]), roof.faces),
        (transform_points(T_skull @ T_jaw, blob.vertices + set_back - [0.0, 2.0, 2.0]), blob.faces),
    ]
    if motion.lips is not None:
        face = Face(incisor)
        parts.append((transform_points(T_skull, face.posed(motion.lips, T_jaw)), face.faces))
    return [(points, [(np.ascontiguousarray(faces), _SOFT)]) for points, faces in parts]


def _write_masks(folder: Path, capture: ShortCapture) -> None:
    config, who = capture.config, capture.annotator
    for c, camera in enumerate(capture.cameras):
        rngs = [np.random.default_rng([config.seed, 0xA5C, c, row]) for row in (0, 1)]
        hands = [MaskDrawer(who, row, c, camera.size_px, rngs[row]) for row in (0, 1)]
        for jaw in JAWS:
            (folder / "masks" / camera.name / jaw).mkdir(parents=True, exist_ok=True)
        for k in range(config.frames):
            t = k + float(capture.delays[c])
            labels, window, _ = labelled(capture, c, t, FINER)
            centre = transform_points(capture.motion.head(t), np.array([[0.0, -4.0, -10.0]]))
            px_per_mm = float(FINER * camera.K[0, 0] / camera.depth(centre)[0])
            own = FIRST_FRAME + k - capture.offsets[c]
            for row, jaw in enumerate(JAWS):
                first = TEETH_FROM[row]
                teeth = np.where((labels >= first) & (labels < first + 14), labels - first + 1, 0).astype(np.uint8)
                mask = hands[row].draw(teeth, labels == _GUMS[row], window, px_per_mm)
                if mask is not None:
                    write_mask(str(folder / "masks" / camera.name / jaw / f"{own:06d}.png"), mask)


def _truth(capture: ShortCapture) -> dict[str, ArrayLike]:
    config, cameras = capture.config, capture.cameras
    poses = [capture.poses(float(k)) for k in range(config.frames)]
    upper, lower = np.stack([p[0] for p in poses]), np.stack([p[1] for p in poses])
    traits, who, bite = capture.traits, capture.annotator, capture.bite
    groups = {
        "bite": traits.bite,
        "gums": traits.gums,
        "cameras": str(len(cameras)),
        "annotator": who.kind,
        "height": f"{cameras[0].size_px[1]}",
        "lips": "retracted" if capture.motion.lips is None else "lips",
        "paint": capture.scanner.paint,
        "scan": "coarse" if capture.scanner.faces < 10_000 else "fine",
    }
    return {
        "frames": FIRST_FRAME + np.arange(config.frames),
        "T_world_upper": upper,
        "T_world_lower": lower,
        "T_upper_lower": se3_inverse(upper) @ lower,
        "T_bite_scan": se3_inverse(capture.T_scan_bite),
        "camera_names": np.array([camera.name for camera in cameras]),
        "offsets": np.array(capture.offsets),
        "delays": capture.delays,
        "K": np.stack([camera.K for camera in cameras]),
        "dist": np.stack([camera.distortion for camera in cameras]),
        "R": np.stack([camera.T_cam_world[:3, :3] for camera in cameras]),
        "t": np.stack([camera.T_cam_world[:3, 3] for camera in cameras]),
        "rest_frame": np.array(FIRST_FRAME + 1),
        "overbite_mm": np.array(bite.overbite_mm),
        "overjet_mm": np.array(bite.overjet_mm),
        "gum_mm": who.gum_mm,
        "gum_tooth_mm": who.gum_tooth_mm,
        "edge_px": np.array(who.edge_px),
        "camera_px": who.camera_px,
        "wobble_px": np.array(who.wobble_px),
        "cell_px": np.array(who.cell_px),
        "groups": np.array(json.dumps(groups)),
    }


def _description(capture: ShortCapture) -> str:
    config, suffix = capture.config, capture.scanner.suffix
    rng = np.random.default_rng([config.seed, 0x91C])
    picks: list[list[ShortPick]] = []
    if rng.random() >= config.without_picks:
        seen = [labelled(capture, c, float(capture.delays[c])) for c in range(len(capture.cameras))]
        shown = (se3_inverse(capture.T_scan_bite), capture.cameras, seen, rng)
        both = zip(capture.scans, (0, 1), capture.poses(0.0), strict=True)
        picks = [pick_ends(mesh, row, pose, *shown) for mesh, row, pose in both]
    lines = [
        'format = "jawusd-capture/1"', f'name = "person_{config.seed}"', 'units = "mm"', f"fps = {FPS}",
        'calibration = "calibration.toml"', f"frames = [{FIRST_FRAME}, {FIRST_FRAME + config.frames}]", "",
        "[scans]", *(f'{jaw}_teeth = "scans/{jaw}_teeth{suffix}"' for jaw in JAWS), "",
    ]  # fmt: skip
    for camera in capture.cameras:
        lines += ["[[camera]]", f'name = "{camera.name}"']
        lines += [f'masks.{jaw} = "masks/{camera.name}/{jaw}/%06d.png"' for jaw in JAWS] + [""]
    names = [camera.name for camera in capture.cameras]
    offsets = ", ".join(f"{name} = {offset}" for name, offset in zip(names, capture.offsets, strict=True))
    lines += ["[sync]", 'method = "offsets"', f'reference = "{names[0]}"', f"offsets = {{ {offsets} }}", ""]
    if picks and all(picks):
        lines += ["[bootstrap]", f"frame = {FIRST_FRAME}", ""]
        for jaw, own in zip(JAWS, picks, strict=True):
            lines += [line for pick in own for line in pick_lines(jaw, pick)]
    if rng.random() < 0.6:
        lines += ["[motion]", f"rest_frame = {FIRST_FRAME + 1}", ""]
    return "\n".join(lines)
