"""Cameras of other programs: 1,000 points through the model that each states, and through the camera that was read.

The structure of the files follows samples in public repositories, with other numbers: cameras.xml of
bitbyt3r/metashape-automation (Metashape), tests/testfiles/img/IMG_8834.xmp of KU-Leuven-Geomatics/geomapi
(RealityScan), tests/sessions/4_cam_recording/camera_array.toml of mprib/caliscope, intri.yml and extri.yml of
zhu-lebin/trackmesh_gui (EasyMocap), data/intrinsics.yml and data/extrinsics.yml of PRiME-project/PRiMEStereoMatch
(OpenCV's stereo sample).
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from jawusd.base.errors import CalibrationError, FormatError, JawusdError, RigError
from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.cameras.colmap import save_colmap
from jawusd.cameras.files import calibration_files, load_cameras_file
from jawusd.cli.main import app
from jawusd.geometry import Camera, make_transform
from jawusd.geometry.camera import opencv_radial
from jawusd.rig.cameras import read_cameras, write_camera_stage

SIZE = (1920, 1080)
RNG = np.random.default_rng(5)
PIXEL = 0.05  # what readings of a stated model may differ by


def points(R, centre, half=0.35):
    """Return world points that a camera with axes R (world to camera: right, down, forward) sees, shape (1000, 3)."""
    z = RNG.uniform(0.3, 1.2, 1000)
    own = np.column_stack([z * RNG.uniform(-half, half, 1000), z * RNG.uniform(-0.6 * half, 0.6 * half, 1000), z])
    return own @ R + centre


POSES = {
    "left": (Rotation.from_euler("xyz", [4, -20, 3], degrees=True).as_matrix(), np.array([-0.4, 0.1, -0.8])),
    "right": (Rotation.from_euler("xyz", [-7, 25, -5], degrees=True).as_matrix(), np.array([0.5, -0.05, -0.7])),
}


def away_px(cameras, project):
    """Return the largest distance of the pixels of points by cameras in mm from those of a model in metres."""
    assert [camera.name for camera in cameras] == ["left", "right"]
    worst = 0.0
    for camera in cameras:
        R, centre = POSES[camera.name]
        world = points(R, centre)
        own = (world - centre) @ R.T
        wanted = project(camera.name, own[:, 0] / own[:, 2], own[:, 1] / own[:, 2])
        worst = max(worst, np.abs(camera.project(1000.0 * world) - wanted).max())
    return worst


METASHAPE = {"f": 2100.0, "cx": 12.5, "cy": -7.25, "b1": -3.0, "b2": 1.5}
METASHAPE |= {"k1": -0.11, "k2": 0.07, "k3": -0.01, "p1": 0.0012, "p2": -0.0007}


def metashape(values):
    """Return the manual's projection, from the corner of the first pixel, as pixels counted from its middle."""

    def project(_, x, y):
        r2 = x * x + y * y
        k = 1 + sum(values.get(f"k{n}", 0.0) * r2**n for n in (1, 2, 3, 4))
        dx = x * k + values["p1"] * (r2 + 2 * x * x) + 2 * values["p2"] * x * y
        dy = y * k + values["p2"] * (r2 + 2 * y * y) + 2 * values["p1"] * x * y
        u = SIZE[0] / 2 + values["cx"] + dx * values["f"] + dx * values["b1"] + dy * values["b2"]
        v = SIZE[1] / 2 + values["cy"] + dy * values["f"]
        return np.column_stack([u, v]) - 0.5

    return project


def spaced(value):
    return " ".join(repr(float(v)) for v in np.ravel(value))


def metashape_xml(values, scale=1.0, turn=None, shift=None):
    """Return the XML of Export Cameras: two sensors, a chunk that is turned, shifted and scaled."""
    turn, shift = np.eye(3) if turn is None else turn, np.zeros(3) if shift is None else shift
    cameras = ""
    for number, (name, (R, centre)) in enumerate(POSES.items()):
        inside = make_transform(turn.T @ R.T, turn.T @ (centre - shift) / scale)
        cameras += f'<camera id="{number}" sensor_id="{number}" component_id="0" label="{name}.jpg">'
        cameras += f"<transform>{spaced(inside)}</transform></camera>"
    inner = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    size = '<resolution width="1920" height="1080"/>'
    sensor = (
        f'<sensor id="{{0}}" label="s{{0}}" type="frame">{size}<calibration type="frame" class="initial">{size}<f>1</f>'
        f'</calibration><calibration type="frame" class="adjusted">{size}{inner}</calibration></sensor>'
    )
    placed = f"<transform><rotation>{spaced(turn)}</rotation><translation>{spaced(shift)}</translation>"
    placed += f"<scale>{scale!r}</scale></transform>"
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1"><sensors>'
        f'{sensor.format(0)}{sensor.format(1)}</sensors><components><component id="0">{placed}</component></components>'
        f'<cameras>{cameras}<camera id="7" sensor_id="0" label="lost.jpg"/></cameras>{placed}</chunk></document>'
    )


