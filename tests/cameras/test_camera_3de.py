"""Cameras of 3DEqualizer, against the published models solved by scipy, and files that are wrong.

The structure of the files follows lib/cppbind/mmlens/tests/test_file_3de_radial_std_deg4_1.nk and its neighbours in
david-cattermole/mayaMatchMoveSolver (LD nodes), the export script in NyanNyanGringo/match-move-exporter (Camera nodes),
and the reader of lens files in eoyilmaz/anima; the numbers are made up.
"""

import numpy as np
import pytest
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from jawusd.base.errors import CalibrationError
from jawusd.cameras.calibration import load_calibration, save_calibration
from jawusd.cameras.colmap import save_colmap
from jawusd.cameras.files import calibration_files, lacks_sizes, load_cameras_file

SIZE = (1920, 1080)
BACK, FOCAL, OFFSET = (3.6, 2.025), 3.5, (0.02, -0.013)  # cm
ANGLES, PLACE = (-7.0, 20.0, 3.0), np.array([12.0, 3.0, 55.0])  # degrees about x, y, z; cm
HALF = np.hypot(*BACK) / 2
PIXEL = 0.05

CLASSIC, RADIAL = "3DE Classic LD Model", "3DE4 Radial - Standard, Degree 4"
BROWN, OPENCV = "3DE4 Brown-Conrady, Degree 6/2", "OpenCV Radial Degree 6, Decentered Degree 2"
NAMES = {
    CLASSIC: ["Distortion", "Anamorphic Squeeze", "Curvature X", "Curvature Y", "Quartic Distortion"],
    RADIAL: [
        *("Distortion - Degree 2", "U - Degree 2", "V - Degree 2"),
        *("Quartic Distortion - Degree 4", "U - Degree 4", "V - Degree 4"),
        *("Phi - Cylindric Direction", "B - Cylindric Bending"),
    ],
    BROWN: ["C2", "C4", "C6", "T1", "T2"],
    OPENCV: [
        *("Radial Distortion - Degree 2 - k1", "Radial Distortion - Degree 4 - k2", "Decentering Y - Degree 2 - p1"),
        *("Decentering X - Degree 2 - p2", "Radial Distortion - Degree 6 - k3"),
    ],
}


def undistort(model, values, z):
    """Return undistorted points of recorded ones as complex numbers, x right, y up, over half the diagonal."""
    x, y, r2 = z.real, z.imag, np.abs(z) ** 2
    if model == CLASSIC:
        k, squeeze, cx, cy, q = values
        long = k * x**2 + (k + cx) * y**2 + q * r2**2
        high = (k + cy) * x**2 + k * y**2 + q * r2**2
        return x + x * long / squeeze + 1j * (y + y * high)
    if model == BROWN:
        (c2, c4, c6, t1, t2), phi, bend = values, 0.0, 0.0
        shift = complex(t1, t2)
    else:
        c2, u2, v2, c4, u4, v4, phi, bend = values
        c6, shift = 0.0, (u2 + u4 * r2) + 1j * (v2 + v4 * r2)
    # u (r^2 + 2 x^2) + 2 v x y and its pair are 2 r^2 w + z^2 conj(w) with w = u + i v.
    out = z * (1 + c2 * r2 + c4 * r2**2 + c6 * r2**3) + 2 * r2 * shift + z**2 * np.conj(shift)
    along = np.exp(1j * np.deg2rad(phi))
    turned, q = out / along, np.sqrt(1 + bend)
    return along * (turned.real * q + 1j * turned.imag / q)


def recorded(model, values, ideal):
    """Return the recorded points of ideal ones, by a root of the published formula."""

    def away(v):
        z = v[: len(ideal)] + 1j * v[len(ideal) :]
        d = undistort(model, values, z) - ideal
        return np.concatenate([d.real, d.imag])

    found = root(away, np.concatenate([ideal.real, ideal.imag]), method="krylov", options={"fatol": 1e-10})
    assert found.success
    return found.x[: len(ideal)] + 1j * found.x[len(ideal) :]


