"""The skin of live frames: recorded and streamed faces, hidden teeth, and faces that do not belong to the map."""

import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from chin_points import NAMES, motion, skin_at
from example_people import person

import jawusd
from jawusd.base.errors import FittingError, FormatError
from jawusd.formats.performance import SolveState
from jawusd.media import live_source
from jawusd.pipeline.live_jaw import LiveJaw, LiveSkin, columns_between
from jawusd.pipeline.skin import SkinOptions

FPS, FACE_FPS = 24.0, 60.0
HEADER = ",".join(["time_s", *(f"{name}_{axis}" for name in NAMES for axis in "xyz")])


def lines(times, X):
    """Return the rows of a face table as lines."""
    return [",".join(f"{value:.9g}" for value in (t, *x.ravel())) + "\n" for t, x in zip(times, X, strict=True)]


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """Return a rig and the file of its map."""
    rig, rng, folder = person("anna"), np.random.default_rng(0), tmp_path_factory.mktemp("skin")
    d = rig.project(rng.uniform(*rig.d_range.T, size=(300, 3)))
    jawusd.save_skin(folder / "skin.npz", jawusd.fit_skin(rig, skin_at(rig, d, rng), d, d[:, 0] > 2, 0.1, names=NAMES))
    return rig, folder / "skin.npz"


@pytest.fixture
def options(learned, tmp_path):
    """Return the options of a face of 40 s, whose tracker is off by up to 0.8 mm for seconds at a time."""
    rig, skin = learned
    rng, times = np.random.default_rng(1), np.arange(0, 40, 1 / FACE_FPS)
    X = skin_at(rig, motion(times), rng) + 0.8 * np.sin(0.9 * times)[:, None, None] * [0, 1, 0]
    (tmp_path / "face.csv").write_text("".join([HEADER + "\n", *lines(times, X)]))
    return SkinOptions(skin, tmp_path / "face.csv")


def followed(rig, options, hidden, begin=100.0):
    """Return d (F, 3), states and familiar of 36 s whose teeth are hidden in some frames."""
    skin, held, told = LiveSkin(rig, options, recorded=True), np.zeros(3), []
    skin.face.play(begin, 1.0)
    times = np.arange(1, 36 * FPS) / FPS
    for t, true in zip(times, motion(times), strict=True):
        seen = not hidden(t)
        held = true if seen else held
        size = 0.1 if seen else 5.0
        state = SolveState.SOLVED if seen else SolveState.CARRIED
        jaw = skin.fuse(begin + t, LiveJaw(held, size**2 * np.eye(3), state), 1 / FPS)
        held = jaw.d
        told.append(jaw)
    skin.face.stop()
    return times, told


def test_skin_moves_a_jaw_whose_teeth_are_hidden(learned, options, tmp_path):
    """Teeth are seen for 0.5 s of every 2 s; without skin, the last jaw is held."""
    rig, _ = learned

    def hidden(t):
        return t % 2 > 0.5

    times, told = followed(rig, options, hidden)
    unseen, true = hidden(times), motion(times)
    errors = np.abs(np.array([jaw.d for jaw in told]) - true)[unseen]
    (tmp_path / "none.csv").write_text("".join([HEADER + "\n", *lines([900.0, 901.0], np.zeros((2, 4, 3)))]))
    _, without = followed(rig, replace(options, face=tmp_path / "none.csv"), hidden)
    held = np.abs(np.array([jaw.d for jaw in without]) - true)[unseen]
    assert errors.mean() < 0.3 * held.mean() and errors[:, 0].mean() < 0.6 < 2.0 < held[:, 0].mean()
    states = np.array([jaw.state for jaw in told])
    assert (states[unseen] == SolveState.SKIN).all() and (states[~unseen] == SolveState.SOLVED).all()
    assert all(jaw.state == SolveState.CARRIED and jaw.familiar is None for jaw, u in zip(without, unseen) if u)


def test_seen_teeth_correct_the_skin(learned, options):
    """The tracker's slow error is known best right after the teeth were seen."""
    rig, _ = learned
    times, told = followed(rig, options, lambda t: t % 2 > 0.5)
    errors = np.abs(np.array([jaw.d for jaw in told]) - motion(times))[:, 0]
    soon, late = (errors[(times % 2 > a) & (times % 2 < a + 0.3)].mean() for a in (0.52, 1.6))
    assert soon < 0.7 * late
    raw = jawusd.load_skin(options.skin)
    rows = np.loadtxt(options.face, delimiter=",", skiprows=1)
    alone = np.abs(raw(rows[:, 1:]).d - motion(rows[:, 0]))[:, 0].mean()
    assert errors[times % 2 > 0.5].mean() < 0.85 * alone


def test_a_strange_face_is_flagged_and_less_certain(learned, options, tmp_path):
    """The cheek is blown out for a second."""
    rig, _ = learned
    rows = np.loadtxt(options.face, delimiter=",", skiprows=1)
    strange = (rows[:, 0] > 20) & (rows[:, 0] < 21)
    rows[strange, 1 + 3] += 9.0
    (tmp_path / "strange.csv").write_text("".join([HEADER + "\n", *lines(rows[:, 0], rows[:, 1:])]))
    times, told = followed(rig, replace(options, face=tmp_path / "strange.csv"), lambda t: t > 15)
    sigma = np.array([np.sqrt(jaw.covariance[0, 0]) for jaw in told])
    during, after = (times > 20.1) & (times < 20.9), times > 22
    assert not any(jaw.familiar for jaw, odd in zip(told, during, strict=True) if odd)
    assert np.mean([jaw.familiar for jaw, usual in zip(told, after, strict=True) if usual]) > 0.95
    assert sigma[during].min() > 2 * np.median(sigma[after])


