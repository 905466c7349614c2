"""A take as a scene for compositing over the footage: calibrated cameras, and the actor moved by the head.

Cameras alone are also written and read, to exchange calibrations with other programs.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pxr import Gf, Kind, Sdf, Usd, UsdGeom

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, CalibrationError, RigError
from jawusd.cameras.files import names_of_labels
from jawusd.geometry.camera import Camera
from jawusd.geometry.se3 import make_transform, se3_inverse
from jawusd.rig import layers
from jawusd.rig.animation import root_prim_of
from jawusd.rig.layers import add_pose, define_prim, new_layer, relative_path, set_attribute, stage_of, write_layer
from jawusd.rig.read import open_stage
from jawusd.rig.untrusted import raises_format_error

TAKE, TAKE_CAMERAS = "/Take", "/Take/Cameras"

# File patterns of undistorted images, relative to the take, numbered by time code; EXR for footage in linear light.
PLATE = "plates/{name}/{name}.%06d.jpg"
LIGHT_PLATE = "plates/{name}/{name}.%06d.exr"

# Sensor width of 36 mm, in tenths of a scene unit, the unit of UsdGeomCamera's apertures and focal lengths.
_SENSOR_WIDTH = 360.0
_CLIPPING_MM = (1.0, 10_000.0)
_LARGEST_SKEW = 1e-6
# Attributes that name the lens model in Omniverse, in older versions and in its lens schemas.
_LENS_MODELS = ("cameraProjectionType", "omni:lensdistortion:model")
# Camera and world axes are x right, y down, z forward in OpenCV, and x right, y up, z backward in USD.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def write_cameras(
    out: AnyPath,
    cameras: Sequence[Camera],
    actor: AnyPath,
    frames: ArrayLike,
    T_world_skull: ArrayLike,
    fps: float,
    light: Container[str] = (),
) -> list[Path]:
    """Write the take: one `UsdGeom.Camera` per camera, and the actor moved by the tracked head; return both files.

    The cameras are pinholes, which match undistorted images. `jaw:plate` is the printf pattern of these images,
    numbered by time code, relative to the take. `jaw:distortion` contains OpenCV's coefficients of the distorted
    footage, and `jaw:imageSize` its size.

    Args:
        out: File to write, `.usda`; the motion goes to `<name>_motion.usdc` beside it, which the take sublayers.
        actor: The layer of the actor that the take references, `anim_capture.usdc` or `actor.usda`.
        frames: Increasing frame numbers (F,).
        T_world_skull: Poses of the skull (F, 4, 4) [mm], NaN where lost.
        fps: Frames per second.
        light: Names of cameras whose plates are EXR files in linear light.

    Raises:
        RigError: No cameras, cameras of equal names, skewed pixels, or no frame with a pose.
        OutputError: The file cannot be written.
        ValueError: The shape of the poses is not (F, 4, 4).
    """
    out = Path(out)
    frames, T_world_skull = np.asarray(frames, dtype=np.float64), np.asarray(T_world_skull, dtype=np.float64)
    if T_world_skull.shape != (len(frames), 4, 4):
        raise ValueError(f"T_world_skull must have shape {(len(frames), 4, 4)}, got {T_world_skull.shape}")
    known = np.isfinite(T_world_skull).all(axis=(1, 2))
    if not known.any():
        raise RigError("the skull has no pose in any frame.", path=out)
    motion = out.with_name(f"{out.stem}_motion.usdc")
    layer = _camera_layer(cameras, fps, light, out)
    layer.startTimeCode, layer.endTimeCode = float(frames[0]), float(frames[-1])
    actor_path = f"{TAKE}/{root_prim_of(Path(actor))}"
    shown = define_prim(layer, actor_path, "Xform")
    stage = stage_of(layer)
    add_pose(stage.GetPrimAtPath(TAKE), _FLIP)
    # Close the stage: on an anonymous layer it would fail to resolve the relative paths below, with a warning.
    del stage
    layer.subLayerPaths.append(relative_path(motion, out))
    shown.referenceList.prependedItems = [Sdf.Reference(relative_path(Path(actor), out))]
    moving = _motion_layer(actor_path, frames[known], T_world_skull[known], fps)
    return [write_layer(moving, motion), write_layer(layer, out)]


def _camera_layer(cameras: Sequence[Camera], fps: float, light: Container[str], out: Path) -> Sdf.Layer:
    names = [Sdf.Path(TAKE_CAMERAS).AppendChild(_prim_name(camera.name)) for camera in cameras]
    if not names or len(set(names)) < len(names):
        raise RigError("a stage needs cameras with unique names.", path=out)
    layer = new_layer(fps, TAKE)
    define_prim(layer, TAKE, "Xform").kind = Kind.Tokens.assembly
    define_prim(layer, TAKE_CAMERAS, "Scope")
    stage = stage_of(layer)
    for name, camera in zip(names, cameras, strict=True):
        plate = LIGHT_PLATE if camera.name in light else PLATE
        _define_camera(stage, name, camera, plate.format(name=camera.name))
    return layer


def _prim_name(name: str) -> str:
    cleaned = "".join(letter if letter.isalnum() and letter.isascii() else "_" for letter in name)
    return cleaned if cleaned[:1].isalpha() else f"cam_{cleaned}"


def _motion_layer(actor_path: str, frames: Array, T_world_skull: Array, fps: float) -> Sdf.Layer:
    """Return the layer that moves the actor with the head."""
    layer = new_layer(fps, TAKE)
    for path in (TAKE, actor_path):
        define_prim(layer, path, "Xform")
    stage = stage_of(layer)
    add_pose(stage.GetPrimAtPath(actor_path), T_world_skull[0])
    translate, orient = UsdGeom.Xformable(stage.GetPrimAtPath(actor_path)).GetOrderedXformOps()
    samples = zip(frames.tolist(), layers.translations(T_world_skull), layers.rotations(T_world_skull), strict=True)
    for frame, translation, rotation in samples:
        translate.Set(translation, frame)
        orient.Set(rotation, frame)
    return layer


def write_camera_stage(out: AnyPath, cameras: Sequence[Camera]) -> Path:
    """Write calibrated cameras alone as a stage in mm, in the calibration's world; attributes as in `write_cameras`.

    Raises:
        RigError: No cameras, cameras of equal names, or skewed pixels.
        OutputError: The file cannot be written.
    """
    return write_layer(_camera_layer(cameras, 24.0, (), Path(out)), Path(out))


@raises_format_error
def read_cameras(path: AnyPath, sizes: Callable[[], Mapping[str, tuple[int, int]]]) -> list[Camera]:
    """Read the perspective cameras in a stage as OpenCV cameras in mm, named after their prims.

    Prims of equal names are named after their paths. The image spans the aperture, shifted by its offsets. Its size
    [px] is `jaw:imageSize` or that of the footage; `jaw:distortion` contains OpenCV's coefficients. Moving cameras are
    read at their first time.

    Args:
        path: A stage, or an Alembic file (in cm) if OpenUSD has its Alembic plugin, which the wheels lack.
        sizes: Callback that returns (width, height) [px] of each camera; used for cameras without `jaw:imageSize`.

    Raises:
        RigError: The stage cannot be opened, refers to files outside its folder, or has no perspective camera.
        CalibrationError: An image size is unknown, or a lens, such as a fisheye, is not described by OpenCV's
            coefficients.
        FormatError: A value has an unexpected type.
    """
    if Path(path).suffix.lower() == ".abc" and Sdf.FileFormat.FindByExtension("abc") is None:
        raise RigError(
            "is an Alembic file; reading it needs OpenUSD's plugin usdAbc, which is not installed.",
            hint="Export the cameras as USD from the program that wrote them (Blender, Houdini and Maya read Alembic "
            "and write USD), or use a build of OpenUSD with Alembic.",
        )
    stage = open_stage(path)
    mm = UsdGeom.GetStageMetersPerUnit(stage) * 1000.0
    cameras = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    # skips orthographic cameras, which are the top and side views of 3-D programs
    prims = [prim for prim in cameras if UsdGeom.Camera(prim).GetProjectionAttr().Get() != "orthographic"]
    names = names_of_labels([str(prim.GetPath())[1:] for prim in prims])
    known: Mapping[str, tuple[int, int]] | None = None
    out = []
    for name, prim in zip(names, prims, strict=True):
        _check_lens(prim)
        size = prim.GetAttribute("jaw:imageSize").Get() if prim.HasAttribute("jaw:imageSize") else None
        if size is None:
            known = sizes() if known is None else known
            if name not in known:
                raise CalibrationError(
                    f"camera {name} has no jaw:imageSize, and there is no footage of that name.",
                    hint="Name each [[camera]] like the camera's prim, or give --size.",
                )
            size = known[name]
        out.append(_read_camera(name, prim, (int(size[0]), int(size[1])), mm))
    if not out:
        raise RigError("has no perspective camera.")
    return out


def _check_lens(prim: Usd.Prim) -> None:
    """Raise CalibrationError if a camera has one of Omniverse's lens models, such as fisheye."""
    for name in _LENS_MODELS:
        model = prim.GetAttribute(name).Get() if prim.HasAttribute(name) else None
        if model and str(model) != "pinhole":
            raise CalibrationError(
                f"has {name} = {model}; only pinholes with OpenCV's coefficients in jaw:distortion can be read.",
                camera=prim.GetName(),
                hint="Undistort the footage first, or export the camera as a pinhole.",
            )