@pytest.mark.parametrize("k4", [0.0, 0.02])
def test_metashape(tmp_path, k4):
    values = {**METASHAPE, "k4": k4}
    turn = Rotation.from_euler("xyz", [30, 10, -70], degrees=True).as_matrix()
    (tmp_path / "cameras.xml").write_text(metashape_xml(values, 0.37, turn, np.array([3.0, 1.0, -2.0])))
    cameras = load_cameras_file(tmp_path / "cameras.xml", 1000.0)
    assert away_px(cameras, metashape(values)) < PIXEL
    assert cameras[0].size_px == SIZE and cameras[0].distortion.size == (5 if k4 == 0 else 8)


def test_metashape_files_that_cannot_be_read(tmp_path):
    path = tmp_path / "cameras.xml"
    for text, said in (
        (metashape_xml(METASHAPE).replace("<transform>", "<t>").replace("</transform>", "</t>"), "no aligned cameras"),
        (
            metashape_xml(METASHAPE).replace('type="frame" class="adjusted"', 'type="fisheye" class="adjusted"'),
            "fisheye",
        ),
        (metashape_xml({**METASHAPE, "f": "x"}).replace("'x'", "x"), "is not a list of numbers"),
        (metashape_xml(METASHAPE).replace('sensor_id="1"', 'sensor_id="9"'), "refers to a sensor"),
        ('<!DOCTYPE d [<!ENTITY a "b">]><document/>', "document type"),
        ("<document>", "cannot be read as XML"),
    ):
        path.write_text(text)
        with pytest.raises(CalibrationError, match=said):
            load_cameras_file(path)


RC = {"f": 38.0, "u": 0.004, "v": -0.006, "k": (-0.12, 0.08, -0.02, 0.0), "t": (0.0009, -0.0006)}


def realityscan(_, x, y):
    """Project as Epic's reference states it: lengths of the longer side from the middle of the picture."""
    r2 = x * x + y * y
    k = 1 + sum(value * r2 ** (n + 1) for n, value in enumerate(RC["k"]))
    t1, t2 = RC["t"]
    dx = x * k + 2 * t1 * x * y + t2 * (r2 + 2 * x * x)
    dy = y * k + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
    side = max(SIZE)
    u = (RC["f"] / 36 * dx + RC["u"]) * side + SIZE[0] / 2
    v = (RC["f"] / 36 * dy + RC["v"]) * side + SIZE[1] / 2
    return np.column_stack([u, v]) - 0.5


def xmp(R, centre):
    terms = " ".join(map(str, (*RC["k"], *RC["t"])))
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" '
        f'xcr:DistortionModel="brown3t2" xcr:FocalLength35mm="{RC["f"]}" xcr:Skew="0" xcr:AspectRatio="1" '
        f'xcr:PrincipalPointU="{RC["u"]}" xcr:PrincipalPointV="{RC["v"]}">'
        f"<xcr:Rotation>{' '.join(map(repr, map(float, R.ravel())))}</xcr:Rotation>"
        f"<xcr:Position>{' '.join(map(repr, map(float, centre)))}</xcr:Position>"
        f"<xcr:DistortionCoeficients>{terms}</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def test_realityscan_xmp(tmp_path):
    for name, (R, centre) in POSES.items():
        (tmp_path / f"{name}.xmp").write_text(xmp(R, centre))
    sizes = dict.fromkeys(POSES, SIZE)
    assert away_px(load_cameras_file(tmp_path, 1000.0, sizes), realityscan) < PIXEL
    assert away_px(load_cameras_file(tmp_path / "left.xmp", 1000.0, sizes), realityscan) < PIXEL
    assert [path.name for path in calibration_files(tmp_path)] == ["left.xmp", "right.xmp"]
    with pytest.raises(CalibrationError, match="the image size is not in the file"):
        load_cameras_file(tmp_path, 1000.0, {"left": SIZE})
    for square, bent in (('Skew="0"', 'Skew="0.01"'), ('AspectRatio="1"', 'AspectRatio="1.2"')):
        (tmp_path / "left.xmp").write_text(xmp(*POSES["left"]).replace(square, bent))
        with pytest.raises(CalibrationError, match=bent.split("=")[0]):
            load_cameras_file(tmp_path, 1000.0, sizes)
    (tmp_path / "left.xmp").write_text(xmp(*POSES["left"]).replace("brown3t2", "division"))
    with pytest.raises(CalibrationError, match='distortion model "division"'):
        load_cameras_file(tmp_path, 1000.0, sizes)