def test_skin_that_contradicts_the_teeth_ends_the_session(learned, options):
    rig, _ = learned
    with pytest.raises(FittingError, match="in 240 frames with visible teeth, d from the skin differs.*--offset"):
        followed(rig, replace(options, offset_s=1.5), lambda t: False)


def test_maps_and_faces_of_others_are_refused(learned, options, tmp_path):
    rig, _ = learned
    with pytest.raises(FormatError, match='skin.npz: was learned from the skin of "anna", but the rig is of "ben"'):
        LiveSkin(person("ben"), options, recorded=False)
    other = tmp_path / "other.csv"
    other.write_text("time_s,a,b\n0,1,2\n1,2,3\n")
    with pytest.raises(FormatError, match="2 columns;.* learned from 12 coordinates"):
        LiveSkin(rig, replace(options, face=other), recorded=True)
    stream = LiveSkin(rig, replace(options, face=other), recorded=False)
    with pytest.raises(FormatError, match="2 columns;.* learned from 12 coordinates"):
        stream.face.play(0.0, 5.0)
    stream.face.stop()
    other.write_text(HEADER.replace("time_s", "frame") + "\n" + lines([0.0], np.zeros((1, 4, 3)))[0])
    with pytest.raises(FormatError, match="--face-fps"):
        LiveSkin(rig, replace(options, face=other), recorded=True)
    with pytest.raises(FormatError, match="--rigid applies only to recorded faces"):
        LiveSkin(rig, replace(options, rigid={"head": "1,2,3"}), recorded=False)
    with pytest.raises(FormatError, match="no such file.*a pipe, or -"):
        LiveSkin(rig, replace(options, face=tmp_path / "nothing.csv"), recorded=False)


@pytest.mark.parametrize("pipe", [False, True])
def test_a_face_is_followed_while_it_is_written(learned, options, tmp_path, pipe):
    """The tracker has its own clock and stops after half a second; rows arrive in pieces."""
    rig, skin = learned
    path, rng = tmp_path / "live.csv", np.random.default_rng(2)
    if pipe:
        os.mkfifo(path)
    else:
        path.write_text("")
    began = live_source.now_s()

    def write():
        with open(path, "a", encoding="utf-8") as file:
            file.write(HEADER + "\n")
            while (t := live_source.now_s() - began) < 0.5:
                line = lines([5000.0 + t], skin_at(rig, motion(np.array([t])), rng))[0]
                for part in (line[:30], line[30:]):
                    file.write(part)
                    file.flush()
                time.sleep(1 / FACE_FPS)
            time.sleep(1.0)

    face = LiveSkin(rig, SkinOptions(skin, path), recorded=False)
    writer = threading.Thread(target=write)
    writer.start()
    face.face.play(began, 10.0)
    unknown = LiveJaw(np.zeros(3), 100 * np.eye(3), SolveState.CARRIED)
    told = []
    while (at := live_source.now_s()) < began + 0.45:
        told.append((at - began, face.fuse(at, unknown, 1 / FPS)))
    by_skin = [(t, jaw) for t, jaw in told if jaw.state == SolveState.SKIN]
    assert by_skin
    for t, jaw in by_skin:
        assert np.abs(jaw.d - motion(np.array([t]))[0]).max() < 2.0
    time.sleep(max(0.0, began + 0.9 - live_source.now_s()))
    silent = face.fuse(live_source.now_s(), unknown, 1 / FPS)
    assert silent.state == SolveState.CARRIED and silent.familiar is None
    face.face.stop()
    writer.join()


def test_a_face_that_never_comes_or_goes_back_is_refused(learned, tmp_path):
    rig, skin = learned
    path = tmp_path / "live.csv"
    path.write_text(HEADER + "\n")
    silent = LiveSkin(rig, SkinOptions(skin, path), recorded=False)
    with pytest.raises(FormatError, match="no row of face data after 0.2 s.*without buffering"):
        silent.face.play(0.0, 0.2)
    silent.face.stop()
    path.write_text("".join([HEADER + "\n", *lines([1.0, 0.5], np.zeros((2, 4, 3)))]))
    back = LiveSkin(rig, SkinOptions(skin, path), recorded=False)
    with pytest.raises(FormatError, match="line 3 is not later than the row before"):
        back.face.play(0.0, 5.0)
        for _ in range(50):
            back.fuse(live_source.now_s(), LiveJaw(np.zeros(3), np.eye(3), SolveState.CARRIED), 0.04)
    back.face.stop()


def test_columns_are_interpolated_over_short_gaps_only():
    times, rows = np.array([0.0, 0.1, 0.2, 0.9]), np.array([[0.0], [1.0], [np.nan], [3.0]])
    assert columns_between(times, rows, 0.025) == pytest.approx(0.25)
    for unknown in (-0.1, 0.15, 0.5, 1.0):
        assert np.isnan(columns_between(times, rows, unknown)).all()
