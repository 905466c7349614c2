"""Parts of the benchmark on data of others, on made-up samples of each of its formats and on motions known exactly."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.fitting.data import SubjectAnatomy, select_poses
from jawusd.geometry import make_transform, transform_points

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
FRAMES = 60
HEAD = np.array([[-12.5, -36.0, 78.0], [-61.0, -37.0, 82.0], [-7.0, 38.5, 82.5], [-59.0, 42.0, 87.5]])
JAW = np.array([[-69.5, -16.0, 100.0], [-20.0, -23.0, 109.0], [-23.5, 22.0, 106.0], [-66.0, 23.5, 105.0]])
HUGE = -3.697314e28  # what Northern Digital's programs write where a marker was out of sight
JOINT = np.array([5.0, -2.0, 3.0])


@pytest.fixture
def part(monkeypatch):
    """Return a function that imports a module of the benchmark."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    monkeypatch.syspath_prepend(BENCHMARKS / "real")
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if str(BENCHMARKS) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def description(markers, first):
    """Return a marker description file of Northern Digital."""
    rows = [f"{number} {x} {y} {z} 1" for number, (x, y, z) in enumerate(markers, start=first)]
    head = ["Marker Description File", "", f" {len(rows)} ;Number of markers", "Marker X Y Z Views"]
    return "\n".join([*head, *rows, ""])


def turns():
    """Return yaw, pitch and roll (F, 3) [degrees] of a jaw that opens and shifts."""
    t = np.linspace(0, 6 * np.pi, FRAMES)
    return np.stack([0.5 * np.sin(t), 6 * (1 - np.cos(t)), 0.3 * np.sin(2 * t)], axis=1)


@pytest.fixture
def recorded(tmp_path):
    """Write made-up speech, clench and the maker's poses, and a path of a triangle; return the folder of data."""
    data, speech, path = tmp_path, tmp_path / "optotrak" / "plgrigid", tmp_path / "artisynth-chewing-env/XML_Processing"
    speech.mkdir(parents=True)
    path.mkdir(parents=True)
    shifts = np.stack([np.zeros(FRAMES), 0.1 * turns()[:, 0], 0.2 * turns()[:, 1]], axis=1)
    T_head_jaw = make_transform(Rotation.from_euler("ZYX", turns(), degrees=True).as_matrix(), shifts)
    T_room_head = make_transform(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([400.0, 450.0, -2600.0]))
    head = np.broadcast_to(transform_points(T_room_head, HEAD), (FRAMES, 4, 3))
    table = np.concatenate([head, transform_points(T_room_head @ T_head_jaw, JAW)], axis=1).reshape(FRAMES, -1)
    hidden = table.copy()
    hidden[7, :3] = HUGE  # three markers of the head are left
    np.savetxt(speech / "dms1.asc", hidden, fmt="%.9e")
    np.savetxt(speech / "cln1.asc", np.broadcast_to(table[0], table.shape), fmt="%.9e")
    maker = np.concatenate([np.zeros((FRAMES, 7)), turns(), shifts, np.zeros((FRAMES, 1))], axis=1)
    np.savetxt(speech / "rig1.asc", maker, fmt="%.9e")
    (speech / "head.rig").write_text(description(HEAD, 1))
    (speech / "jaw.rig").write_text(description(JAW, 5))
    carried = np.array([[0, 0, 0], [25, 0, 30], [-25, 0, 30.0]]) + np.linspace(0, 1, 5)[:, None, None] * [0, 0, -50]
    np.savetxt(path / "JMA_position.txt", carried.reshape(5, 9), header="0 0.1 1\nLinear 9 0.02", comments="")
    (path / "Marker1_Traj.txt").write_text("0 0.02 1\nLinear 3 0.02\n1 2 3\n")
    return data


def figures(told, quantity):
    """Return the numbers of a row of a printed table, whose last columns are its data, licence and command."""
    row = next(line for line in told.splitlines() if quantity in line)
    return [float(cell) for cell in row.split("|")[2:-4]]


def test_markers_agree_with_the_makers_poses(part, recorded, capsys):
    motion = part("motion")
    motion.poses_against_the_maker(recorded, recorded / "out")
    told = capsys.readouterr().out
    assert max(figures(told, "from the maker's poses") + figures(told, "from the maker's, speech")) < 1e-3
    assert max(figures(told, "noise of jaw markers")) < 1e-3
    rows = [line for line in told.splitlines() if line.startswith("| ")]
    assert all(re.search(r"paulgribble/optotrak.*none given.*--only markers` \|$", row) for row in rows[1:])
    assert "5 frames of 3 points are read;\nthey move by 50 mm and turn by 0.0 degrees" in told
    assert (recorded / "out" / "clench.png").stat().st_size > 0


def test_another_order_of_the_makers_angles_shows(part, recorded, capsys):
    path = recorded / "optotrak" / "plgrigid" / "rig1.asc"
    values = np.loadtxt(path)
    values[:, 7:10] = values[:, [9, 8, 7]]
    np.savetxt(path, values)
    part("motion").poses_against_the_maker(recorded, recorded / "out")
    assert figures(capsys.readouterr().out, "from the maker's, speech")[0] > 0.1