def test_realityscan_csv(tmp_path):
    lines = ["#cameras 2", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for name, (R, centre) in POSES.items():
        axes = R.T @ np.diag([1.0, -1.0, -1.0])  # right, up, backward in the world
        heading, pitch, roll = Rotation.from_matrix(axes).as_euler("ZXY", degrees=True)
        values = (*centre, -heading, pitch, roll, RC["f"], RC["u"], RC["v"], *RC["k"], *RC["t"])
        lines.append(f"{name}.jpeg," + ",".join(repr(float(value)) for value in values))
    path = tmp_path / "cameras.csv"
    path.write_text("\n".join(lines) + "\n")
    sizes = dict.fromkeys(POSES, SIZE)
    assert away_px(load_cameras_file(path, 1000.0, sizes), realityscan) < PIXEL
    path.write_text("\n".join(lines).replace("heading", "yaw"))
    with pytest.raises(CalibrationError, match="no column heading"):
        load_cameras_file(path, 1000.0, sizes)
    path.write_text("\n".join(lines).replace("38.0", "wide"))
    with pytest.raises(FormatError, match='line 3, column "f": "wide" is not a number'):
        load_cameras_file(path, 1000.0, sizes)
    short = ",".join(lines[2].split(",")[:7])
    path.write_text(f"{'note,' * 8}{lines[1].lstrip('#')}\n{'1,' * 8}{short}\n")
    with pytest.raises(FormatError, match="line 2 has 15 values, but the header has 24 columns"):
        load_cameras_file(path, 1000.0, sizes)


K = np.array([[2050.0, 0, 970.0], [0, 2060.0, 531.0], [0, 0, 1]])
LENS = (-0.2, 0.09, 0.0011, -0.0008, 0.01)


def opencv(_, x, y):
    cv2 = pytest.importorskip("cv2")
    own = np.column_stack([x, y, np.ones_like(x)])
    return cv2.projectPoints(own, np.zeros(3), np.zeros(3), K, np.array(LENS))[0][:, 0]


def test_pose2sim_and_caliscope(tmp_path):
    for table, extra in (("int_{}_img", 'name = "{}"'), ("cameras.{}", "port = 1\nrotation_count = 0\nerror = 0.3")):
        text = ""
        for name, (R, centre) in POSES.items():
            turn, t = Rotation.from_matrix(R).as_rotvec().tolist(), (-R @ centre).tolist()
            text += f"[{table.format(name)}]\n{extra.format(name)}\nsize = [1920.0, 1080.0]\nmatrix = {K.tolist()}\n"
            text += f"distortions = {list(LENS)}\nrotation = {turn}\ntranslation = {t}\nfisheye = false\n"
        (tmp_path / "Calib.toml").write_text(text + "[metadata]\nadjusted = false\nerror = 0.0\n")
        cameras = load_cameras_file(tmp_path / "Calib.toml", 1000.0)
        named = [Camera(c.name.removeprefix("cam_"), c.size_px, c.K, c.distortion, c.T_cam_world) for c in cameras]
        assert away_px(named, opencv) < PIXEL


def matrix(name, value):
    value = np.atleast_2d(value)
    rows, cols = value.shape
    data = ", ".join(f"{v:.17g}" for v in value.ravel())
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n"


def test_opencv_yaml_by_camera_in_one_file_and_as_a_stereo_pair(tmp_path):
    cv2 = pytest.importorskip("cv2")
    folder = tmp_path / "each"
    folder.mkdir()
    for name, (R, centre) in POSES.items():
        file = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)  # OpenCV's own writer
        file.write("image_width", 1920)
        file.write("image_height", 1080)
        for key, value in (("camera_matrix", K), ("distortion_coefficients", np.array([LENS])), ("R", R)):
            file.write(key, value)
        file.write("T", (-R @ centre)[:, None])
        file.release()
    assert away_px(load_cameras_file(folder, 1000.0), opencv) < PIXEL
    intri, extri = "%YAML:1.0\n---\n", "%YAML:1.0\n---\n"
    for name, (R, centre) in POSES.items():
        intri += matrix(f"K_{name}", K) + matrix(f"dist_{name}", np.array(LENS))
        turn = Rotation.from_matrix(R).as_rotvec()[:, None]
        extri += matrix(f"R_{name}", turn) + matrix(f"Rot_{name}", R) + matrix(f"T_{name}", (-R @ centre)[:, None])
    (tmp_path / "intri.yml").write_text(intri)
    (tmp_path / "extri.yml").write_text(extri)
    assert away_px(load_cameras_file(tmp_path / "intri.yml", 1000.0, dict.fromkeys(POSES, SIZE)), opencv) < PIXEL
    # A camera whose lens alone is known is none of the cameras.
    (tmp_path / "intri.yml").write_text(intri + matrix("K_third", K) + matrix("dist_third", np.array(LENS)))
    assert away_px(load_cameras_file(tmp_path / "intri.yml", 1000.0, dict.fromkeys(POSES, SIZE)), opencv) < PIXEL
    R, t = Rotation.from_euler("y", 30, degrees=True).as_matrix(), np.array([0.2, 0, 0.05])
    pair = "".join(matrix(f"{key}{n}", value) for n in (1, 2) for key, value in (("M", K), ("D", np.array(LENS))))
    (tmp_path / "pair.yml").write_text("%YAML:1.0\n---\n" + pair + matrix("R", R) + matrix("T", t[:, None]))
    first, second = load_cameras_file(tmp_path / "pair.yml", 1000.0, {"1": SIZE, "2": SIZE})
    assert np.allclose(first.T_cam_world, np.eye(4))
    assert np.allclose(second.T_cam_world, make_transform(R, 1000 * t))
    # As OpenCV's stereo_calib writes it: two files, and the rotations of the rectified pair beside that of the cameras.
    sample = tmp_path / "sample"
    sample.mkdir()
    (sample / "intrinsics.yml").write_text("%YAML:1.0\n---\n" + pair)
    rectified = matrix("R1", np.eye(3)[[1, 2, 0]]) + matrix("R2", np.eye(3)) + matrix("P1", np.ones((3, 4)))
    (sample / "extrinsics.yml").write_text("%YAML:1.0\n---\n" + matrix("R", R) + matrix("T", t[:, None]) + rectified)
    for path in (sample, sample / "intrinsics.yml"):
        first, second = load_cameras_file(path, 1000.0, {"1": SIZE, "2": SIZE})
        assert np.allclose(first.T_cam_world, np.eye(4))
        assert np.allclose(second.T_cam_world, make_transform(R, 1000 * t))
    (tmp_path / "half.yml").write_text("%YAML:1.0\n---\n" + matrix("camera_matrix", K))
    with pytest.raises(CalibrationError, match="camera half has no R"):
        load_cameras_file(tmp_path / "half.yml", 1.0)