def seen(model=None, values=(), seed=3):
    """Return 1,000 world points [cm] that the camera sees, and the pixels that 3DEqualizer states for them."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(40, 80, 1000)
    own = np.column_stack([*(rng.uniform(-0.46, 0.46, (2, 1000)) * np.array(BACK)[:, None] / FOCAL * depth), -depth])
    rx, ry, rz = ANGLES
    turn = (
        Rotation.from_euler("y", ry, degrees=True)
        * Rotation.from_euler("x", rx, degrees=True)
        * Rotation.from_euler("z", rz, degrees=True)
    )
    ideal = FOCAL * (own[:, 0] + 1j * own[:, 1]) / depth / HALF
    film = ideal if model is None else recorded(model, values, ideal)
    x, y = HALF * film.real + OFFSET[0], HALF * film.imag + OFFSET[1]  # cm from the middle of the picture
    pixels = np.column_stack([(x / BACK[0] + 0.5) * SIZE[0], (0.5 - y / BACK[1]) * SIZE[1]]) - 0.5
    return turn.apply(own) + PLACE, pixels


def curve(value, frames=3):
    return "{curve i" + "".join(f" x{1000 + n} {value!r}" for n in range(frames)) + " }"


def camera_node(name="left", angles=ANGLES, place=PLACE, **other):
    knobs = {
        "rot_order": "ZXY",
        "translate": " ".join(curve(float(value)) for value in place),
        "rotate": "{" + " ".join(curve(float(value)) for value in angles) + "}",
        "focal": f"{{ i x1001 {10 * FOCAL} x1002 {10 * FOCAL}}}",
        "haperture": 10 * BACK[0],
        "vaperture": 10 * BACK[1],
        "win_translate": f"{{{-2 * OFFSET[0] / BACK[0]} {-2 * OFFSET[1] / BACK[1]}}}",
        "win_scale": "{1 1}",
        **other,
        "name": name,
    }
    return "Camera {\n" + "".join(f" {key} {value}\n" for key, value in knobs.items()) + "}\n"


def lens_text(model, values, name="lens", mode="0", keys=0):
    lines = [name, f"{BACK[0]} {BACK[1]} {FOCAL} 1.7778 {OFFSET[0]} {OFFSET[1]} 1.0", mode, model]
    for key, value in zip(NAMES.get(model, NAMES[RADIAL]), values, strict=True):
        lines += [key, repr(float(value)), str(keys), *["35.0 0.1 -1.0 0.0 1.0 0.0 SMOOTH"] * keys]
    return "\n".join([*lines, "<end_of_file>", ""])


def lens_node(kind, values, **other):
    knobs = {
        "direction": "undistort",
        "tde4_focal_length_cm": FOCAL,
        "tde4_filmback_width_cm": BACK[0],
        "tde4_filmback_height_cm": BACK[1],
        "tde4_lens_center_offset_x_cm": OFFSET[0],
        "tde4_lens_center_offset_y_cm": OFFSET[1],
        "field_of_view_xb_unit": 1.0,
        **values,
        "name": "LD_3DE4_left",
        **other,
    }
    return f"{kind} {{\n" + "".join(f"  {key} {value}\n" for key, value in knobs.items()) + "}"


SCRIPT = '#! nuke\nversion 4.8200\nRoot {\n inputs 0\n format "1920 1080 0 0 1920 1080 1 HD"\n}\n'


def away_px(folder, model=None, values=(), unit=10.0):
    (camera,) = load_cameras_file(folder, unit, {"left": SIZE})
    world, pixels = seen(model, values)
    return np.abs(camera.project(world * 10) - pixels).max()


def test_a_camera_without_lens_is_a_pinhole(tmp_path):
    (tmp_path / "shot.nk").write_text(SCRIPT + "push 0\n" + camera_node())
    assert away_px(tmp_path) < 1e-8 and away_px(tmp_path / "shot.nk") < 1e-8
    assert lacks_sizes(tmp_path / "shot.nk") and calibration_files(tmp_path) == [tmp_path / "shot.nk"]


@pytest.mark.parametrize(
    ("model", "values"),
    [
        (RADIAL, (0.04, 0, 0, 0.01, 0, 0, 0, 0)),
        (RADIAL, (0.15, 0, 0, 0.06, 0, 0, 0, 0)),
        (RADIAL, (-0.06, 0.0001, -0.0001, 0.02, 0, 0, 0, 0)),
        (RADIAL, (0.0, 0, 0, 0, 0, 0, 37.0, 0.004)),
        (CLASSIC, (0.05, 1, 0, 0, 0.01)),
        (CLASSIC, (0.0, 1.02, 0, 0, 0.0)),
        (BROWN, (0.05, 0.01, -0.004, 0.0001, -0.0001)),
    ],
)
def test_lenses_reproject_as_their_model_says(tmp_path, model, values):
    (tmp_path / "shot.nk").write_text(SCRIPT + camera_node())
    (tmp_path / "lens.txt").write_text(lens_text(model, values, keys=2))
    assert away_px(tmp_path / "shot.nk", model, values) < PIXEL
    assert calibration_files(tmp_path / "shot.nk") == [tmp_path / "lens.txt", tmp_path / "shot.nk"]


def test_the_lens_of_opencv_is_taken_as_it_is(tmp_path):
    cv2 = pytest.importorskip("cv2")
    values = (-0.1, 0.05, 0.001, -0.0008, 0.01)
    (tmp_path / "shot.nk").write_text(SCRIPT + camera_node(angles=(0, 0, 0), place=(0, 0, 0)))
    (tmp_path / "left.txt").write_text(lens_text(OPENCV, values))
    (camera,) = load_cameras_file(tmp_path, 10.0, {"left": SIZE})
    assert camera.distortion.tolist() == list(values)
    fx, fy = FOCAL / BACK[0] * SIZE[0], FOCAL / BACK[1] * SIZE[1]
    K = np.array([[fx, 0, (0.5 + OFFSET[0] / BACK[0]) * SIZE[0] - 0.5], [0, fy, 0], [0, 0, 1]])
    K[1, 2] = (0.5 - OFFSET[1] / BACK[1]) * SIZE[1] - 0.5
    points = np.random.default_rng(2).uniform((-20, -10, -80), (20, 10, -50), (1000, 3))
    wanted = cv2.projectPoints(points * [1, -1, -1], np.zeros(3), np.zeros(3), K, np.array(values))[0][:, 0]
    assert np.abs(camera.project(10 * points) - wanted).max() < 1e-8


def test_nodes_of_lenses_name_what_differs_from_defaults(tmp_path):
    model, values = RADIAL, (0.04, 0, 0, 0.01, 0, 0, 0, 0)
    node = lens_node(
        "LD_3DE4_Radial_Standard_Degree_4",
        {"Distortion_Degree_2": "{{curve x1 0.04 x2 0.04 }}", "Quartic_Distortion_Degree_4": 0.01},
    )
    for script in (SCRIPT + node + "\n" + camera_node(inputs=0), SCRIPT + camera_node() + node):
        (tmp_path / "shot.nk").write_text(script)
        assert away_px(tmp_path / "shot.nk", model, values) < PIXEL
    (tmp_path / "shot.nk").write_text(SCRIPT + camera_node())
    (tmp_path / "lens.nk").write_text(node)
    assert away_px(tmp_path / "shot.nk", model, values) < PIXEL


def test_a_lens_is_told_by_its_name(tmp_path):
    model, values = RADIAL, (0.04, 0, 0, 0.01, 0, 0, 0, 0)
    (tmp_path / "shot.nk").write_text(SCRIPT + camera_node())
    (tmp_path / "a.txt").write_text(lens_text(model, values, name="left"))
    (tmp_path / "b.txt").write_text(lens_text("3DE4 Anamorphic, Degree 6", np.zeros(8), name="other"))
    (tmp_path / "notes.txt").write_text("35 mm\n1 2 3\n")
    assert away_px(tmp_path, model, values) < PIXEL
    (tmp_path / "a.txt").write_text(lens_text(model, values, name="c"))
    with pytest.raises(CalibrationError, match=r"left matches several lenses: c \(a\.txt\), other .* left\.txt"):
        load_cameras_file(tmp_path, 10.0, {"left": SIZE})


def test_a_damaged_lens_is_not_taken_for_a_remark(tmp_path):
    (tmp_path / "shot.nk").write_text(SCRIPT + camera_node())
    (tmp_path / "readme.txt").write_text("solved by hand\n")
    assert away_px(tmp_path) < 1e-8
    whole = lens_text(RADIAL, (0.04, 0, 0, 0.01, 0, 0, 0, 0))
    second = whole.splitlines()[1]
    for damaged in (whole.replace(second, " ".join(second.split()[:6])), "\n".join(whole.splitlines()[1:]) + "\n"):
        (tmp_path / "lens.txt").write_text(damaged)
        with pytest.raises(CalibrationError, match=r"lens\.txt: is a lens file, but does not begin with four lines"):
            away_px(tmp_path)


def test_the_scene_above_moves_and_scales_cameras(tmp_path):
    """The same camera, below an axis that turns, shifts and halves the scene."""
    turn, shift = Rotation.from_euler("y", 90, degrees=True), np.array([1.0, 2.0, 3.0])
    axis = (
        "Axis {\n inputs 0\n rot_order ZXY\n translate {1 2 3}\n rotate {0 90 0}\n scaling {0.5 0.5 0.5}\n name s\n}\n"
    )
    (tmp_path / "shot.nk").write_text(SCRIPT + "push 0\n" + axis + camera_node())
    (camera,) = load_cameras_file(tmp_path, 10.0, {"left": SIZE})
    world, pixels = seen()
    assert np.abs(camera.project(10 * (turn.apply(0.5 * world) + shift)) - pixels).max() < 1e-8
    kept = SCRIPT + axis + "set N1 [stack 0]\npush 0\n" + camera_node("a") + "push $N1\n" + camera_node("b")
    (tmp_path / "shot.nk").write_text(kept)
    free, moved = load_cameras_file(tmp_path, 10.0, dict.fromkeys("ab", SIZE))
    assert np.abs(free.project(10 * world) - pixels).max() < 1e-8
    assert np.allclose(moved.T_cam_world, camera.T_cam_world)


def test_what_is_read_goes_to_other_readers(tmp_path):
    from pxr import Gf, Usd, UsdGeom

    from jawusd.rig.cameras import write_camera_stage

    (tmp_path / "shot.nk").write_text(SCRIPT + camera_node())
    read = load_cameras_file(tmp_path, 10.0, {"left": SIZE})
    world, pixels = seen()
    stage = Usd.Stage.Open(str(write_camera_stage(tmp_path / "out.usda", read)))
    prim = next(prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera))
    frustum = UsdGeom.Camera(prim).GetCamera(Usd.TimeCode.Default()).frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    found = np.array([matrix.Transform(Gf.Vec3d(*map(float, point))) for point in 10 * world])
    shown = np.column_stack([(found[:, 0] + 1) / 2 * SIZE[0], (1 - found[:, 1]) / 2 * SIZE[1]]) - 0.5
    assert np.abs(shown - pixels).max() < PIXEL
    values = (0.04, 0, 0, 0.01, 0, 0, 0, 0)
    (tmp_path / "left.txt").write_text(lens_text(RADIAL, values))
    read = load_cameras_file(tmp_path, 10.0, {"left": SIZE})
    save_colmap(tmp_path / "model", read)
    save_calibration(tmp_path / "out.toml", read)
    world, pixels = seen(RADIAL, values)
    for cameras in (load_cameras_file(tmp_path / "model"), load_calibration(tmp_path / "out.toml")):
        assert np.abs(cameras[0].project(10 * world) - pixels).max() < PIXEL


GOOD = lens_text(RADIAL, (0.04, 0, 0, 0.01, 0, 0, 0, 0))


@pytest.mark.parametrize(
    ("script", "lens", "words"),
    [
        (camera_node(rotate="{" + curve(1.0) + " {curve i x1 0 x2 1 x3 2} 0}"), None, "camera left moves between"),
        (camera_node(focal="{{curve i x1 35 x2 40}}"), None, "focal is animated"),
        (camera_node(focal=0), None, "has focal length 0 mm and film back 36 x 20.25 mm; all three must be"),
        (camera_node(focal="{{parent.focal}}"), None, "focal is .*expected numbers"),
        (camera_node(translate="{1 2}"), None, "expected 3 numbers"),
        (camera_node(translate="{1 2 nan}"), None, "not finite"),
        (camera_node(win_scale="{1 2}"), None, "win_scale or winroll"),
        (camera_node(useMatrix="true"), None, "has useMatrix"),
        (camera_node(rot_order="XXY"), None, 'rot_order "XXY"'),
        (camera_node() + camera_node(), None, "two cameras named left"),
        ("Axis {\n inputs 0\n scaling {1 2 1}\n}\n" + camera_node(), None, "has scale"),
        ("", GOOD, "has no Camera node.*Export Project, Nuke"),
        (
            camera_node(),
            lens_text("3DE4 Anamorphic - Standard, Degree 4", np.zeros(8)),
            "Anamorphic - Standard, Degree",
        ),
        (camera_node(), lens_text(RADIAL, np.zeros(8), mode="DISTORTION_DYNAMIC_FOCUS_DISTANCE"), "type of distortion"),
        (camera_node(), lens_text(RADIAL, (0.05, 0.02, 0, 0, 0.01, 0, 0, 0)), "cannot be approximated .*0.05"),
        (camera_node(), GOOD.replace("0.04\n", "much\n"), "must be followed by its value"),
        (camera_node(), GOOD.replace("0.04\n", "inf\n"), "not finite"),
        (camera_node(), GOOD.replace("U - Degree 2", "U - Degree 3"), 'no parameter "U - Degree 3"; its param'),
        (camera_node(haperture=24.0), GOOD, r"film back 24 x 20.25 .*its lens lens in left\.txt has 36 x 20.25"),
        (camera_node() + lens_node("LD_3DE4_Radial_Fisheye_Degree_8", {}), None, "LD_3DE4_Radial_Fisheye_Degree_8"),
        (
            camera_node() + lens_node("LD_3DE_Classic_LD_Model", {"field_of_view_xa_unit": 0.1}),
            None,
            "smaller or larger than the image",
        ),
    ],
)
def test_files_that_are_wrong_are_refused(tmp_path, script, lens, words):
    (tmp_path / "shot.nk").write_text(SCRIPT + script)
    if lens is not None:
        (tmp_path / "left.txt").write_text(lens)
    with pytest.raises(CalibrationError, match=words):
        load_cameras_file(tmp_path, 10.0, {"left": SIZE})


def test_sizes_are_needed_and_other_files_named(tmp_path):
    (tmp_path / "shot.nk").write_text(SCRIPT + camera_node())
    with pytest.raises(CalibrationError, match=r"camera left: .*no footage has that name \(available: none\)"):
        load_cameras_file(tmp_path)
    (tmp_path / "shot.3de").write_text("")
    with pytest.raises(CalibrationError, match=r"3DEqualizer's project; this format is not supported.*\.nk"):
        load_cameras_file(tmp_path / "shot.3de")