def _read_camera(name: str, prim: Usd.Prim, size: tuple[int, int], mm: float) -> Camera:
    camera = UsdGeom.Camera(prim)
    samples = UsdGeom.Xformable(prim).GetTimeSamples()
    time = Usd.TimeCode(samples[0]) if samples else Usd.TimeCode.Default()
    optics = camera.GetCamera(time)
    wide, high, focal = optics.horizontalAperture, optics.verticalAperture, optics.focalLength
    cx = size[0] * (0.5 - optics.horizontalApertureOffset / wide) - 0.5
    cy = size[1] * (0.5 + optics.verticalApertureOffset / high) - 0.5
    K = np.array([[focal / wide * size[0], 0.0, cx], [0.0, focal / high * size[1], cy], [0.0, 0.0, 1.0]])
    placed = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time), np.float64).T
    u, _, vt = np.linalg.svd(placed[:3, :3])  # ignore parents' scales: they move a camera but do not change its image
    T_world_cam = make_transform(u @ vt @ _FLIP[:3, :3], mm * placed[:3, 3])
    lens = prim.GetAttribute("jaw:distortion").Get() if prim.HasAttribute("jaw:distortion") else None
    return Camera(name, size, K, np.zeros(0) if lens is None else np.array(lens), se3_inverse(T_world_cam))


