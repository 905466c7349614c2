"""Tables of poses with other column names, and landmarks files: what is read, and what each mistake is told."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jawusd.base.errors import FormatError, UnitsError, VersionError
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.poses import read_poses

MAP = {"frame": "Frame", "tx": "X", "ty": "Y", "tz": "Z", "qw": "W", "qx": "I", "qy": "J", "qz": "K"}
NAMES = ("incisor", "molar_left", "molar_right", "condyle_left", "condyle_right")


def quaternion_table(path, rotation, t, header="Frame,X,Y,Z,I,J,K,W"):
    rows = np.column_stack([np.arange(10, 10 + len(t)), t, rotation.as_quat()])
    lines = [header, *(",".join(f"{value:.12g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def motion():
    rng = np.random.default_rng(0)
    return Rotation.random(6, rng=rng), rng.normal(size=(6, 3)) * 20


def test_a_column_map_reads_scipys_quaternions(tmp_path, motion):
    rotation, t = motion
    frames, T = read_poses(quaternion_table(tmp_path / "p.csv", rotation, t), MAP)
    np.testing.assert_array_equal(frames, np.arange(10, 16))
    np.testing.assert_allclose(T[:, :3, :3], rotation.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(T[:, :3, 3], t, atol=1e-9)


def test_a_map_need_only_name_what_differs(tmp_path, motion):
    rotation, t = motion
    path = quaternion_table(tmp_path / "p.csv", rotation, t, "time,tx,ty,tz,qx,qy,qz,qw")
    _, T = read_poses(path, {"frame": "time"})
    np.testing.assert_allclose(T[:, :3, 3], t, atol=1e-9)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_are_recognised(tmp_path, motion, separator):
    path = quaternion_table(tmp_path / "p.csv", *motion)
    path.write_text("# exported, by hand\n" + path.read_text().replace(",", separator))
    np.testing.assert_allclose(read_poses(path, MAP)[1][:, :3, 3], motion[1], atol=1e-9)


def test_rows_of_a_foreign_table_without_frames_are_numbered(tmp_path, motion):
    path = quaternion_table(tmp_path / "p.csv", *motion, "seconds,X,Y,Z,I,J,K,W")
    frames, _ = read_poses(path, {name: theirs for name, theirs in MAP.items() if name != "frame"})
    np.testing.assert_array_equal(frames, range(6))
    with pytest.raises(FormatError, match='no column "frame"'):
        read_poses(path)


def test_the_last_matrix_row_may_be_left_out(tmp_path, motion):
    rotation, t = motion
    rows = np.concatenate([rotation.as_matrix(), t[:, :, None]], axis=2).reshape(6, 12)
    header = ",".join(["frame", *(f"m{i}{j}" for i in range(3) for j in range(4))])
    lines = [f"{k}," + ",".join(map(repr, map(float, row))) for k, row in enumerate(rows)]
    (tmp_path / "p.csv").write_text("\n".join([header, *lines]))
    _, T = read_poses(tmp_path / "p.csv")
    np.testing.assert_allclose(T[:, :3], rows.reshape(6, 3, 4), atol=1e-12)
    np.testing.assert_array_equal(T[:, 3], np.tile([0, 0, 0, 1], (6, 1)))


@pytest.mark.parametrize(
    ("change", "columns", "words"),
    [
        (("Frame", "Picture"), MAP, 'no column "Frame" to read as "frame"'),
        (("Frame", "frame"), None, "--columns"),
        (("10,", "10.5,"), MAP, 'line 2, column "Frame" is 10.5'),
        (("11,", "x,"), MAP, 'line 3, column "Frame": "x" is not a number'),
        (("12,", "nan,"), MAP, 'line 4, column "Frame" is nan'),
    ],
)
def test_each_mistake_is_told_with_row_and_column(tmp_path, motion, change, columns, words):
    path = quaternion_table(tmp_path / "p.csv", *motion)
    path.write_text(path.read_text().replace(*change, 1))
    with pytest.raises(FormatError) as caught:
        read_poses(path, columns)
    assert words in str(caught.value) and str(path) in str(caught.value)


def test_a_zero_quaternion_names_its_row(tmp_path):
    (tmp_path / "p.csv").write_text("Frame,X,Y,Z,I,J,K,W\n1,0,0,0,0,0,0,1\n2,0,0,0,0,0,0,0\n")
    with pytest.raises(FormatError, match="line 3: the quaternion is zero"):
        read_poses(tmp_path / "p.csv", MAP)


def landmarks_file(path, **change):
    data = {"format": "jawusd-landmarks/1", "units": "mm", "landmarks": {name: [1.0, 2, 3] for name in NAMES}} | change
    path.write_text(json.dumps(data))
    return path


def test_landmarks_keep_their_order(tmp_path):
    points = {name: [float(k), 0, 0] for k, name in enumerate(NAMES)}
    shuffled = dict(reversed(points.items()))
    found = load_landmarks(landmarks_file(tmp_path / "l.json", landmarks=shuffled))
    np.testing.assert_array_equal(found.landmarks[:, 0], range(5))
    assert found.T_anatomical_skull is None
    given = load_landmarks(landmarks_file(tmp_path / "l.json", T_anatomical_skull=np.eye(4).tolist()))
    np.testing.assert_array_equal(given.T_anatomical_skull, np.eye(4))


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({"format": "jawusd-model/1"}, FormatError, "jawusd-landmarks/1"),
        ({"format": "jawusd-landmarks/2"}, VersionError, "Update"),
        ({"units": "cm"}, UnitsError, '"cm"; they must be "mm"'),
        ({"landmarks": {"incisor": [0, 0, 0]}}, FormatError, "molar_left"),
        ({"landmarks": {name: [0, 0] for name in NAMES}}, FormatError, 'landmark "incisor"'),
        ({"landmarks": {name: ["a", 0, 0] for name in NAMES}}, FormatError, "array of numbers"),
        ({"T_anatomical_skull": (2 * np.eye(4)).tolist()}, FormatError, "rigid"),
        ({"landmark": {}}, FormatError, 'unknown key "landmark"'),
    ],
)
def test_a_wrong_landmarks_file_is_refused(tmp_path, change, kind, words):
    with pytest.raises(kind) as caught:
        load_landmarks(landmarks_file(tmp_path / "l.json", **change))
    assert words in str(caught.value) and "l.json" in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{", "\x00"])
def test_what_is_no_json_object_is_refused(tmp_path, text):
    (tmp_path / "l.json").write_text(text)
    with pytest.raises(FormatError):
        load_landmarks(tmp_path / "l.json")
