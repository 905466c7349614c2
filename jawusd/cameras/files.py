"""Load calibrations of all supported programs; the format is recognised by file name or content.

Every module of this package that defines a CameraFormat named FORMAT is registered as a format. Files of no other
format are read as TOML of aniposelib, Pose2Sim or Caliscope by `calibration`. The helpers that the formats share are
here: names, sizes, lens models, XML and numbers.
"""

from __future__ import annotations

import pkgutil
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import AnyPath, CalibrationError, naming_file
from jawusd.base.inputs import check_input
from jawusd.base.tables import read_text
from jawusd.geometry import Camera, make_transform, orthonormalise, rigidity_defect, se3_inverse
from jawusd.geometry.camera import intrinsics, opencv_radial

Size = tuple[int, int]

MOST_BYTES = 64 << 20
UNDISTORT = "Undistort the footage first, or calibrate with OpenCV's standard model."
_LARGEST_DEFECT = 1e-3
# Maximum differences between the poses of a static camera in different images: rotation [rad], and position as a
# fraction of the camera's distance from the origin.
_MOVED_RAD, _MOVED_SHARE = 1e-3, 1e-3
_LARGEST_ERROR_PX = 0.05  # maximum error of a lens model converted to OpenCV's model
_MODEL_KEYS = ("distortion_model", "distortion_type", "lens_model", "camera_model", "model_type", "projection_model")
# Keys that mark another lens model; `xi` is a parameter of omnidirectional cameras.
_FLAG_KEYS = ("fisheye", "fisheye_model", "is_fisheye", "use_fisheye", "xi")
# Names that ROS, Kalibr, camodocal and others use for OpenCV's radial-tangential model with up to 8 coefficients.
_READ_MODELS = {"plumb_bob", "rational_polynomial", "radtan", "radial_tangential", "brown", "brown_conrady", "opencv"}
_READ_MODELS |= {"pinhole", "perspective", "standard", "none", "no_distortion", "frame", "full_opencv", ""}
_OTHER_MODELS = re.compile(
    r"fisheye|equidist|equisolid|omni|kannala|mei\b|ucm|double.?sphere|\bfov\b|scaramuzza|division|spher"
)


@dataclass(frozen=True)
class CameraFormat:
    """Registry entry of a camera format; a module of this package registers its format as FORMAT."""

    # Returns 1 if the name of a path indicates this format, 2 if its content does, 0 otherwise.
    reads: Callable[[Path], int]
    # Returns the cameras in the file's order and unit, given (width, height) [px] of the images by camera.
    load: Callable[[Path, Mapping[str, Size]], list[Camera]]
    files: Callable[[Path], list[Path]] = lambda path: [path]  # returns all files that belong to a calibration
    lacks_sizes: bool = False  # whether image sizes may be missing from the file


def folder_of(path: Path) -> Path:
    """Return a folder itself, or the folder of a file."""
    return path if path.is_dir() else path.parent


def files_in(path: Path, *suffixes: str) -> list[Path]:
    """Return the files of a folder that have one of the suffixes; none if the path is not a folder."""
    return sorted(file for file in path.iterdir() if file.suffix.lower() in suffixes) if path.is_dir() else []


def plain_name(name: str) -> str:
    """Return a name in which characters not allowed in camera names of a capture are replaced by underscores."""
    return re.sub(r"[^A-Za-z0-9_\-]+", "_", name)


def names_of_labels(labels: Sequence[str]) -> list[str]:
    """Return a unique name for each image label, without folder or suffix where it is unique without them.

    Raises:
        CalibrationError: two labels are equal.
    """
    places = [PurePosixPath(label.strip().replace("\\", "/")) for label in labels]
    forms = [[place.stem for place in places], [place.name for place in places]]
    forms.append(["_".join(place.with_suffix("").parts) for place in places])
    counts = [Counter(form) for form in forms]
    names = [
        next((form[k] for form, count in zip(forms, counts, strict=True) if form[k] and count[form[k]] == 1), label)
        for k, label in enumerate(labels)
    ]
    name, times = Counter(names).most_common(1)[0] if names else ("", 1)
    if times > 1:
        alike = ", ".join(f'"{label}"' for label, own in zip(labels, names, strict=True) if own == name)
        raise CalibrationError(
            f"has {times} cameras with the same label: {alike}. Labels must be unique.",
            hint="Rename the images (such as left_0001.jpg) or cameras, and export again.",
        )
    return names


