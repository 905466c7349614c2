"""Poses of tables of markers: against the motion they were made from, with markers missing and misplaced."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.errors import FormatError
from jawusd.pipeline.fit import TrajectoryOptions, read_trajectory
from jawusd.pipeline.markers import marker_poses

COUNT = 12
HEAD = np.array([[-12.5, -36, 78], [-61, -37, 82], [-7, 38.5, 83], [-59, 42, 88]])
JAW = np.array([[-69.0, -16, 100], [-20, -23, 109], [-23.5, 22, 106], [-66, 23.5, 105]])


def motions(seed, turn, shift):
    """Return rigid motions by scipy's rotations, the first none."""
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
    np.testing.assert_allclose(marker_poses(write(tmp_path, markers), bodies), jaw, atol=1e-5)


def test_one_missing_marker_of_four_costs_nothing_two_cost_the_frame(tmp_path, markers, bodies, jaw):
    markers[3, 6] = -3.697314e28
    markers[5, 0] = np.nan
    markers[7, [4, 7]] = -3.697314e28
    T = marker_poses(write(tmp_path, markers), bodies)
    kept = np.delete(np.arange(COUNT), 7)
    np.testing.assert_allclose(T[kept], jaw[kept], atol=1e-5)
    assert np.isnan(T[7]).all()


def test_a_marker_that_jumps_costs_the_frame(tmp_path, markers, bodies, jaw):
    markers[4, 5] += [0, 6, 0]
    T = marker_poses(write(tmp_path, markers), bodies)
    assert np.isnan(T[4]).all()
    np.testing.assert_allclose(np.delete(T, 4, 0), np.delete(jaw, 4, 0), atol=1e-5)


def test_triples_without_a_description_have_their_shape_at_the_rest_frame(tmp_path, markers, jaw):
    # the frame of the head is then that of the camera at rest
    camera_at_rest = np.eye(4)
    camera_at_rest[:3, 3] = [400, 400, -2600]
    T = marker_poses(write(tmp_path, markers), {"head": "1,2,3", "jaw": "5,6,8"}, rest_frame=0)
    np.testing.assert_allclose(np.linalg.inv(camera_at_rest) @ T @ camera_at_rest, jaw, atol=1e-5)


def test_fit_reads_markers_in_centimetres_relative_to_a_rest_frame(tmp_path, markers, jaw):
    path = write(tmp_path, markers[1:] / 10)
    camera = motions(1, 0.3, 60)[1]
    camera[:3, 3] += [400, 400, -2600]
    options = TrajectoryOptions(rigid={"head": "1,2,3,4", "jaw": "5,6,7,8"}, rest_frame=0, length_unit="cm")
    frames, T = read_trajectory(path, options)
    np.testing.assert_array_equal(frames, range(COUNT - 1))
    relative = jaw[1:] @ np.linalg.inv(jaw[1])
    np.testing.assert_allclose(np.linalg.inv(camera) @ T @ camera, relative, atol=1e-5)
    with pytest.raises(FormatError, match="columns and groups"):
        read_trajectory(path, TrajectoryOptions(rigid={"jaw": "1,2,3"}, rest_frame=0, group="a"))


@pytest.mark.parametrize(
    ("rigid", "rest", "words"),
    [
        ({"head": "1,2,3"}, 0, "jaw is needed"),
        ({"jaw": "5,6,7", "tongue": "1,2,3"}, 0, "jaw is needed"),
        ({"jaw": "7,8,9"}, 0, "has 8 markers; the rigid body of the jaw names marker 9"),
        ({"jaw": "5,6,7"}, None, "--rest-frame"),
        ({"jaw": "5,6,7"}, 12, "has no frame 12; it has 0 to 11"),
        ({"jaw": "5,6,7"}, 2, "frame 2 does not show all markers of the jaw"),
    ],
)
def test_each_mistake_of_rigid_bodies_is_named(tmp_path, markers, rigid, rest, words):
    markers[2, 5] = np.nan
    with pytest.raises(FormatError, match=words):
        marker_poses(write(tmp_path, markers), rigid, rest)


def test_a_body_whose_markers_are_exchanged_is_refused(tmp_path, markers, bodies):
    markers[:, [4, 5]] = markers[:, [5, 4]]
    with pytest.raises(FormatError, match=r"markers 5, 6, 7, 8 lie .* mm from their places"):
        marker_poses(write(tmp_path, markers), bodies)


def test_markers_on_a_line_give_no_pose(tmp_path):
    line = np.tile(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), (3, 1, 1))
    with pytest.raises(FormatError, match="do not lie on one line"):
        marker_poses(write(tmp_path, line), {"jaw": "1,2,3"}, 0)
