"""Poses from tables of markers, compared with the true motion, with missing and misplaced markers."""

import sys
import warnings

import c3d
import ezc3d
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.base.errors import FormatError, MissingDependencyError
from jawusd.pipeline.fit import TrajectoryOptions, read_trajectory
from jawusd.pipeline.markers import marker_poses, read_c3d

COUNT = 12
HEAD = np.array([[-12.5, -36, 78], [-61, -37, 82], [-7, 38.5, 83], [-59, 42, 88]])
JAW = np.array([[-69.0, -16, 100], [-20, -23, 109], [-23.5, 22, 106], [-66, 23.5, 105]])


def motions(seed, turn, shift):
    """Return rigid motions made with scipy's rotations; the first is the identity."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    T[1:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(COUNT - 1, 3)) * turn).as_matrix()
    T[1:, :3, 3] = rng.normal(size=(COUNT - 1, 3)) * shift
    return T


@pytest.fixture
def jaw():
    return motions(0, 0.05, 4)


@pytest.fixture
def markers(jaw):
    """Head and jaw markers of a moving head before a camera, (F, 8, 3)."""
    camera = motions(1, 0.3, 60)
    camera[:, :3, 3] += [400, 400, -2600]

    def seen(T, points):
        return np.einsum("fij,nj->fni", T[:, :3, :3], points) + T[:, None, :3, 3]

    return np.concatenate([seen(camera, HEAD), seen(camera @ jaw, JAW)], axis=1)


def write(folder, markers):
    np.savetxt(folder / "speech.asc", markers.reshape(len(markers), -1), fmt="%.9e")
    return folder / "speech.asc"


def write_body(path, first, points):
    rows = [f"{first + k} {x} {y} {z} 1" for k, (x, y, z) in enumerate(points)]
    path.write_text("\n".join(["4 ;Number of markers", "Marker X Y Z Views", *rows]))
    return str(path)


@pytest.fixture
def bodies(tmp_path):
    return {"head": write_body(tmp_path / "head.rig", 1, HEAD), "jaw": write_body(tmp_path / "jaw.rig", 5, JAW)}


def test_poses_of_described_bodies(tmp_path, markers, bodies, jaw):
    np.testing.assert_allclose(marker_poses(write(tmp_path, markers), bodies)[0], jaw, atol=1e-5)


def test_one_missing_marker_of_four_costs_nothing_two_cost_the_frame(tmp_path, markers, bodies, jaw):
    markers[3, 6] = -3.697314e28
    markers[5, 0] = np.nan
    markers[7, [4, 7]] = -3.697314e28
    T, _ = marker_poses(write(tmp_path, markers), bodies)
    kept = np.delete(np.arange(COUNT), 7)
    np.testing.assert_allclose(T[kept], jaw[kept], atol=1e-5)
    assert np.isnan(T[7]).all()


def test_a_marker_that_jumps_costs_the_frame(tmp_path, markers, bodies, jaw):
    markers[4, 5] += [0, 6, 0]
    T, _ = marker_poses(write(tmp_path, markers), bodies)
    assert np.isnan(T[4]).all()
    np.testing.assert_allclose(np.delete(T, 4, 0), np.delete(jaw, 4, 0), atol=1e-5)


def test_triples_without_a_description_have_their_shape_at_the_rest_frame(tmp_path, markers, jaw):
    # the frame of the head is then that of the camera at rest
    camera_at_rest = np.eye(4)
    camera_at_rest[:3, 3] = [400, 400, -2600]
    T, _ = marker_poses(write(tmp_path, markers), {"head": "1,2,3", "jaw": "5,6,8"}, rest_frame=0)
    np.testing.assert_allclose(np.linalg.inv(camera_at_rest) @ T @ camera_at_rest, jaw, atol=1e-5)


def test_fit_reads_markers_in_centimetres_relative_to_a_rest_frame(tmp_path, markers, jaw):
    path = write(tmp_path, markers[1:] / 10)
    camera = motions(1, 0.3, 60)[1]
    camera[:3, 3] += [400, 400, -2600]
    options = TrajectoryOptions(rigid={"head": "1,2,3,4", "jaw": "5,6,7,8"}, rest_frame=0, length_unit="cm")
    frames, T, _ = read_trajectory(path, options)
    np.testing.assert_array_equal(frames, range(COUNT - 1))
    relative = jaw[1:] @ np.linalg.inv(jaw[1])
    np.testing.assert_allclose(np.linalg.inv(camera) @ T @ camera, relative, atol=1e-5)
    with pytest.raises(FormatError, match="columns and groups"):
        read_trajectory(path, TrajectoryOptions(rigid={"jaw": "1,2,3"}, rest_frame=0, group="a"))


@pytest.mark.parametrize(
    ("rigid", "rest", "words"),
    [
        ({"head": "1,2,3"}, 0, "jaw is required"),
        ({"jaw": "5,6,7", "tongue": "1,2,3"}, 0, "jaw is required"),
        ({"jaw": "7,8,9"}, 0, "has 8 markers; the rigid body of the jaw uses marker 9"),
        ({"jaw": "5,6,7"}, None, "--rest-frame"),
        ({"jaw": "5,6,7"}, 12, "has no frame 12; it has frames 0 to 11"),
        ({"jaw": "5,6,7"}, 2, "frame 2 does not show all markers of the jaw"),
    ],
)
def test_each_mistake_of_rigid_bodies_is_named(tmp_path, markers, rigid, rest, words):
    markers[2, 5] = np.nan
    with pytest.raises(FormatError, match=words):
        marker_poses(write(tmp_path, markers), rigid, rest)


def test_a_body_whose_markers_are_exchanged_is_refused(tmp_path, markers, bodies):
    markers[:, [4, 5]] = markers[:, [5, 4]]
    with pytest.raises(FormatError, match=r"markers 5, 6, 7, 8 are .* mm from their positions"):
        marker_poses(write(tmp_path, markers), bodies)


def test_markers_on_a_line_give_no_pose(tmp_path):
    line = np.tile(np.array([[1.0, 0, 0], [2, 0, 0], [3, 0, 0]]), (3, 1, 1))
    with pytest.raises(FormatError, match="are not collinear"):
        marker_poses(write(tmp_path, line), {"jaw": "1,2,3"}, 0)


NAMES = ("HL", "HR", "HF", "HB", "JL", "JR", "JF", "JB")


def write_c3d(path, markers, unit="mm", scale=1.0, names=NAMES, hidden=np.nan):
    """Write with ezc3d; `hidden` replaces the coordinates of occluded markers."""
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"], point["LABELS"]["value"] = [120], [unit], list(names)
    seen = np.isfinite(markers).all(axis=2).T
    points = np.where(np.isfinite(markers), markers * scale, hidden)
    file["data"]["points"] = np.concatenate([points.transpose(2, 1, 0), np.ones((1, *seen.shape))])
    file["data"]["meta_points"]["residuals"] = np.where(seen, 0.0, -1.0)[None]
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, *seen.shape), dtype=bool)
    file.write(str(path))
    return path


def write_c3d_by_peer(path, markers, names=NAMES):
    """Write with the package c3d, which has a residual per point: -1 means occluded."""
    writer = c3d.Writer(point_rate=120.0, analog_rate=0, point_units="mm")
    for frame in markers:
        seen = np.isfinite(frame).all(axis=1)
        rows = np.column_stack([np.where(seen[:, None], frame, 123.0), np.where(seen, 0.0, -1.0), np.zeros(len(frame))])
        writer.add_frames([(rows, np.empty((0, 0)))])
    writer.set_point_labels(names)
    with open(path, "wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no analog data
        writer.write(file)
    return path


def read_c3d_by_peer(path):
    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no analog data
        frames = [points for _, points, _ in c3d.Reader(file).read_frames(copy=True)]
    points = np.array(frames)
    return np.where(points[..., 3:4] < 0, np.nan, points[..., :3])


C3D = {
    "NaN": lambda path, markers: write_c3d(path, markers),
    "0": lambda path, markers: write_c3d(path, markers, hidden=0.0),
    "residual -1 alone": lambda path, markers: write_c3d(path, markers, hidden=12.0),
    "metres": lambda path, markers: write_c3d(path, markers, "m", 1e-3),
    "subject before the name": lambda path, markers: write_c3d(path, markers, names=[f"Anna:{n}" for n in NAMES]),
    "by another program": write_c3d_by_peer,
}


@pytest.mark.parametrize("case", C3D)
def test_c3d_is_read_as_its_writers_and_a_peer_say(tmp_path, markers, jaw, case):
    markers[3, 5] = np.nan
    markers[6, [4, 5]] = np.nan
    path = C3D[case](tmp_path / "take.c3d", markers)
    found = read_c3d(path)
    scale = 1e-3 if case == "metres" else 1.0
    np.testing.assert_allclose(found.points, markers * scale, rtol=1e-6)
    assert (found.unit, found.fps) == ("m" if case == "metres" else "mm", 120)
    assert [name.rpartition(":")[2] for name in found.names] == list(NAMES)
    if case in ("residual -1 alone", "metres", "by another program"):
        np.testing.assert_allclose(read_c3d_by_peer(path), found.points, rtol=1e-6)
    bodies = {"head": "HL,HR,HF,HB", "jaw": "JL,JR,JF,JB"}
    T, fps = marker_poses(path, bodies, rest_frame=0)
    assert fps == 120 and np.isnan(T[6]).all()
    camera_at_rest = np.eye(4)
    camera_at_rest[:3, 3] = [400, 400, -2600]
    T = np.linalg.inv(camera_at_rest) @ T @ camera_at_rest
    np.testing.assert_allclose(np.delete(T, 6, 0), np.delete(jaw, 6, 0), atol=2e-3)  # of single precision at 2.6 m


def test_each_mistake_of_a_c3d_is_named(tmp_path, markers):
    path = write_c3d(tmp_path / "take.c3d", markers)
    whole = path.read_bytes()
    for size in (0, 100, 511, 700, 1100, len(whole) - 1500):
        path.write_bytes(whole[:size])
        with pytest.raises(FormatError, match="is not a readable C3D file" if size < 512 else "is truncated"):
            read_c3d(path)
    path.write_text("frame,x,y,z\n" * 100)
    with pytest.raises(FormatError, match="is not a readable C3D file"):
        read_c3d(path)
    write_c3d(path, markers, unit="in")
    with pytest.raises(FormatError, match='lengths are in "in"; the unit must be one of mm, cm, m'):
        read_c3d(path)
    with pytest.raises(FormatError, match="no such file"):
        read_c3d(tmp_path / "none.c3d")


@pytest.mark.parametrize(
    ("names", "rigid", "words"),
    [
        (NAMES, "JL,JR,JX", "HL, HR, .*, JB; the rigid body of the jaw uses marker JX"),
        (("JL", *NAMES[1:]), "JL,JR,JF", "uses marker JL 2 times"),
        (("8", "7", "6", "5", "4", "3", "2", "1"), "5,6,7", '"5" is ambiguous: the name of marker 4 and the number'),
    ],
)
def test_names_that_do_not_tell_the_marker_are_refused(tmp_path, markers, names, rigid, words):
    path = write_c3d(tmp_path / "take.c3d", markers, names=names)
    with pytest.raises(FormatError, match=words):
        marker_poses(path, {"jaw": rigid}, rest_frame=0)


def test_a_marker_hidden_at_rest_is_named(tmp_path, markers):
    markers[0, 6] = 0.0
    with pytest.raises(FormatError, match="all markers of the jaw; occluded: 7"):
        marker_poses(write(tmp_path, markers), {"jaw": "5,6,7,8"}, rest_frame=0)


def test_a_unit_that_contradicts_the_file_is_refused(tmp_path, markers):
    path = write_c3d(tmp_path / "take.c3d", markers, "m", 1e-3)
    with pytest.raises(FormatError, match="is in m, but --length-unit is cm"):
        marker_poses(path, {"jaw": "5,6,7,8"}, rest_frame=0, unit="cm")


def test_without_ezc3d_the_extra_is_named(tmp_path, markers, monkeypatch):
    path = write_c3d(tmp_path / "take.c3d", markers)
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(MissingDependencyError, match=r"jawusd\[c3d\]"):
        read_c3d(path)