def known_size(name: str, sizes: Mapping[str, Size]) -> Size:
    """Return the size of a camera's images.

    Raises:
        CalibrationError: the size is unknown.
    """
    for known in (name, plain_name(name)):
        if known in sizes:
            return sizes[known]
    raise CalibrationError(
        f"camera {name}: the image size is not in the file, and no footage has that name "
        f"(available: {', '.join(sizes) or 'none'}).",
        hint="Name the images after the [[camera]] tables, or set --size.",
    )


def check_lens_model(where: str, values: Mapping[str, object]) -> None:
    """Check that a file's lens model, if stated under a key that common programs use, is OpenCV's standard model.

    Raises:
        CalibrationError: the file states another lens model.
    """
    for key, value in values.items():
        said = re.sub(r"[\s-]+", "_", str(value).strip().lower())
        flag = key.lower() in _FLAG_KEYS and said not in ("0", "false", "no", "none", "")
        named = key.lower() in _MODEL_KEYS and said not in _READ_MODELS
        # "camera_model" may be a product name, so only known names of other models are rejected
        if flag or (named and (key.lower().startswith("distortion") or _OTHER_MODELS.search(said))):
            raise CalibrationError(
                f"{where} has {key} = {value}, a lens model that is not supported; use OpenCV's "
                "radial-tangential model (plumb_bob, rational_polynomial).",
                hint=UNDISTORT,
            )


def numbers(text: str, count: int, what: str) -> Array:
    """Convert a text of `count` numbers to an array, shape (count,).

    Raises:
        CalibrationError: the text is not a list of `count` finite numbers.
    """
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise CalibrationError(f'{what}: "{text:.60}" is not a list of numbers.') from error
    if len(values) != count:
        raise CalibrationError(f"{what} has {len(values)} values; expected {count}.")
    if not np.isfinite(values).all():
        raise CalibrationError(f"{what} has a value that is not finite.")
    return values


def number(text: str, what: str) -> float:
    """Convert a text to a number; see `numbers`."""
    return float(numbers(text, 1, what)[0])


def parsed_xml(path: Path) -> ElementTree.Element:
    """Return the root of an XML file.

    Raises:
        CalibrationError: the file is not XML, or declares a document type.
        FormatError: the file cannot be read.
    """
    text = read_text(path, MOST_BYTES)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # entities may read other files and expand without limit
        raise CalibrationError("declares a document type, which is not allowed.")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise CalibrationError(f"cannot be read as XML ({error}).") from error


def world_to_camera(name: str, rotation: Array, centre: Array) -> Array:
    """Return T_cam_world from a camera's axes in the world (3, 3) and its centre (3,).

    Raises:
        CalibrationError: the axes are not orthonormal.
    """
    T_world_cam = make_transform(rotation, centre)
    if rigidity_defect(T_world_cam) > _LARGEST_DEFECT:
        raise CalibrationError(f"camera {name} has a rotation that is not orthonormal.")
    return se3_inverse(orthonormalise(T_world_cam))


def lens_with_k4(name: str, K: Array, size: Size, radial: Array, tangential: tuple[float, float]) -> Array:
    """Return OpenCV's coefficients for a lens with four radial coefficients and OpenCV's (p1, p2).

    Raises:
        CalibrationError: the approximation error is above 0.05 px.
    """
    k, error_px = opencv_radial(K, size, radial)
    if error_px > _LARGEST_ERROR_PX:
        raise CalibrationError(
            f"camera {name}: its lens cannot be approximated by OpenCV's coefficients (error {error_px:.2f} px; "
            f"at most {_LARGEST_ERROR_PX:g} px is allowed).",
            hint="Calibrate without k4, or undistort the footage first.",
        )
    lens = np.concatenate([k[:2], tangential, k[2:]])
    return lens if lens.any() else np.zeros(0)


