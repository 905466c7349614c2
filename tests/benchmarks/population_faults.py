"""Faults planted into captures of synthetic persons, and whether what is said of them names the right cause.

Every fault changes files of a capture folder in place. `cause` is a pattern that a right message, or the kind of a
finding, contains.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from subjects.scanner import Scanner, encoded

from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.formats.mesh import Mesh
from jawusd.geometry import make_transform, se3_inverse, so3_exp, transform_points
from jawusd.media.writers import VideoWriter
from jawusd.meshes.meshio import load_mesh

ROWS = ("upper", "lower")


class NotPossible(Exception):
    """The fault cannot be planted into this capture."""


@dataclass(frozen=True)
class Fault:
    """One kind of mistake."""

    name: str
    plant: Callable[[Path, np.random.Generator], None]
    cause: str  # pattern, case ignored


def _scan(folder: Path, row: str) -> Path:
    return next((folder / "scans").glob(f"{row}_teeth.*"))


def _rewrite(folder: Path, row: str, change: Callable[[Mesh], Mesh]) -> None:
    path = _scan(folder, row)
    mesh = change(load_mesh(path))
    path.write_bytes(encoded(mesh, Scanner(path.suffix[1:], "painted", 0, 0.0, False)))


def _moved(T: np.ndarray) -> Callable[[Mesh], Mesh]:
    return lambda mesh: Mesh(transform_points(T, mesh.vertices), mesh.faces, mesh.colors)


def _bite_frame(folder: Path) -> np.ndarray:
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as truth:
        return truth["T_bite_scan"]


def _in_bite(folder: Path, T: np.ndarray) -> np.ndarray:
    """Return a motion in the frame of the bite as one in the frame of the scans."""
    B = _bite_frame(folder)
    return se3_inverse(B) @ T @ B


def _wrong_bite(move_mm: float, turn_deg: float) -> Callable[[Path, np.random.Generator], None]:
    def plant(folder: Path, rng: np.random.Generator) -> None:
        direction, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        R = so3_exp(np.deg2rad(turn_deg) * axis)
        centre = np.array([0.0, 0.0, -20.0])
        T = make_transform(R, centre + move_mm * direction - R @ centre)
        _rewrite(folder, "lower", _moved(_in_bite(folder, T)))

    return plant


def _upside_down(folder: Path, rng: np.random.Generator) -> None:
    R = np.diag([-1.0, -1.0, 1.0])
    _rewrite(folder, "lower", _moved(_in_bite(folder, make_transform(R, np.zeros(3)))))


def _own_frame(folder: Path, rng: np.random.Generator) -> None:
    _rewrite(folder, "lower", _moved(make_transform(so3_exp(rng.normal(size=3)), rng.uniform(-60, 60, 3))))


def _scaled(factor: float, rows: tuple[str, ...] = ROWS) -> Callable[[Path, np.random.Generator], None]:
    def plant(folder: Path, rng: np.random.Generator) -> None:
        for row in rows:
            _rewrite(folder, row, lambda mesh: Mesh(factor * mesh.vertices, mesh.faces, mesh.colors))

    return plant


def _mirrored(folder: Path, rng: np.random.Generator) -> None:
    for row in ROWS:
        _rewrite(folder, row, lambda mesh: Mesh(mesh.vertices * [-1, 1, 1], mesh.faces[:, ::-1], mesh.colors))


def _scans_exchanged(folder: Path, rng: np.random.Generator) -> None:
    text = (folder / "capture.toml").read_text()
    upper, lower = (f"scans/{_scan(folder, row).name}" for row in ROWS)
    text = text.replace(upper, "?").replace(lower, upper).replace("?", lower)
    (folder / "capture.toml").write_text(_without_picks(text))


def _without_picks(text: str) -> str:
    """Picks name vertices of the scans."""
    start = text.find("[bootstrap]")
    return text if start < 0 else text[:start]


def _other_lower(folder: Path, rng: np.random.Generator) -> None:
    """The lower scan of somebody else, in occlusion as far as that goes: same frame, same lower incisal point."""
    from subjects.bite import build_bite
    from subjects.traits import draw_traits

    other = build_bite(draw_traits(int(rng.integers(10_000, 20_000))))
    with np.load(folder / "truth" / "truth.npz", allow_pickle=False) as truth:
        own = np.array([0.0, float(truth["overbite_mm"]), -float(truth["overjet_mm"])])
    B = se3_inverse(_bite_frame(folder))
    mesh = other.lower.mesh
    points = transform_points(B, mesh.vertices - other.incisor + own)
    _rewrite(folder, "lower", lambda _: Mesh(points, mesh.faces, mesh.colors))
    path = folder / "capture.toml"
    path.write_text(_without_picks(path.read_text()))


def _cameras(folder: Path, change: Callable[[list], list]) -> None:
    path = folder / "calibration.toml"
    save_calibration(path, change(load_calibration(path)))


def _one_camera(change: Callable) -> Callable[[Path, np.random.Generator], None]:
    """Change one camera of the calibration, drawn at random."""

    def plant(folder: Path, rng: np.random.Generator) -> None:
        def of(cameras: list) -> list:
            k = int(rng.integers(len(cameras)))
            return [change(c, rng) if i == k else c for i, c in enumerate(cameras)]

        _cameras(folder, of)

    return plant


def _with_K(camera, focal: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)):
    K = camera.K.copy()
    K[0, 0] *= focal
    K[1, 1] *= focal
    K[:2, 2] += np.array(shift) * camera.size_px[0]
    return replace(camera, K=K)


def _knocked(camera, rng: np.random.Generator):
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    T = make_transform(so3_exp(np.deg2rad(0.5) * axis), 2.0 * direction)
    return replace(camera, T_cam_world=T @ camera.T_cam_world)


def _flipped_distortion(folder: Path, rng: np.random.Generator) -> None:
    _cameras(folder, lambda cameras: [replace(c, distortion=-c.distortion) for c in cameras])


def _two(folder: Path, rng: np.random.Generator) -> tuple[str, str]:
    names = [p.name for p in sorted((folder / "masks").iterdir())]
    a, b = rng.choice(len(names), 2, replace=False)
    return names[a], names[b]


def _calibrations_exchanged(folder: Path, rng: np.random.Generator) -> None:
    a, b = _two(folder, rng)
    names = {a: b, b: a}
    _cameras(folder, lambda cameras: [replace(c, name=names.get(c.name, c.name)) for c in cameras])


def _other_resolution(folder: Path, rng: np.random.Generator) -> None:
    _cameras(folder, lambda cameras: [c.scaled((2 * c.size_px[0], 2 * c.size_px[1])) for c in cameras])


def _world_metres(folder: Path, rng: np.random.Generator) -> None:
    def metres(camera):
        T = camera.T_cam_world.copy()
        T[:3, 3] /= 1000.0
        return replace(camera, T_cam_world=T)

    _cameras(folder, lambda cameras: [metres(c) for c in cameras])


def _mask_cameras_exchanged(folder: Path, rng: np.random.Generator) -> None:
    a, b = _two(folder, rng)
    path = folder / "capture.toml"
    text = path.read_text().replace(f"masks/{a}/", "masks/?/").replace(f"masks/{b}/", f"masks/{a}/")
    path.write_text(text.replace("masks/?/", f"masks/{b}/"))


def _mask_arches_exchanged(every: bool) -> Callable[[Path, np.random.Generator], None]:
    def plant(folder: Path, rng: np.random.Generator) -> None:
        path = folder / "capture.toml"
        text = path.read_text()
        names = [p.name for p in sorted((folder / "masks").iterdir())]
        for name in names if every else [str(rng.choice(names))]:
            upper, lower = (f"masks/{name}/{row}/" for row in ROWS)
            text = text.replace(upper, "?").replace(lower, upper).replace("?", lower)
        path.write_text(text)

    return plant


def _masks_changed(change: Callable[[np.ndarray], np.ndarray], every: bool = False) -> Callable:
    """Rewrite the masks of one camera, or of all."""

    def plant(folder: Path, rng: np.random.Generator) -> None:
        cameras = sorted((folder / "masks").iterdir())
        for camera in cameras if every else [cameras[int(rng.integers(len(cameras)))]]:
            for path in sorted(camera.rglob("*.png")):
                cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return plant


def _dilated(mask: np.ndarray) -> np.ndarray:
    return cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (13, 13)))


def _late(folder: Path, rng: np.random.Generator) -> None:
    """One camera's footage starts a frame later than said."""
    path = folder / "capture.toml"
    names = [p.name for p in sorted((folder / "masks").iterdir())][1:]
    name, sign = str(rng.choice(names)), int(rng.choice([-1, 1]))
    text = re.sub(rf"(\b{name} = )(-?\d+)", lambda m: f"{m[1]}{int(m[2]) + sign}", path.read_text(), count=1)
    path.write_text(text)


