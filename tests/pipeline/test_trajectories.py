"""Poses of other programs: units, direction, rest frame, and the HDF5 files of jaw-tracking-system."""

import builtins

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.base.errors import FormatError, MissingDependencyError
from jawusd.formats.poses import write_poses
from jawusd.geometry import se3_exp
from jawusd.pipeline.fit import RAW_GROUP, TrajectoryOptions, read_hdf5, read_motion, read_trajectory

COUNT = 8


@pytest.fixture
def poses():
    """Poses of a mandible, the first with the teeth in occlusion, and those of another frame fixed to it."""
    twists = np.random.default_rng(0).normal(size=(COUNT, 6)) * [0.1, 0.1, 0.1, 5, 5, 5]
    T = se3_exp(twists)
    T[0] = np.eye(4)
    return T, T @ se3_exp([0.4, -0.2, 1.0, 10, -110, 70.0])


def write(path, T, group=RAW_GROUP, unit="m", quaternion=True, mode="w", last=False, **extra):
    """Write a trajectory in the layout of jaw-tracking-system 1.1, with scipy's quaternions."""
    rotation = Rotation.from_matrix(T[:, :3, :3])
    with h5py.File(path, mode) as file:
        made = file.create_group(group)
        made.attrs["unit"], made.attrs["sample_rate"] = unit, 100.0
        made.create_dataset("translations", data=T[:, :3, 3] / {"m": 1000, "mm": 1}.get(unit, 1))
        turned = rotation.as_quat(scalar_first=not last) if quaternion else rotation.as_matrix()
        made.create_dataset("rotations", data=turned)
        for name, value in extra.items():
            made.create_dataset(name, data=value)
    return path


@pytest.mark.parametrize("quaternion", [True, False])
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_hdf5_is_read_in_either_form_and_unit(tmp_path, poses, quaternion, unit):
    frames, T = read_hdf5(write(tmp_path / "jaw.h5", poses[1], unit=unit, quaternion=quaternion))
    np.testing.assert_array_equal(frames, range(COUNT))
    np.testing.assert_allclose(T, poses[1], atol=1e-9)


def test_cut_files_are_read_by_their_transforms(tmp_path, poses):
    in_metres = poses[1].copy()
    in_metres[:, :3, 3] /= 1000
    path = write(tmp_path / "cut.h5", poses[1], last=True, transformations=in_metres)
    np.testing.assert_allclose(read_hdf5(path)[1], poses[1], atol=1e-9)


def test_the_rest_frame_takes_the_place_of_the_scans(tmp_path, poses):
    truth, landmark_frame = poses
    path = write(tmp_path / "jaw.h5", landmark_frame)
    _, T, _ = read_trajectory(path, TrajectoryOptions(rest_frame=0))
    np.testing.assert_allclose(T, truth, atol=1e-9)
    with pytest.raises(FormatError, match="--rest-frame"):
        read_trajectory(path, TrajectoryOptions())


def test_units_and_direction_of_a_table(tmp_path, poses):
    truth, _ = poses
    turned = np.linalg.inv(truth)
    turned[:, :3, 3] /= 10
    write_poses(tmp_path / "p.csv", np.arange(COUNT), turned)
    (_, T), _ = read_motion(tmp_path / "p.csv", TrajectoryOptions(length_unit="cm", invert=True))
    np.testing.assert_allclose(T, truth, atol=1e-9)


def test_a_rest_frame_works_for_tables_and_inverted_poses(tmp_path, poses):
    truth, elsewhere = poses
    write_poses(tmp_path / "p.csv", 5 + np.arange(COUNT), np.linalg.inv(elsewhere))
    _, T, _ = read_trajectory(tmp_path / "p.csv", TrajectoryOptions(invert=True, rest_frame=5))
    np.testing.assert_allclose(T, truth, atol=1e-9)
    with pytest.raises(FormatError, match="has no frame 4; it has frames 5 to 12"):
        read_trajectory(tmp_path / "p.csv", TrajectoryOptions(rest_frame=4))


def test_the_raw_trajectory_is_taken_unless_another_is_named(tmp_path, poses):
    path = write(tmp_path / "jaw.h5", poses[1])
    write(path, poses[0], group="T_model_origin_mand_landmark_t_smooth", mode="a")
    np.testing.assert_allclose(read_hdf5(path)[1], poses[1], atol=1e-9)
    np.testing.assert_allclose(read_hdf5(path, "T_model_origin_mand_landmark_t_smooth")[1], poses[0], atol=1e-9)
    with pytest.raises(FormatError, match='no trajectory "other"; it has T_model_origin_mand_landmark_t, '):
        read_hdf5(path, "other")


def test_frames_without_a_pose_stay_empty(tmp_path, poses):
    lost = poses[1].copy()
    path = write(tmp_path / "jaw.h5", lost, quaternion=False)
    with h5py.File(path, "a") as file:
        file[RAW_GROUP]["translations"][3] = np.nan
    T = read_hdf5(path)[1]
    assert np.isnan(T[3]).all() and np.isfinite(np.delete(T, 3, 0)).all()
    with pytest.raises(FormatError, match="frame 3 has no pose"):
        read_trajectory(path, TrajectoryOptions(rest_frame=3))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unit": "inch"}, 'unit is "inch"'),
        ({"scale": 2.0}, "row 1: the pose is not rigid"),
        ({"rotations": np.zeros((COUNT, 5))}, "rotations"),
        ({"rotations": np.zeros((COUNT, 4))}, "row 1: the quaternion is zero"),
        ({"translations": np.zeros((COUNT, 2))}, "translations"),
        ({"rotations": None}, 'no "rotations"'),
        ({"translations": None}, "trajectories: none"),
        ({"rotations": np.array([b"a"] * COUNT)}, "not an array"),
        ({"transformations": np.zeros((COUNT, 3, 4))}, "transformations"),
    ],
)
def test_each_mistake_of_an_hdf5_file_is_told(tmp_path, poses, change, words):
    path = write(tmp_path / "jaw.h5", poses[1], quaternion=False)
    with h5py.File(path, "a") as file:
        group = file[RAW_GROUP]
        for name, value in change.items():
            if name == "unit":
                group.attrs["unit"] = value
            elif name == "scale":
                group["rotations"][0] *= value
            else:
                if name in group:
                    del group[name]
                if value is not None:
                    group[name] = value
    with pytest.raises(FormatError) as caught:
        read_hdf5(path)
    assert words in str(caught.value) and "jaw.h5" in str(caught.value)


def test_what_is_no_hdf5_is_told(tmp_path):
    (tmp_path / "jaw.h5").write_text("frame,d1\n")
    with pytest.raises(FormatError, match="not a readable HDF5 file"):
        read_hdf5(tmp_path / "jaw.h5")
    with pytest.raises(FormatError, match="no such file"):
        read_hdf5(tmp_path / "other.h5")


def test_without_h5py_the_command_that_installs_it_is_named(tmp_path, poses, monkeypatch):
    path = write(tmp_path / "jaw.h5", poses[1])
    real = builtins.__import__

    def without(name, *rest):
        if name == "h5py":
            raise ModuleNotFoundError("No module named 'h5py'", name="h5py")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=r"pip install 'jawusd\[hdf5\]'"):
        read_hdf5(path)


def test_tracks_take_no_options(tmp_path):
    with pytest.raises(FormatError, match="contains tracks"):
        read_motion(tmp_path / "tracks.npz", TrajectoryOptions(invert=True))