def corner_matrix(where: str, fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return K (3, 3) in OpenCV's pixels from intrinsics in which the centre of the first pixel is at (0.5, 0.5).

    Raises:
        CalibrationError: a focal length is not positive.
    """
    if not (fx > 0 and fy > 0):
        raise CalibrationError(f"{where} has focal lengths {fx:g} and {fy:g} px; they must be > 0 px.")
    return intrinsics(fx, fy, cx - 0.5, cy - 0.5)


def cameras_of_images(images: Sequence[Camera]) -> list[Camera]:
    """Return one camera per physical camera, sorted by name, from the camera of each image, named after its file.

    The result's name is the image's folder (`cam0/0001.png` is cam0) or, without one, the file name (`cam0.png`).

    Raises:
        CalibrationError: images of one camera have different poses or lenses.
    """
    places = [PurePosixPath(image.name.replace("\\", "/")) for image in images]
    alone = sorted({place.name for place in places if place.parent.name in ("", "images")})
    names = dict(zip(alone, names_of_labels(alone), strict=True))
    cameras: dict[str, Camera] = {}
    for place, camera in zip(places, images, strict=True):
        folder = place.parent.name
        name = names[place.name] if folder in ("", "images") else folder
        known = cameras.setdefault(name, replace(camera, name=name))
        turned = np.abs(known.T_cam_world[:3, :3] - camera.T_cam_world[:3, :3]).max()
        moved = np.linalg.norm(known.centre_world() - camera.centre_world())
        poses_differ = turned > _MOVED_RAD or moved > _MOVED_SHARE * np.linalg.norm(known.centre_world()) + 1e-12
        if poses_differ or known.size_px != camera.size_px or not _same_lens(known, camera):
            raise CalibrationError(
                f"camera {name} has different {'poses' if poses_differ else 'lenses'} in different images.",
                hint="Name images after their cameras, with one image (cam0.png) or one folder (cam0/0001.png) per "
                "camera, and use one lens for all images of a camera.",
            )
    return [cameras[name] for name in sorted(cameras)]


def _same_lens(one: Camera, other: Camera) -> bool:
    return one.distortion.shape == other.distortion.shape and bool(
        np.allclose(one.K, other.K, rtol=1e-4) and np.allclose(one.distortion, other.distortion, atol=1e-4)
    )


@cache
def _formats() -> list[CameraFormat]:
    names = sorted(module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]))
    modules = [import_module(f"{__package__}.{name}") for name in names]
    return [module.FORMAT for module in modules if hasattr(module, "FORMAT")]


def _format_of(path: Path) -> CameraFormat:
    return max(_formats(), key=lambda one: one.reads(path))  # in a tie, the first one: `calibration`


def load_cameras_file(path: AnyPath, unit_mm: float = 1.0, sizes: Mapping[str, Size] | None = None) -> list[Camera]:
    """Read cameras from a calibration in any supported format, in file order; lengths in mm, OpenCV axes and pixels.

    Args:
        path: a file, or the folder of a COLMAP text model, of XMP files or of 3DEqualizer's Nuke script.
        unit_mm: the file's unit of length [mm].
        sizes: (width, height) [px] of the images by camera, for formats without them; see `lacks_sizes`.

    Raises:
        CalibrationError: a value is missing or wrong, or the camera model is not supported.
        FormatError: the file is damaged.
    """
    path = Path(path)
    if not path.is_dir():
        check_input(path, CalibrationError)
    with naming_file(path):
        cameras = _format_of(path).load(path, {} if sizes is None else sizes)
    poses = [make_transform(camera.T_cam_world[:3, :3], unit_mm * camera.T_cam_world[:3, 3]) for camera in cameras]
    return [replace(camera, T_cam_world=pose) for camera, pose in zip(cameras, poses, strict=True)]


def calibration_files(path: Path) -> list[Path]:
    """Return all files that belong to a calibration."""
    return _format_of(path).files(path)


def lacks_sizes(path: Path) -> bool:
    """Return whether a calibration's format lacks the image sizes."""
    return _format_of(path).lacks_sizes