def _dropped(folder: Path, rng: np.random.Generator) -> None:
    """One camera lost a frame in mid take: all later ones come one too early."""
    cameras = sorted((folder / "masks").iterdir())[1:]
    camera = cameras[int(rng.integers(len(cameras)))]
    for row in ROWS:
        files = sorted((camera / row).glob("*.png"))
        half = len(files) // 2
        for earlier, later in zip(files[half:-1], files[half + 1 :]):
            shutil.move(later, earlier)


def _picks(change: Callable[[str, np.random.Generator], str]) -> Callable[[Path, np.random.Generator], None]:
    def plant(folder: Path, rng: np.random.Generator) -> None:
        path = folder / "capture.toml"
        text = path.read_text()
        if "[bootstrap]" not in text:
            raise NotPossible
        path.write_text(change(text, rng))

    return plant


def _wrong_teeth(text: str, rng: np.random.Generator) -> str:
    """The picks of each arch one on: every vertex with the pixels of the next."""
    for row in ROWS:
        pattern = rf"(\[\[bootstrap\.{row}\]\]\nvertex = )(\d+)"
        vertices = re.findall(pattern, text)
        order = iter([v for _, v in vertices[1:]] + [vertices[0][1]])
        text = re.sub(pattern, lambda m, order=order: m[1] + next(order), text)
    return text


