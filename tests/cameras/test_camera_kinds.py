"""Calibrations as programs write them: names that collide, lenses that are not read, files that lack or add something.

The cameras that every readable file states are the same three; what is read is compared with their projections.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from camera_writers import CAMERAS, NAMES, SIZE, colmap, metashape, nerfstudio, same, stored

from jawusd.base.errors import CalibrationError, JawusdError
from jawusd.cameras import files as camera_files
from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.cameras.files import CameraFormat, calibration_files, lacks_sizes, load_cameras_file, names_of_labels
from jawusd.pipeline import cameras as capture_cameras
from jawusd.rig.cameras import read_cameras


def toml(tmp_path):
    save_calibration(tmp_path / "plain.toml", CAMERAS)
    return (tmp_path / "plain.toml").read_text()


# ----------------------------------------------------------------------------------------------------------- names

LABELS = {
    ("front.jpg", "left.jpg", "right.jpg"): ("front", "left", "right"),
    ("cam.01", "cam.02", "cam.03"): ("cam.01", "cam.02", "cam.03"),
    ("cam.01", "cam.02", "side"): ("cam.01", "cam.02", "side"),
    ("a.left.png", "a.right.png", "b.png"): ("a.left", "a.right", "b"),
    ("0001.jpg", "0001.png", "0002.png"): ("0001.jpg", "0001.png", "0002"),
    ("front/0001.jpg", "left/0001.jpg", "right/0001.jpg"): ("front_0001", "left_0001", "right_0001"),
    ("D:\\x\\front.tif", "D:\\x\\left.tif", "D:\\x\\right.tif"): ("front", "left", "right"),
    ("0001", "0001", "0001"): 'has 3 cameras with the same label: "0001", "0001", "0001"',
    ("a.png", "a.png", "b.png"): 'has 2 cameras with the same label: "a.png", "a.png"',
    ("left/1.png", "left/1.png", "right/1.png"): "has 2 cameras with the same label",
}


@pytest.mark.parametrize("labels", LABELS)
def test_labels_become_names_of_their_own(tmp_path, labels):
    (tmp_path / "a.xml").write_text(metashape(labels))
    rows = [f"{label},1,2,{k},10,20,30,35" for k, label in enumerate(labels)]
    (tmp_path / "a.csv").write_text("\n".join(["#name,x,y,alt,heading,pitch,roll,f", *rows, ""]))
    wanted = LABELS[labels]
    if isinstance(wanted, str):
        for name in ("a.xml", "a.csv"):
            with pytest.raises(CalibrationError, match=rf"a\.\w+: {wanted}"):
                load_cameras_file(tmp_path / name, sizes=dict.fromkeys(("0001", "a", "b", "1"), SIZE))
        return
    order = np.argsort(wanted)
    same(load_cameras_file(tmp_path / "a.xml"), sorted(wanted), [CAMERAS[k] for k in order])
    found = load_cameras_file(tmp_path / "a.csv", sizes=dict.fromkeys(wanted, SIZE))
    assert [camera.name for camera in found] == sorted(wanted) and len({c.T_cam_world.tobytes() for c in found}) == 3


def test_a_capture_names_cameras_whose_labels_have_dots_in_its_own_letters(tmp_path, monkeypatch):
    (tmp_path / "a.xml").write_text(metashape(("cam.01", "cam.02", "cam.03")))
    sources = [SimpleNamespace(name=f"cam_0{k}", clip=None, masks=None) for k in (1, 2, 3)]
    capture = SimpleNamespace(calibration=tmp_path / "a.xml", calibration_unit_mm=1.0, cameras=sources, folder=tmp_path)
    same(capture_cameras.load_cameras(capture), ("cam_01", "cam_02", "cam_03"))
    sources[0].name = "cam_09"
    with pytest.raises(CalibrationError, match=r"lacks camera cam_09 of the capture; it contains cam\.01, cam\.02"):
        capture_cameras.load_cameras(capture)


@pytest.mark.parametrize("suffix", [".yaml", ".xml", ".json"])
def test_two_files_of_one_camera_that_differ_are_named(tmp_path, suffix):
    for camera in CAMERAS:
        (tmp_path / f"{camera.name}.yml").write_text(stored(camera, ".yml"))
    (tmp_path / f"left{suffix}").write_text(stored(CAMERAS[1], suffix))
    same(load_cameras_file(tmp_path))  # says the same
    (tmp_path / f"left{suffix}").write_text(stored(replace(CAMERAS[2], name="left"), suffix))
    with pytest.raises(CalibrationError, match=r"have different values of R for camera left"):
        load_cameras_file(tmp_path)


def test_two_cameras_under_the_same_keys_of_one_file_are_not_one(tmp_path):
    inner = "".join(f"{c.name}:\n" + stored(c, ".yml").split("---\n")[1].replace("\n", "\n   ") for c in CAMERAS)
    (tmp_path / "all.yml").write_text("%YAML:1.0\n---\n" + inner)
    with pytest.raises(CalibrationError, match=r'all\.yml: has "camera_matrix" twice'):
        load_cameras_file(tmp_path / "all.yml")


def test_cameras_of_a_stage_with_equal_names_are_named_by_their_paths(tmp_path):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    for path in ("/a/cam", "/b/cam", "/b/other", "/top"):
        UsdGeom.Camera.Define(stage, path)
    UsdGeom.Camera(stage.GetPrimAtPath("/top")).CreateProjectionAttr("orthographic")
    stage.Save()
    sizes = dict.fromkeys(("a_cam", "b_cam", "other"), SIZE)
    assert [camera.name for camera in read_cameras(tmp_path / "shot.usda", lambda: sizes)] == [
        "a_cam",
        "b_cam",
        "other",
    ]


# ---------------------------------------------------------------------------------------------------- lens models

YAML_MODELS = ["equidistant", "fisheye", "omni-radtan", "inverse_brown_conrady"]
YAML_MODELS = [f"distortion_model: {model}" for model in YAML_MODELS]
YAML_MODELS += ['model_type: "KANNALA_BRANDT"', "fisheye_model: 1", "camera_model: omni", "xi: 1.2"]


@pytest.mark.parametrize("model", YAML_MODELS)
@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_lens_models_of_opencv_storage_that_are_not_read_are_named(tmp_path, model, suffix):
    key, value = (part.strip().strip('"') for part in model.split(":"))
    said = {
        ".yml": f"{model}\n",
        ".xml": f"<{key}>{value}</{key}>",
        ".json": f'"{key}": "{value}",',
    }[suffix]
    (tmp_path / f"left{suffix}").write_text(stored(CAMERAS[1], suffix, before=said))
    with pytest.raises(CalibrationError, match=rf"left\{suffix}: .*{key} = {value}, a lens model that is not"):
        load_cameras_file(tmp_path / f"left{suffix}")


@pytest.mark.parametrize(
    "model",
    [
        "distortion_model: plumb_bob",
        "distortion_model: rational_polynomial",
        "fisheye_model: 0",
        "camera_model: Basler acA1300",
        "camera_model: pinhole",
    ],
)
def test_lens_models_that_are_opencvs_are_read(tmp_path, model):
    (tmp_path / "left.yml").write_text(stored(CAMERAS[1], ".yml", before=f"{model}\n"))
    same(load_cameras_file(tmp_path / "left.yml"), ["left"], CAMERAS[1:2])


def test_lens_models_of_other_files_that_are_not_read_are_named(tmp_path):
    from pxr import Sdf, Usd, UsdGeom

    (tmp_path / "p3.xml").write_text(metashape(extra="<p3>0.01</p3>"))
    plain = toml(tmp_path)
    (tmp_path / "a.toml").write_text(plain.replace("size =", 'distortion_model = "kannala_brandt4"\nsize =', 1))
    (tmp_path / "b.toml").write_text(plain.replace("size =", "fisheye = true\nsize =", 1))
    (tmp_path / "a.json").write_text(nerfstudio(camera_model="OPENCV_FISHEYE"))
    (tmp_path / "b.json").write_text(nerfstudio(is_fisheye=True))
    models = {"p3.xml": "p3 = 0.01; it must be 0", "a.toml": "distortion_model = kannala_brandt4"}
    models |= {"b.toml": "fisheye = True", "a.json": "OPENCV_FISHEYE", "b.json": "only perspective models"}
    for model in ("OPENCV_FISHEYE", "FOV", "THIN_PRISM_FISHEYE", "SIMPLE_RADIAL_FISHEYE"):
        colmap(tmp_path / model, [""] * 3, model=model)
        models[model] = f"model {model}; it must be one of"
    for name, said in models.items():
        with pytest.raises(CalibrationError, match=said):
            load_cameras_file(tmp_path / name)
    for name, value in (("cameraProjectionType", "fisheyePolynomial"), ("omni:lensdistortion:model", "opencvFisheye")):
        stage = Usd.Stage.CreateInMemory()
        camera = UsdGeom.Camera.Define(stage, "/cam").GetPrim()
        camera.CreateAttribute(name, Sdf.ValueTypeNames.Token).Set(value)
        stage.Export(str(tmp_path / "a.usda"))
        with pytest.raises(CalibrationError, match=rf"cam: has {name} = {value}"):
            read_cameras(tmp_path / "a.usda", lambda: {"cam": SIZE})


# ------------------------------------------------------------------------------------------------------- COLMAP

POINT_LINES = {
    "no line of points": [None, None, None],
    "empty lines": ["", "", ""],
    "points": ["1.5 2.5 -1", "1.5 2.5 7 3.25 4.75 -1", "1 2 3 4 5 6 7 8 9"],
    "empty and none": ["", None, ""],
    "points and none": ["1.5 2.5 -1 3 4 5", None, "1 2 -1"],
    "blank lines between": ["\n", "", "\n\n"],
}


@pytest.mark.parametrize("kind", POINT_LINES)
def test_every_image_of_colmap_is_read(tmp_path, kind):
    same(load_cameras_file(colmap(tmp_path / "m", POINT_LINES[kind])))
    names = ["front view.png", "left 2.png", "right.png"]
    found = load_cameras_file(colmap(tmp_path / "n", POINT_LINES[kind], names=names))
    same(found, ("front view", "left 2", "right"))


@pytest.mark.parametrize(
    ("points", "names", "said"),
    [
        (["1.5 2.5 -1 8", "", ""], None, '"1.5 2.5 -1 8" is not an image'),
        (["", "1 2", ""], None, '"1 2" is not an image'),
        (["", "", ""], ["a/front.png", "a/left.png", "a/right.png"], "camera a has different poses"),
        (["", "", ""], ["a.png", "a.png", "b.png"], "camera a has different poses"),
    ],
)
def test_lines_of_colmap_that_are_no_image_and_images_of_one_name_are_refused(tmp_path, points, names, said):
    with pytest.raises(CalibrationError, match=said):
        load_cameras_file(colmap(tmp_path, points, names=names))


def test_images_of_a_camera_with_different_lenses_are_refused(tmp_path):
    lens = "2 PINHOLE 1280 720 1300 1300 640 360\n"
    colmap(tmp_path, [""] * 3, names=["a/1.png", "b/1.png", "c/1.png"], ids=[1, 2, 1], lens=lens)
    assert [camera.K[0, 0] for camera in load_cameras_file(tmp_path)] == [1400, 1300, 1400]
    text = (tmp_path / "images.txt").read_text().splitlines()
    again = text[1].replace(" 1 a/1.png", " 2 a/2.png")
    (tmp_path / "images.txt").write_text("\n".join([*text, again, ""]))
    with pytest.raises(CalibrationError, match="camera a has different lenses in different images"):
        load_cameras_file(tmp_path)


def test_images_that_are_fewer_than_the_header_counts_are_named(tmp_path):
    colmap(tmp_path, [""] * 3)
    text = (tmp_path / "images.txt").read_text()
    for count in (3, 2, 4):
        (tmp_path / "images.txt").write_text(f"# Number of images: {count}, mean observations per image: 0\n{text}")
        if count <= 3:
            same(load_cameras_file(tmp_path))
    with pytest.raises(CalibrationError, match=r"images\.txt: is truncated: it has 3 of the 4 images"):
        load_cameras_file(tmp_path)


def test_a_binary_model_of_colmap_says_how_to_make_it_text(tmp_path):
    for name in ("cameras.bin", "images.bin"):
        (tmp_path / name).write_bytes(bytes(8))
    for path in (tmp_path, tmp_path / "cameras.bin"):
        with pytest.raises(CalibrationError, match="binary"):
            load_cameras_file(path)


# ------------------------------------------------------------------------------------------- OpenCV, byte order marks


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml", ".json"])
def test_opencv_storage_of_any_kind_is_read(tmp_path, suffix):
    for camera in CAMERAS:
        text = stored(camera, suffix.replace("yaml", "yml"), key="Camera_Matrix")
        (tmp_path / f"{camera.name}{suffix}").write_text(text)
    (tmp_path / "notes.json").write_text("{}")
    (tmp_path / "other.xml").write_text("<note/>")
    same(load_cameras_file(tmp_path))
    same(load_cameras_file(tmp_path / f"left{suffix}"), ["left"], CAMERAS[1:2])
    assert calibration_files(tmp_path) == [tmp_path / f"{name}{suffix}" for name in NAMES]
    assert lacks_sizes(tmp_path) and lacks_sizes(tmp_path / f"left{suffix}")


NOT_NEEDED = {
    ".Nan in a matrix": "errors: !!opencv-matrix\n   rows: 2\n   cols: 1\n   dt: f\n   data: [ 0.2, .Nan ]\n",
    ".Inf in a matrix": "errors: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: d\n   data: [ -.Inf, .Inf ]\n",
    "words in a matrix": "errors: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: u\n   data: [ a, b ]\n",
    "a matrix that is too short": "errors: !!opencv-matrix\n   rows: 3\n   cols: 2\n   dt: d\n   data: [ 1. ]\n",
    "a scalar": "avg_reprojection_error: .Nan\n",
    "text": 'calibration_time: "Fri 1 May"\nt: later\n',
}


@pytest.mark.parametrize("kind", NOT_NEEDED)
def test_values_that_no_camera_needs_do_not_matter(tmp_path, kind):
    for camera in CAMERAS:
        (tmp_path / f"{camera.name}.yml").write_text(stored(camera, ".yml", after=NOT_NEEDED[kind]))
    same(load_cameras_file(tmp_path))


@pytest.mark.parametrize("value", [".Nan", ".Inf", "-.Inf"])
def test_needed_values_that_are_not_finite_are_named(tmp_path, value):
    text = stored(CAMERAS[1], ".yml")
    (tmp_path / "left.yml").write_text(text.replace("1400.", value, 1))
    with pytest.raises(CalibrationError, match='"camera_matrix" has a value that is not finite'):
        load_cameras_file(tmp_path / "left.yml")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_byte_order_marks_matter_to_no_reader(tmp_path, encoding):
    def write(name, text):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(text.replace("\n", "\r\n").encode(encoding))
        return tmp_path / name

    same(load_cameras_file(write("a.xml", metashape())))
    same(load_cameras_file(write("a.json", nerfstudio())))
    same(load_cameras_file(write("a.toml", toml(tmp_path))))
    for camera in CAMERAS:
        write(f"cv/{camera.name}.yml", stored(camera, ".yml"))
    same(load_cameras_file(tmp_path / "cv"))
    plain = colmap(tmp_path / "plain", [None] * 3)
    for name in ("cameras.txt", "images.txt"):
        write(f"colmap/{name}", (plain / name).read_text().split("\n", 1)[1])
    same(load_cameras_file(tmp_path / "colmap"))
    same(load_calibration(tmp_path / "a.toml"))


# ------------------------------------------------------------------------------------------------------- registry


def test_a_new_format_is_a_module(tmp_path, monkeypatch):
    """What makes a format known is its FORMAT: here one that is put in front of the others."""
    (tmp_path / "a.rig").write_text("")
    with pytest.raises(JawusdError):
        load_cameras_file(tmp_path / "a.rig")
    mine = CameraFormat(lambda path: path.suffix == ".rig", lambda path, sizes: CAMERAS, lacks_sizes=True)
    known = camera_files._formats()
    monkeypatch.setattr(camera_files, "_formats", lambda: [*known, mine])
    same(load_cameras_file(tmp_path / "a.rig"))
    assert lacks_sizes(tmp_path / "a.rig") and calibration_files(tmp_path / "a.rig") == [tmp_path / "a.rig"]


def test_a_folder_without_cameras_says_what_is_read(tmp_path):
    (tmp_path / "readme.txt").write_text("nothing")
    with pytest.raises(CalibrationError, match="a folder without cameras in a supported format"):
        load_cameras_file(tmp_path)


def test_no_labels_need_no_names():
    assert names_of_labels([]) == []