def example():
    cameras = []
    for name, (R, centre) in POSES.items():
        cameras.append(Camera(name, SIZE, K, np.array(LENS), make_transform(R, -1000 * R @ centre)))
    return cameras


def same(found, wanted):
    for a, b in zip(found, wanted, strict=True):
        world = 1000 * points(*POSES[b.name])
        assert a.name == b.name and a.size_px == b.size_px
        assert np.abs(a.project(world) - b.project(world)).max() < 1e-3


def test_what_is_written_is_read_as_it_was(tmp_path):
    wanted = example()
    save_calibration(tmp_path / "a.toml", wanted)
    same(load_calibration(tmp_path / "a.toml"), wanted)
    save_colmap(tmp_path / "model", load_cameras_file(tmp_path / "a.toml"))
    same(load_cameras_file(tmp_path / "model"), wanted)
    write_camera_stage(tmp_path / "a.usda", load_cameras_file(tmp_path / "model"))
    same(read_cameras(tmp_path / "a.usda", dict), wanted)


def test_cameras_of_any_stage(tmp_path):
    """A camera in metres, z up, below a turned parent, as a DCC writes it: size and lens are not in the file."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.Xform.Define(stage, "/rig").AddScaleOp().Set(Gf.Vec3f(2.0))
    for name, (R, centre) in POSES.items():
        camera = UsdGeom.Camera.Define(stage, f"/rig/{name}")
        camera.CreateFocalLengthAttr(35.0)
        camera.CreateHorizontalApertureAttr(36.0)
        camera.CreateVerticalApertureAttr(20.25)
        camera.CreateHorizontalApertureOffsetAttr(0.3)
        T = make_transform(R.T @ np.diag([1.0, -1, -1]), 100 * centre / 2)
        camera.AddTransformOp().Set(Gf.Matrix4d(*T.T.ravel().tolist()))
    stage.Save()

    def pinhole(_, x, y):
        # UsdGeomCamera: the aperture is shifted by its offset, so the middle of the picture by its opposite.
        return np.column_stack([960 + (35 * x - 0.3) / 36 * 1920, 540 + 35 * y / 20.25 * 1080]) - 0.5

    found = sorted(read_cameras(tmp_path / "shot.usda", lambda: dict.fromkeys(POSES, SIZE)), key=lambda c: c.name)
    assert away_px(found, pinhole) < PIXEL
    with pytest.raises(CalibrationError, match=r"has no jaw:imageSize"):
        read_cameras(tmp_path / "shot.usda", dict)
    Usd.Stage.CreateNew(str(tmp_path / "none.usda")).Save()
    with pytest.raises(RigError, match="has no perspective camera"):
        read_cameras(tmp_path / "none.usda", dict)


def test_alembic_needs_its_plugin(tmp_path):
    from pxr import Sdf

    if Sdf.FileFormat.FindByExtension("abc") is not None:
        pytest.skip("this OpenUSD reads Alembic")
    (tmp_path / "cameras.abc").write_bytes(b"Ogawa\xff\x00\x01")
    with pytest.raises(RigError, match=r"cameras\.abc: is an Alembic file; .* usdAbc, .* Export the cameras as USD"):
        read_cameras(tmp_path / "cameras.abc", dict)


def test_lenses_that_opencv_cannot_write():
    K = np.array([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]])
    assert opencv_radial(K, SIZE, np.array([-0.1, 0.05, 0.01, 0.0]))[1] == 0
    assert opencv_radial(K, SIZE, np.array([-0.1, 0.05, 0.01, 0.02]))[1] < PIXEL
    assert opencv_radial(K, SIZE, np.array([-2.0, 5.0, -9.0, 30.0]))[1] > PIXEL


def test_the_command(tmp_path):
    save_calibration(tmp_path / "a.toml", example())
    for out in ("model", "b.toml", "b.usda"):
        done = CliRunner().invoke(app, ["cameras", str(tmp_path / "a.toml"), "-o", str(tmp_path / out)])
        assert done.exit_code == 0 and "left: 1920 x 1080 px, f 2050.0 px, 5 coefficients" in done.stdout
        assert "note:" not in done.stdout
    same(load_cameras_file(tmp_path / "b.toml"), example())
    for name, (R, centre) in POSES.items():
        (tmp_path / "xmp").mkdir(exist_ok=True)
        (tmp_path / "xmp" / f"{name}.xmp").write_text(xmp(R, centre))
    metres = ["cameras", str(tmp_path / "xmp"), "-o", str(tmp_path / "m"), "--size", "1920x1080"]
    close = CliRunner().invoke(app, metres)
    assert "all cameras are within 0.918 mm; if the source is in metres, use --unit-mm 1000" in close.stdout
    words = ["cameras", str(tmp_path / "xmp"), "-o", str(tmp_path / "c.toml"), "--unit-mm", "1000"]
    assert isinstance(CliRunner().invoke(app, words).exception, JawusdError)
    assert CliRunner().invoke(app, [*words, "--size", "1920x1080"]).exit_code == 0
    assert away_px(load_cameras_file(tmp_path / "c.toml"), realityscan) < PIXEL
    assert CliRunner().invoke(app, [*words, "--size", "big"]).exit_code == 2
    assert isinstance(CliRunner().invoke(app, [*words[:3], str(tmp_path / "c.abc")]).exception, JawusdError)