def taken(T):
    """Return training data of motions (N, 4, 4) that are measured at four points."""
    points = np.array([[0.0, -40, 80], [25, -40, 50], [-25, -40, 50], [0, -60, 60]])
    landmarks = np.array([[0.0, -40, 80], [25, -40, 45], [-25, -40, 45], [50, 0, 0], [-50, 0, 0]])
    anatomy = SubjectAnatomy.of(make_transform(np.eye(3), -landmarks[0]), landmarks, points, None)
    return select_poses(np.arange(len(T)), T, anatomy).data


def about_the_joint():
    """Return motions that turn about a fixed joint, in all three directions."""
    t = np.linspace(0, 6 * np.pi, FRAMES)
    turns = np.stack([0.2 * (1 - np.cos(t)), 0.05 * np.sin(2 * t), 0.04 * np.sin(3 * t)], axis=1)
    R = Rotation.from_rotvec(turns).as_matrix()
    return make_transform(R, JOINT - R @ JOINT)


def test_a_hinge_follows_its_own_motion_and_no_gliding(part):
    models, T = part("models"), about_the_joint()
    turning = models.hold_out(taken(T), models.Entry(models.hinge))
    assert turning[2].max() < 1e-6 and turning[0].max() > 0.1
    gliding = T.copy()
    gliding[:, 2, 3] += 5 * np.sin(np.linspace(0, 20, FRAMES))
    assert models.hold_out(taken(gliding), models.Entry(models.hinge))[2].max() > 0.5


def test_models_learn_from_so_many_poses_and_never_from_those_left_out(part):
    models, T = part("models"), about_the_joint()
    data, learned, tried = taken(T), [], []

    def model(seen):
        learned.append(seen.motion)
        return lambda M, parameters: tried.append(M) or M

    errors = models.hold_out(data, models.Entry(model, most=20))
    assert [len(seen) for seen in learned] == [20] * models.FOLDS and not errors.any()
    for k, seen in enumerate(learned):
        unseen = tried[3 * k]
        assert not (np.abs(seen[:, None] - unseen[None]).max(axis=(2, 3)) == 0).any()
    assert sum(len(M) for M in tried) == 3 * len(data)


def test_areas_end_at_the_middle_of_drawn_lines(part):
    patients = part("patients")
    away = np.hypot(*(np.mgrid[:400, :400] - 200.0))
    lines = np.where(np.abs(away - 40) < 2.5, 255, 0).astype(np.uint8)
    expected = np.where(away < 50, 2, 0)
    areas, closed = patients.drawn_areas(lines, expected)
    assert closed == 1 and not areas[0].any()
    assert float(patients.overlap(areas[1], away < 40)) > 0.97
    lines[:200, 198:203] = 0  # an open line encloses nothing
    assert patients.drawn_areas(lines, expected)[1] == 0


def test_exact_picks_give_the_pose_and_too_few_none(part, camera):
    peers = part("peers")
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (8, 3))
    truth = make_transform(Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix(), np.array([5.0, -3.0, 400.0]))
    pixels = camera.project(transform_points(truth, points))
    np.testing.assert_allclose(peers.posed(points, pixels, camera), truth, atol=1e-4)
    pixels[:3] = -1
    assert np.isnan(peers.posed(points, pixels, camera)).all()


@pytest.fixture
def camera():
    """Return a camera at the origin of the world."""
    from jawusd.geometry import Camera

    K = np.array([[1200.0, 0, 480], [0, 1200, 270], [0, 0, 1]])
    return Camera("cam", (960, 540), K, np.zeros(4), np.eye(4))


def test_casts_are_named_where_their_reader_is_missing(part, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3sdcm", None)
    (tmp_path / "cast.dcm").write_bytes(b"zip")
    row = part("scanner").row("cast", tmp_path / "cast.dcm", tmp_path)
    assert row[0] == "cast" and "jawusd[dcm]" in row[1] and row[2:] == ["-"] * 5


def test_the_jaws_angle_and_lips_follow_landmarks_and_scale_is_fitted(part):
    face = part("face")
    openings = np.array([0.0, 0.1, 0.2, 0.35])
    points = np.zeros((4, 468, 3))
    points[:, 234], points[:, 454] = (-70, 0, 0), (70, 0, 0)
    points[:, 1] = (0, 0, -90)
    points[:, 152] = 90 * np.stack([0 * openings, np.sin(1 + openings), -np.cos(1 + openings)], axis=1)
    points[:, 14, 1] = 140 * openings
    np.testing.assert_allclose(face.jaw_angle(points), 1 + openings)
    np.testing.assert_allclose(face.lips_apart(points), openings, atol=1e-12)
    assert face.off_line(face.jaw_angle(points), 5 + 80 * openings) < 1e-9
    assert face.off_line(face.jaw_angle(points), np.array([0.0, 10, 0, 10])) > 3


def test_sections_say_what_they_lack(part, capsys):
    part("face").run([], None)
    assert "name the Python of an environment with mediapipe" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="--captures"):
        part("peers").run([], 8, None)
