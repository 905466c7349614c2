"""Read the cameras of 3DEqualizer from its Nuke export (.nk) and the lens files beside it (see `equalizer_lens`).

Poses, focal length and film back are read from the `Camera` nodes that "Export Project, Nuke" writes (for a version of
that export script, see NyanNyanGringo/match-move-exporter on GitHub). The camera axes are x right, y up, z backward.
`rotate` is in degrees, applied about z first, then x, then y (`rot_order ZXY`). `translate` is in the project's unit,
usually cm. `focal`, `haperture` and `vaperture` are in mm. `win_translate` is -2 times the lens centre offset, divided
by the film back size. A parent `Axis` node contains the scene's transform and scale. The optical axis meets the film
back at its centre plus the lens centre offset (x right, y up). The film back extends to the outer edges of the pixels.
The image size is not in the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError, naming_file
from jawusd.cameras.equalizer_lens import FoundLens, Lens, find_lenses, opencv_of
from jawusd.cameras.files import CameraFormat, Size, files_in, folder_of, known_size
from jawusd.cameras.nuke_script import SAME, NukeNode, knob_values, read_nuke_script, steady_values
from jawusd.geometry import Camera, make_transform, se3_inverse, so3_exp
from jawusd.geometry.camera import intrinsics

_OPENGL = np.diag([1.0, -1.0, -1.0])


def load_3de(path: Path, sizes: Mapping[str, Size]) -> list[Camera]:
    """Read the cameras of 3DEqualizer's Nuke export (the script or its folder), sorted by name, in the project's unit.

    A camera uses the lens whose node, file or stated name is the camera's name; if there is only one lens, all cameras
    use it. Without lenses, cameras are pinholes, for undistorted footage. `sizes` has the image sizes by camera.

    Raises:
        CalibrationError: there is no camera, a camera moves or zooms, an image size or distortion model is unknown, or
            a lens is ambiguous or cannot be approximated by OpenCV's coefficients.
        FormatError: a file cannot be read.
    """
    scripts = [path] if path.is_file() else sorted(path.glob("*.nk"))
    nodes = {script: read_nuke_script(script) for script in scripts}
    folder = folder_of(path)
    beside = {script: read_nuke_script(script) for script in sorted(folder.glob("*.nk")) if script not in nodes}
    lenses = find_lenses(folder, nodes | beside)
    cameras: dict[str, Camera] = {}
    for script, inside in nodes.items():
        for node in inside:
            if not re.fullmatch(r"Camera\d?", node.kind):
                continue
            if node.name in cameras:
                raise CalibrationError(f"has two cameras named {node.name}.", path=script)
            with naming_file(script):
                cameras[node.name] = _camera(node, lenses, sizes)
    if not cameras:
        raise CalibrationError(
            "has no Camera node.",
            hint='Export cameras from 3DEqualizer with "Export Project, Nuke"; lens exports have no poses.',
        )
    return [cameras[name] for name in sorted(cameras)]


def files_of_3de(path: Path) -> list[Path]:
    """Return the scripts and lens files that `load_3de` reads."""
    folder = folder_of(path)
    return sorted({*folder.glob("*.nk"), *(lens.path for lens in find_lenses(folder, {}))})


def _camera(node: NukeNode, lenses: list[FoundLens], sizes: Mapping[str, Size]) -> Camera:
    name = node.name
    size = known_size(name, sizes)
    defaults = (("focal", 50.0), ("haperture", 24.576), ("vaperture", 18.672))
    focal_mm, *sides = (float(steady_values(node, knob, (default,))[0]) for knob, default in defaults)
    back = (sides[0], sides[1])
    if not (focal_mm > 0 and min(back) > 0):
        raise CalibrationError(
            f"camera {name} has focal length {focal_mm:g} mm and film back {back[0]:g} x {back[1]:g} mm; "
            "all three must be greater than 0 mm."
        )
    scale, roll = steady_values(node, "win_scale", (1.0, 1.0)), steady_values(node, "winroll", (0.0,))
    if (scale != 1).any() or roll[0] != 0:
        raise CalibrationError(f"camera {name} has win_scale or winroll set; expected win_scale 1 1 and winroll 0.")
    shift = steady_values(node, "win_translate", (0.0, 0.0))
    offset = (-float(shift[0]) * back[0] / 2, -float(shift[1]) * back[1] / 2)
    lens = _lens_of(name, lenses)
    if lens is not None:
        _check_same_plate(name, back, offset, lens)
    cx, cy = size[0] * (0.5 + offset[0] / back[0]) - 0.5, size[1] * (0.5 - offset[1] / back[1]) - 0.5
    K = intrinsics(focal_mm * size[0] / back[0], focal_mm * size[1] / back[1], cx, cy)
    T_cam_world = _world_to_camera(node)
    if lens is None:
        return Camera(name, size, K, np.zeros(0), T_cam_world)
    K, distortion, turn = opencv_of(lens, K, size, back, focal_mm)
    turned = make_transform(so3_exp(turn), np.zeros(3))
    return Camera(name, size, K, distortion, turned @ T_cam_world)


def _world_to_camera(node: NukeNode) -> Array:
    """Return T_cam_world of a camera node, including its parent nodes."""
    R, t = _placed(node)
    above = node.parent
    while above is not None and re.fullmatch(r"(Axis|Camera)\d?", above.kind):
        turn, shift = _placed(above)
        scale = steady_values(above, "scaling", (1.0, 1.0, 1.0)) * steady_values(above, "uniform_scale", (1.0,))
        if np.ptp(scale) > 1e-9 or scale[0] <= 0:
            raise CalibrationError(
                f"{above.name}, parent of camera {node.name}, has scale {scale.tolist()}; expected a uniform scale > 0."
            )
        R, t = turn @ R, turn @ (scale[0] * t) + shift
        above = above.parent
    return se3_inverse(make_transform(R @ _OPENGL, t))


def _placed(node: NukeNode) -> tuple[Array, Array]:
    """Return the rotation (3, 3) and translation (3,) of a static Axis or Camera node."""
    for knob in ("useMatrix", "pivot", "skew"):
        if set(re.findall(r"[\w.]+", node.knobs.get(knob, "0"))) - {"0", "false", "0.0"}:
            raise CalibrationError(f"node {node.name} has {knob} set, which is not supported.")
    order = node.knobs.get("rot_order", "ZXY")
    if sorted(order) != ["X", "Y", "Z"] or node.knobs.get("xform_order", "SRT") != "SRT":
        raise CalibrationError(
            f'node {node.name} has rot_order "{order}" or xform_order other than SRT, which is not supported.'
        )
    angles = np.deg2rad(knob_values(node, "rotate", (0.0, 0.0, 0.0)))
    turns = np.broadcast_to(np.eye(3), (len(angles), 3, 3))
    for axis in ("XYZ".index(letter) for letter in order):
        turns = so3_exp(angles[:, [axis]] * np.eye(3)[axis]) @ turns
    places = knob_values(node, "translate", (0.0, 0.0, 0.0))
    reach = SAME * float(np.abs(places[0]).max())
    if np.abs(turns - turns[0]).max() > SAME or np.abs(places - places[0]).max() > reach + 1e-12:
        raise CalibrationError(
            f"camera {node.name} moves between frames; cameras of a capture must be static.",
            hint="Constrain it to a fixed position in 3DEqualizer, and export again.",
        )
    return np.array(turns[0]), places[0]


def _lens_of(name: str, lenses: list[FoundLens]) -> Lens | None:
    for candidates in ([lens for lens in lenses if name in (lens.name, lens.path.stem)], lenses):
        if len(candidates) == 1:
            return candidates[0].read()
        if candidates:
            listed = ", ".join(f"{lens.name} ({lens.path.name})" for lens in candidates)
            raise CalibrationError(
                f"camera {name} matches several lenses: {listed}.",
                hint=f"Name the lens file after the camera: {name}.txt.",
            )
    return None


def _check_same_plate(name: str, back_mm: tuple[float, float], offset_mm: tuple[float, float], lens: Lens) -> None:
    theirs = (*(lens.filmback_mm or back_mm), *lens.offset_mm)
    if np.abs(np.subtract(theirs, (*back_mm, *offset_mm))).max() > SAME * back_mm[0]:
        shown = [f"{v[0]:.6g} x {v[1]:.6g} mm with the lens centre at {v[2]:.4g}, {v[3]:.4g}" for v in
                 (theirs, (*back_mm, *offset_mm))]  # fmt: skip
        raise CalibrationError(
            f"camera {name} has film back {shown[1]}, but its lens {lens.name} in {lens.path.name} has {shown[0]}.",
            hint="Export camera and lens from the same project.",
        )


FORMAT = CameraFormat(
    lambda path: path.suffix.lower() == ".nk" or bool(files_in(path, ".nk")), load_3de, files_of_3de, lacks_sizes=True
)
