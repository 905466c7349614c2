"""`jawusd fit` with poses and anatomy of other programs, and `jawusd report`."""

import json
import re

import h5py
import numpy as np
import pytest
import run_jawusd
from package_copy import ROOT
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from jawusd.cli.main import app
from jawusd.formats.model import load_model
from jawusd.formats.poses import write_poses
from jawusd.geometry import LANDMARKS, make_transform
from jawusd.paper import experiments, nlpca
from jawusd.pipeline.fit import fit_subject
from jawusd.pipeline.report import TABLE_FILE
from jawusd.synthetic.exercises import record
from jawusd.synthetic.person import Person

FRAMES = 150
EXAMPLE = ROOT / "examples" / "capture"
SCANS = EXAMPLE / "scans"


def run(*arguments, code=0):
    """Run the program; return its standard output, or its error message in one line."""
    told = run_jawusd.run(*arguments, code=code)
    return told if code == 0 else " ".join(told.replace("│", " ").split())


@pytest.fixture(scope="module")
def person():
    return Person(2)


@pytest.fixture(scope="module")
def poses(person):
    return record(person, FRAMES, 1).T_noisy


@pytest.fixture(scope="module")
def given(person, poses, tmp_path_factory):
    """The same poses as a CSV of jawusd, another table in metres, and HDF5; and the person's landmarks."""
    folder = tmp_path_factory.mktemp("given")
    frames = np.arange(FRAMES)
    write_poses(folder / "poses.csv", frames, poses)
    rows = np.column_stack([frames, poses[:, :3, 3] / 1000, Rotation.from_matrix(poses[:, :3, :3]).as_quat()])
    np.savetxt(folder / "foreign.csv", rows, delimiter=",", header="Frame,X,Y,Z,I,J,K,W", comments="")
    landmark_frame = np.array([[0, 0, 1, 5.0], [1, 0, 0, -60], [0, 1, 0, 40], [0, 0, 0, 1]])
    seen = np.concatenate([np.eye(4)[None], poses]) @ landmark_frame
    with h5py.File(folder / "jaw.h5", "w") as file:
        group = file.create_group("T_model_origin_mand_landmark_t")
        group.attrs["unit"] = "mm"
        group["translations"] = seen[:, :3, 3]
        group["rotations"] = Rotation.from_matrix(seen[:, :3, :3]).as_quat(scalar_first=True)
    data = {
        "format": "jawusd-landmarks/1",
        "units": "mm",
        "landmarks": dict(zip(LANDMARKS, person.landmarks.tolist(), strict=True)),
        "T_anatomical_skull": make_transform(np.eye(3), -person.landmarks[0]).tolist(),
    }
    (folder / "landmarks.json").write_text(json.dumps(data))
    plate = person.landmarks[:4]
    moved = np.einsum("fij,nj->fni", poses[:, :3, :3], plate) + poses[:, None, :3, 3]
    np.savetxt(folder / "markers.asc", moved.reshape(FRAMES, -1), fmt="%.12e")
    rows = [f"{number} {x!r} {y!r} {z!r} 1" for number, (x, y, z) in enumerate(plate.tolist(), start=1)]
    (folder / "jaw.rig").write_text("\n".join(["4 ;Number of markers", "Marker X Y Z Views", *rows]))
    return folder


@pytest.fixture
def fitted_to(monkeypatch):
    """Note the poses of every fit, (frames, T_skull_mandible [mm]); a fit to the same poses as the first is not made.

    A fit of few poses at five landmarks amplifies their rounding, and takes seconds.
    """
    noted, models = [], []

    def fit_once(subject, motion, method, progress, fps):
        if not models or fps is not None:
            models.append(fit_subject(subject, motion, method, progress, fps))
        noted.append(motion)
        return models[-1]

    monkeypatch.setattr("jawusd.pipeline.fit.fit_subject", fit_once)
    return noted


@pytest.mark.slow
def test_the_same_poses_give_the_same_model_however_they_are_written(given, tmp_path, poses, fitted_to):
    whose = ("--landmarks", given / "landmarks.json")
    columns = "frame=Frame,tx=X,ty=Y,tz=Z,qw=W,qx=I,qy=J,qz=K"
    found = json.loads(run("fit", given / "poses.csv", *whose, "-o", tmp_path / "a.npz", "--json"))
    assert found["errors"]["train"]["mandible"]["mean"] < 0.6
    run("fit", given / "foreign.csv", *whose, "--columns", columns, "--length-unit", "m", "-o", tmp_path / "b.npz")
    run("fit", given / "jaw.h5", *whose, "--rest-frame", 0, "-o", tmp_path / "c.npz")
    body = f"jaw={given / 'jaw.rig'}"
    run("fit", given / "markers.asc", *whose, "--rigid", body, "-o", tmp_path / "d.npz")
    markers = np.loadtxt(given / "markers.asc").reshape(FRAMES, 4, 3)
    head = f"NO_OF_FRAMES\t{FRAMES}\nNO_OF_MARKERS\t4\nFREQUENCY\t120\nDATA_INCLUDED\t3D\nMARKER_NAMES\tA\tB\tC\tD"
    np.savetxt(tmp_path / "qtm.tsv", markers.reshape(FRAMES, -1), "%.9f", "\t", header=head, comments="")
    rest = ("--rigid", "jaw=A,B,C,D", "--rest-frame", 0)
    run("fit", tmp_path / "qtm.tsv", *whose, *rest, "-o", tmp_path / "e.npz")
    ours, named = (load_model(tmp_path / f"{name}.npz") for name in "ae")
    assert named.meta["fps"] == 120 and "fps" not in ours.meta
    tables, foreign, hdf5, rigid, _ = ((frames.tolist(), T) for frames, T in fitted_to)
    for frames, T in (tables, foreign, rigid, (hdf5[0][:-1], hdf5[1][1:])):  # HDF5 has one more pose, the first
        assert len(frames) == FRAMES and frames == tables[0]
        np.testing.assert_allclose(T, poses, rtol=0, atol=1e-6)