def _define_camera(stage: Usd.Stage, path: Sdf.Path, camera: Camera, plate: str) -> None:
    """Define a camera whose aperture spans the image to its edges, half a pixel beyond the outer pixel centres."""
    (fx, skew, cx), (_, fy, cy) = camera.K[:2]
    width, height = camera.size_px
    if abs(skew) > _LARGEST_SKEW * fx:
        raise RigError(f"camera {camera.name} has skewed pixels (K[0, 1] = {skew:g}), which USD cannot express.")
    prim = UsdGeom.Camera.Define(stage, path)
    unit = _SENSOR_WIDTH / width
    aperture_height = height * unit * fx / fy
    prim.CreateFocalLengthAttr(fx * unit)
    prim.CreateHorizontalApertureAttr(_SENSOR_WIDTH)
    prim.CreateVerticalApertureAttr(aperture_height)
    prim.CreateHorizontalApertureOffsetAttr(_SENSOR_WIDTH * (0.5 - (cx + 0.5) / width))
    prim.CreateVerticalApertureOffsetAttr(aperture_height * ((cy + 0.5) / height - 0.5))
    prim.CreateClippingRangeAttr(Gf.Vec2f(*_CLIPPING_MM))
    add_pose(prim.GetPrim(), se3_inverse(camera.T_cam_world) @ _FLIP)
    spec = stage.GetRootLayer().GetPrimAtPath(path)
    set_attribute(spec, "jaw:distortion", Sdf.ValueTypeNames.DoubleArray, layers.double_array(camera.distortion))
    set_attribute(spec, "jaw:imageSize", Sdf.ValueTypeNames.Int2, Gf.Vec2i(width, height))
    set_attribute(spec, "jaw:plate", Sdf.ValueTypeNames.String, "./" + plate)
