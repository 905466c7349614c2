"""The skin of a shot: clocks, frames, and faces that do not belong to rig or shot."""

from dataclasses import replace

import numpy as np
import pytest
from chin_points import NAMES, motion, skin_at
from example_people import person

import jawusd
from jawusd.base.errors import FittingError, FormatError
from jawusd.pipeline.skin import SkinOptions
from jawusd.pipeline.solve_skin import SkinOfShot

FPS, FACE_FPS, LATE_S = 25.0, 30.0, 0.42  # the face starts 0.42 s after frame 0 of the shot


def write_face(path, X):
    header = ",".join(["frame", *(f"{name}_{axis}" for name in NAMES for axis in "xyz")])
    table = np.column_stack([np.arange(len(X)), X.reshape(len(X), -1)])
    np.savetxt(path, table, "%.6g", ",", header=header, comments="")
    return path


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """Return a rig, the options of its skin in a shot of 20 s, and frames, d and seen frames of the shot."""
    rig, rng, folder = person("anna"), np.random.default_rng(0), tmp_path_factory.mktemp("skin")
    d = rig.project(rng.uniform(*rig.d_range.T, size=(300, 3)))
    skin = jawusd.fit_skin(rig, skin_at(rig, d, rng), d, d[:, 0] > 2, 0.1, names=NAMES)
    jawusd.save_skin(folder / "skin.npz", skin)
    face_s = np.arange(0, 18, 1 / FACE_FPS)
    X = skin_at(rig, motion(face_s + LATE_S), rng)
    options = SkinOptions(folder / "skin.npz", write_face(folder / "face.csv", X), fps=FACE_FPS)
    frames = np.arange(500.0)
    true = motion(frames / FPS)
    return rig, options, frames, true, true[:, 0] > 8


def test_the_clock_of_the_face_is_found_from_visible_teeth(shot):
    rig, options, frames, true, seen = shot
    skin = SkinOfShot(rig, options, FPS)
    found = skin(frames, np.where(seen[:, None], true, 0.0), seen)
    assert skin.offset_s == pytest.approx(LATE_S, abs=0.01)
    covered = skin.frames()
    assert covered[0] == 11 and covered[-1] == int((LATE_S + 18 - 1 / FACE_FPS) * FPS)
    assert found.familiar[covered].mean() > 0.95 and not found.familiar[: covered[0]].any()
    assert np.isnan(found.d[-1]).all()
    away = (found.d - true)[covered]
    assert np.abs(away).mean() < 0.5 and np.abs(away).max() < 3


def test_without_visible_teeth_the_offset_must_be_given(shot):
    rig, options, frames, true, seen = shot
    with pytest.raises(FittingError, match="only be estimated if teeth are visible.* --offset"):
        SkinOfShot(rig, options, FPS)(frames, true, np.zeros_like(seen))
    with pytest.raises(FittingError, match="--offset"):
        SkinOfShot(rig, options, FPS).frames()
    given = SkinOfShot(rig, replace(options, offset_s=LATE_S), FPS)
    assert given(frames, true, np.zeros_like(seen)).familiar.any()


def test_skin_of_another_subject_or_other_points_is_refused(shot, tmp_path):
    rig, options, *_ = shot
    with pytest.raises(FormatError, match='skin.npz: was learned from the skin of "anna", but the rig is of "ben"'):
        SkinOfShot(person("ben"), options, FPS)
    other = write_face(tmp_path / "face.csv", np.zeros((5, 4, 3)))
    other.write_text(other.read_text().replace("chin", "nose"))
    with pytest.raises(FormatError, match="12 coordinates of points.*same names; missing: chin"):
        SkinOfShot(rig, replace(options, face=other), FPS)
    other.write_text("frame,a,b\n0,1,2\n1,2,3\n")
    with pytest.raises(FormatError, match="2 columns;.* learned from 12 coordinates"):
        SkinOfShot(rig, replace(options, face=other), FPS)
    with pytest.raises(FormatError, match="--face-fps"):
        SkinOfShot(rig, replace(options, fps=None), FPS)


def test_skin_that_contradicts_the_teeth_is_refused(shot):
    """A wrong unit, and clocks that are off by one and a half seconds."""
    rig, options, frames, true, seen = shot
    with pytest.raises(FittingError, match="none of the 500 frames does the face resemble.*--length-unit"):
        SkinOfShot(rig, replace(options, unit="cm", offset_s=LATE_S), FPS)(frames, true, seen)
    with pytest.raises(FittingError, match="frames with visible teeth, d from the skin differs.*--offset"):
        SkinOfShot(rig, replace(options, offset_s=LATE_S + 1.5), FPS)(frames, true, seen)