def test_rigid_bodies_that_cannot_be_read_are_refused(given):
    whose = ("--landmarks", given / "landmarks.json")
    assert "jaw=MARKERS" in run("fit", given / "markers.asc", *whose, "--rigid", "tongue=1,2,3", code=2)
    twice = ("--rigid", "jaw=1,2,3", "--rigid", "jaw=1,2,4")
    assert "given twice" in run("fit", given / "markers.asc", *whose, *twice, code=2)


@pytest.mark.slow
def test_scans_take_the_place_of_a_capture(given, tmp_path, poses):
    scans = ["--upper-teeth", SCANS / "upper_teeth.ply", "--lower-teeth", SCANS / "lower_teeth.ply"]
    scans += ["--mandible", SCANS / "mandible.ply"]
    text = (EXAMPLE / "capture.toml").read_text().replace('skull = "scans/skull.ply"\n', "")  # the scans lack it, too
    (tmp_path / "capture.toml").write_text(re.sub(r'"(\w+/[^"]+\.\w+|calibration.toml)"', rf'"{EXAMPLE}/\1"', text))
    capture = ["--capture", tmp_path, "--allow-outside"]
    run("fit", given / "poses.csv", *scans, "-o", tmp_path / "scans.npz")
    command = ["fit", given / "poses.csv", *capture, "-o", tmp_path / "capture.npz"]
    assert CliRunner().invoke(app, list(map(str, command)), catch_exceptions=False).exit_code == 0
    loose, whole = load_model(tmp_path / "scans.npz"), load_model(tmp_path / "capture.npz")
    np.testing.assert_array_equal(loose.d, whole.d)
    assert loose.meta["actor"] == "poses" and loose.meta["inferred"] == whole.meta["inferred"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        ([], 2, "give either --capture, or --upper-teeth and --lower-teeth, or --landmarks"),
        (["--landmarks", "landmarks.json", "--capture", "x"], 2, "give either"),
        (["--upper-teeth", "u.ply"], 2, "both --upper-teeth and --lower-teeth"),
        (["--landmarks", "landmarks.json", "--columns", "tx"], 2, "not of the form name=column"),
        (["--landmarks", "landmarks.json", "--columns", "x=X"], 2, '"x" is not a column of poses'),
        (["--landmarks", "landmarks.json", "--columns", "tx=X,tx=Y"], 2, '"tx" is given twice'),
        (["--landmarks", "landmarks.json", "--columns", "tx=X"], 3, 'no column "X" to read as "tx"'),
        (["--landmarks", "landmarks.json", "--rest-frame", "999"], 3, "has no frame 999"),
        (["--landmarks", "nothing.json"], 3, "there is no such file"),
    ],
)
def test_each_mistake_is_one_clear_error(given, tmp_path, arguments, code, words):
    arguments = [given / text if text.endswith(".json") else text for text in arguments]
    assert words in run("fit", given / "poses.csv", *arguments, "-o", tmp_path / "m.npz", code=code)
    assert not (tmp_path / "m.npz").exists()


@pytest.mark.slow
def test_report_draws_and_prints_the_experiments(given, tmp_path, monkeypatch):
    """Run in this process, so that the networks' training can be cut to a tenth."""
    train = nlpca.train_nlpca
    monkeypatch.setattr(nlpca, "train_nlpca", lambda *a, **k: train(*a, **(k | {"stages": 2})))
    monkeypatch.setattr(experiments, "POSES", 200)
    monkeypatch.setattr(experiments, "_BATCH", 800)
    out = tmp_path / "figures"
    command = ["report", given / "poses.csv", "--experiments", "--landmarks", given / "landmarks.json", "-o", out]
    result = CliRunner().invoke(app, [*map(str, command), "--starts", "1", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["frames"] == FRAMES and {row["experiment"] for row in found["table"]} == {
        "condyle path", "reconstruction", "synthesis"
    }  # fmt: skip
    assert len(list(out.glob("*.png"))) == len(list(out.glob("*.svg"))) == 4
    lines = (out / TABLE_FILE).read_text().splitlines()
    assert len(lines) == len(found["table"]) + 1
    assert "--force" in run(*command, code=10)


@pytest.mark.slow
def test_report_says_what_it_needs(given, tmp_path):
    assert "--experiments" in run("report", given / "poses.csv", code=2)
    assert "-o" in run("report", given / "poses.csv", "--experiments", code=2)
    assert "give either --capture" in run("report", given / "poses.csv", "--experiments", "-o", tmp_path / "f", code=2)
    assert "tracks.npz: there is no such file" in run("report", given, "--experiments", code=3)