def _other_cameras(text: str, rng: np.random.Generator) -> str:
    """In every pick the two cameras exchanged."""
    return re.sub(r'camera = "(\w+)"(.*?)camera = "(\w+)"', lambda m: f'camera = "{m[3]}"{m[2]}camera = "{m[1]}"', text)


def _frame_rate(folder: Path, rng: np.random.Generator) -> None:
    """The clip of the first camera shows what all recorded, 24 frames per second; the capture says 60."""
    camera = load_calibration(folder / "calibration.toml")[0]
    path = folder / "capture.toml"
    last = max(int(file.stem) for file in (folder / "masks" / camera.name).rglob("*.png"))
    (folder / "video").mkdir()
    with VideoWriter(folder / "video" / "clip.mp4", camera.size_px, 24.0) as clip:
        for _ in range(last + 1):
            clip.write(np.zeros((*camera.size_px[::-1], 3), np.uint8))
    text = path.read_text().replace("fps = 24.0", "fps = 60.0")
    name = f'name = "{camera.name}"\n'
    path.write_text(text.replace(name, f'{name}video = "video/clip.mp4"\n', 1))


# Kinds of findings, or words of errors, that name a cause and nothing else.
BITE = r"scan_registration|scans_(open|overlap|inside|passed|apart|beside)|bite_tilted|midlines_apart|not in occlusion"
TURNED = r"principal_point|camera_moved|it was turned"
SIZE = r"scan_size|scans are about|scale of the scans"
METRES, INCHES, SIZES = r"looks like metres|in metres\?", r"looks like inches", r"\d+ x \d+"
PICKS = r"picks? .*(contradict|wrong way|exchanged|does not fit)|pick_wrong|picks_off"
MASK_ARCH = r"masks of the upper and lower teeth are exchanged"
FAULTS = (
    Fault("bite off by 1 mm", _wrong_bite(1.0, 0.0), BITE),
    Fault("bite off by 2 mm", _wrong_bite(2.0, 0.0), BITE),
    Fault("bite off by 3 degrees", _wrong_bite(0.0, 3.0), BITE),
    Fault("scan files exchanged", _scans_exchanged, r"exchanged|underbite"),
    Fault("lower scan upside down", _upside_down, r"upside down|turned over"),
    Fault("scans not in one frame", _own_frame, r"not in occlusion|scans_(open|apart|beside)"),
    Fault("scans in metres", _scaled(1e-3), METRES),
    Fault("scans in inches", _scaled(1 / 25.4), INCHES),
    Fault("scans mirrored", _mirrored, r"mirrored"),
    Fault("somebody else's lower scan", _other_lower, BITE + r"|arch_widths|fits? its own masks"),
    Fault("scans 5 % too large", _scaled(1.05), SIZE),
    Fault("scans 30 % too large", _scaled(1.3), SIZE),
    Fault("calibration in metres", _world_metres, METRES),
    Fault("focal length 5 % off", _one_camera(lambda c, r: _with_K(c, 1.05)), r"focal_length|focal length (is|[+-])"),
    Fault("distortion's sign", _flipped_distortion, r"lens_distortion|distortion_folds"),
    Fault("principal point 3 % off", _one_camera(lambda c, r: _with_K(c, 1.0, (0.03, 0.0))), TURNED),
    Fault("camera knocked", _one_camera(_knocked), TURNED),
    Fault("calibrations exchanged", _calibrations_exchanged, r"calibrations .*exchanged|exchanged.* calibration"),
    Fault("calibrated at twice the size", _other_resolution, r"calibration_rescaled"),
    Fault("masks of two cameras exchanged", _mask_cameras_exchanged, r"masks of cameras .*exchanged"),
    Fault("masks of arches exchanged", _mask_arches_exchanged(True), MASK_ARCH),
    Fault("masks of arches exchanged, one camera", _mask_arches_exchanged(False), MASK_ARCH),
    Fault("masks 6 px too wide, one camera", _masks_changed(_dilated), r"masks_wide"),
    Fault("masks inverted", _masks_changed(lambda m: 255 - m, True), r"invert"),
    Fault("masks inverted, one camera", _masks_changed(lambda m: 255 - m), r"invert"),
    Fault("masks of half the size, one camera", _masks_changed(lambda m: m[::2, ::2]), SIZES),
    Fault("masks with white = 100", _masks_changed(lambda m: (m > 0).astype(np.uint8) * 100), r"mask_levels"),
    Fault("camera a frame late", _late, r"camera_late"),
    Fault("frame dropped in mid take", _dropped, r"frame_dropped"),
    Fault("picks on wrong teeth", _picks(_wrong_teeth), PICKS),
    Fault("picks in exchanged cameras", _picks(_other_cameras), PICKS),
    Fault("frame rate wrong", _frame_rate, r"fps_differs"),
)  # fmt: skip
