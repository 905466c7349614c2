"""The example's videos played as live cameras."""

import json
import os
import re
import socket
import threading
import time

import av
import numpy as np
import pytest
from package_copy import ROOT
from pythonosc.osc_packet import OscPacket
from run_jawusd import run

import jawusd
from jawusd.base.errors import CaptureError, FormatError, OutputError
from jawusd.formats.performance import SolveState
from jawusd.geometry import transform_point, transform_points
from jawusd.media import live_source
from jawusd.media.live_source import LivePicture, LiveSource
from jawusd.pipeline.cameras import load_cameras, open_videos
from jawusd.pipeline.live import OscSender, _Follower, live, next_instant
from jawusd.pipeline.live_jaw import LiveFrame
from jawusd.pipeline.skin import SkinOptions
from jawusd.pipeline.subject import load_labelled, registered_meshes
from jawusd.pipeline.videos import Cutter, PreparedTeeth
from jawusd.pipeline.workspace import open_capture
from jawusd.segmentation.picture import ColourFootage
from jawusd.tracking.region.performance import LiveTake

EXAMPLE, FPS = ROOT / "examples" / "capture", 24.0


@pytest.fixture(scope="module")
def rig(example_build):
    return example_build[0] / "actor.usda"


@pytest.fixture
def film(tmp_path):
    """Return a video of 24 pictures at 24 fps; picture k has the brightness 10 k."""
    with av.open(str(tmp_path / "film.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=24, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv444p"
        for k in range(24):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 10 * k, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return str(tmp_path / "film.mp4")


def played(*arguments):
    source = LiveSource(*arguments)
    source.open()
    source.wait_open(20.0)
    begin = time.monotonic()
    source.play(begin)
    return source, begin


def test_files_are_played_at_their_own_rate(film):
    source, begin = played(film, (64, 48))
    while not source.ended:
        source.wait((source.times_s() or [-1.0])[-1], 0.5)
    assert time.monotonic() - begin > 23 / 24 - 0.01
    assert source.times_s()[-1] == pytest.approx(begin + 23 / 24, abs=1e-3)
    picture = source.at(begin + 22 / 24)
    assert picture is not None and abs(np.asarray(picture.rgb).mean() - 220) < 4


def test_a_file_begun_earlier_shows_its_pictures_earlier(film):
    """At the same instant, the source that started half a second earlier is 12 pictures ahead."""
    source, begin = played(film, (64, 48), 0.5)
    source.wait(begin - 0.5, 2.0)
    assert source.times_s() and source.times_s()[-1] < begin + 0.1
    assert source.at(begin) is not None and np.asarray(source.at(begin).rgb).mean() > 100
    source.stop()


@pytest.mark.parametrize(("where", "size"), [("film", (32, 48)), ("/dev/no_such_camera", (64, 48))])
def test_sources_that_cannot_be_used_are_refused(film, where, size):
    source, _ = played(film if where == "film" else where, size)
    with pytest.raises(CaptureError, match=r"calibration is for|cannot be read"):
        for _ in range(50):
            source.wait(np.inf, 0.1)
            source.times_s()
    assert source.ended


@pytest.fixture
def silent():
    """Return the address of a server that accepts connections and sends nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


def test_a_source_that_connects_and_is_silent_is_not_waited_for(silent):
    source = LiveSource(silent, (64, 48))
    source.open()
    with pytest.raises(CaptureError, match=r"tcp.*has sent no image for 0.5 s"):
        source.wait_open(0.5)
    source.stop()


def test_a_source_that_falls_silent_is_not_waited_for(film, tmp_path):
    """The first pictures of a video arrive through a pipe, which then stays open."""
    pipe = tmp_path / "camera.ts"
    os.mkfifo(pipe)
    with av.open(film) as read, av.open(str(tmp_path / "film.ts"), "w") as write:
        stream = write.add_stream_from_template(read.streams.video[0])
        for packet in read.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                write.mux(packet)
    source = LiveSource(str(pipe), (64, 48))
    source.open()
    with open(pipe, "wb") as camera:
        camera.write((tmp_path / "film.ts").read_bytes() * 4)
        camera.flush()
        source.wait_open(20.0)
        source.play(live_source.now_s())
        with pytest.raises(CaptureError, match="has sent no image for 1 s"):
            for _ in range(200):
                source.wait(np.inf, 0.1)
                source.refuse_silence(1.0)
        assert source.times_s()


@pytest.mark.slow
def test_live_ends_where_no_camera_sends(rig, silent):
    with pytest.raises(CaptureError, match="has sent no image for 0.5 s"):
        list(live(rig, EXAMPLE, dict.fromkeys(("cam0", "cam1", "cam2"), silent), silence_s=0.5))


def test_files_may_begin_late(film):
    source = LiveSource(film, (64, 48), -30.0)
    source.open()
    source.wait_open(1e-9)
    source.play(live_source.now_s())
    source.refuse_silence(1e-9)
    source.stop()


def test_instants_are_taken_in_turn_and_left_out_when_too_old():
    left, right = np.arange(0.0, 0.40, 0.04), np.arange(0.01, 0.40, 0.04)
    assert next_instant([left[:3], []], -1.0) is None
    assert next_instant([left[:3], right[:2]], -1.0) == right[0]  # all have it
    assert next_instant([left[:3], right[:2]], right[0] + 0.02) == right[1]
    assert next_instant([left[:3], right[:2]], right[1] + 0.02) is None
    assert next_instant([left, right], -1.0) == left[6]  # no more than 0.15 s before the newest of the slower one


def test_sources_of_unknown_cameras_are_refused(rig):
    with pytest.raises(CaptureError, match="unknown cameras nobody"):
        next(live(rig, EXAMPLE, {"nobody": "/dev/video0"}))


def test_one_of_several_rigs_is_followed(rig, tmp_path):
    references = "".join(f'def "{name}" (references = @{rig}@) {{}}\n' for name in "ab")
    (tmp_path / "two.usda").write_text(f"#usda 1.0\n{references}")
    with pytest.raises(FormatError, match="several jaw rigs: /a, /b"):
        next(live(tmp_path / "two.usda", EXAMPLE, {"nobody": "/dev/video0"}))
    with pytest.raises(CaptureError, match="unknown cameras nobody"):
        next(live(tmp_path / "two.usda", EXAMPLE, {"nobody": "/dev/video0"}, prim="/b"))


def frame():
    d, sigma = np.array([12.5, -1.25, 0.5]), np.array([0.125, 0.25, 0.5])
    return LiveFrame(1.5, d, sigma, 0.75, "valid", str(SolveState.CARRIED), 41.26, 2, familiar=False)


def test_osc_messages_arrive():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        sender = OscSender(f"127.0.0.1:{receiver.getsockname()[1]}")
        sender.send(frame())
        sender.close()
        packet = receiver.recv(4096)
    assert packet.startswith(b"#bundle\0")
    found = {timed.message.address: timed.message.params for timed in OscPacket(packet).messages}
    assert found["/jaw/d"] == [12.5, -1.25, 0.5] and found["/jaw/sigma"] == [0.125, 0.25, 0.5]
    assert found["/jaw/margin"] == [0.75] and found["/jaw/time"] == [1.5] and found["/jaw/state"] == [2]
    assert found["/jaw/familiar"] == [0]


def test_nobody_need_listen_to_osc():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    sender = OscSender(f"127.0.0.1:{port}")
    for _ in range(5):
        sender.send(frame())
    sender.close()


@pytest.mark.parametrize("address", ["9000", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:http", ":9000"])
def test_addresses_that_are_none_are_refused(address):
    with pytest.raises(OutputError, match="not an address"):
        OscSender(address)


def test_lines_say_what_the_frame_holds():
    assert frame().as_json() == {
        "time_s": 1.5,
        "d": [12.5, -1.25, 0.5],
        "sigma": [0.125, 0.25, 0.5],
        "margin_mm": 0.75,
        "verdict": "valid",
        "state": "carried",
        "latency_ms": 41.3,
        "dropped": 2,
        "familiar": False,
    }


@pytest.fixture
def patient_film(monkeypatch):
    """Advance the videos only when the follower waits for a picture, so that slow machines drop no frames."""
    moved, wait = threading.Condition(), LiveSource.wait
    shown = [0.0]

    def wait_until(time_s, stopped):
        with moved:
            moved.wait_for(lambda: stopped.is_set() or time_s <= shown[0] + 1e-6)
        return stopped.is_set()

    def asked(source, after_s, timeout_s):
        with moved:
            shown[0] = max(shown[0], after_s + 0.5 / FPS)
            moved.notify_all()
        return wait(source, after_s, timeout_s)

    monkeypatch.setattr(live_source, "now_s", lambda: shown[0])
    monkeypatch.setattr(live_source, "wait_until", wait_until)
    monkeypatch.setattr(LiveSource, "wait", asked)
    yield
    shown[0] = np.inf
    with moved:
        moved.notify_all()


@pytest.mark.slow
def test_the_example_is_followed_at_every_frame(rig, patient_film):
    told = list(live(rig, EXAMPLE, seconds=39.5 / FPS))
    assert len(told) == 40 and all(found.dropped == 0 for found in told)
    np.testing.assert_allclose(np.diff([found.time_s for found in told]), 1 / FPS, atol=1e-3)
    jaw, errors = jawusd.load(rig), []
    tip = jaw.landmarks[0]
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        relative = dict(zip(truth["frames"].tolist(), truth["T_upper_lower"], strict=True))
    for found in told:
        if found.state == "solved":
            wanted = transform_point(relative[round(found.time_s * FPS)], tip)
            errors.append(np.linalg.norm(transform_point(jaw.pose(found.d), tip) - wanted))
    assert len(errors) >= 36 and np.median(errors) < 0.3 and max(errors) < 1.0


@pytest.fixture
def covered(monkeypatch):
    """Cover the mouth for a second: from frame 76 to 99, the pictures of all cameras are grey."""
    shown = LiveSource.at

    def at(source, time_s):
        picture = shown(source, time_s)
        if picture is None or not 76 <= round((time_s - source._begin_s) * FPS) < 100:
            return picture
        return LivePicture(picture.time_s, np.full((*source._size_px[::-1], 3), 128, np.uint8))

    monkeypatch.setattr(LiveSource, "at", at)


@pytest.fixture
def begun(monkeypatch):
    """Start live tracking from the true pose in frame 60, which takes less time than a search."""

    def begin(follower):
        footage = ColourFootage(open_videos(follower._capture), follower._offsets)
        with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
            k = truth["frames"].tolist().index(60)
            true = np.stack([truth["T_world_upper"][k], truth["T_world_upper"][k] @ truth["T_upper_lower"][k]])
        for frame, pictures in footage.walk(range(60, 66)):
            if frame == 60:
                follower._learn(pictures, follower._take.coordinates.pose_of(true))
            else:
                follower._take.step(follower._cutter.cut(pictures))
        return 66

    monkeypatch.setattr(_Follower, "_begin_in_files", begin)


def write_skin(jaw, folder):
    """Learn the example's skin from its last 200 frames, and return the options of its face at 60 fps."""
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        frames, T = truth["frames"], truth["T_upper_lower"]
    rng, points = np.random.default_rng(0), jaw.landmarks[0] + [[0, -30, 5], [12, -28, 0], [-12, -28, 0], [0, -5, 8]]
    rest = transform_points(jaw.T_rest, points)
    follow = np.array([[0.7], [0.5], [0.6], [0.3]])  # fraction of the bone's motion
    X = rest + follow * (transform_points(T, points) - rest) + rng.normal(0, 0.1, (len(T), 4, 3))
    later, d = frames >= frames[-1] - 200, jaw.encode(T).d
    names = ("chin", "left", "right", "lip")
    jawusd.save_skin(
        folder / "skin.npz", jawusd.fit_skin(jaw, X[later], d[later], np.ones(later.sum(), bool), names=names)
    )
    times = np.arange(frames[0] / FPS, frames[-1] / FPS, 1 / 60)
    columns = np.stack([np.interp(times, frames / FPS, x) for x in X.reshape(len(X), -1).T], axis=1)
    header = ",".join(["time_s", *(f"{name}_{axis}" for name in names for axis in "xyz")])
    np.savetxt(folder / "face.csv", np.column_stack([times, columns]), "%.6g", ",", header=header, comments="")
    return SkinOptions(folder / "skin.npz", folder / "face.csv")


@pytest.mark.slow
def test_skin_moves_the_jaw_while_the_mouth_is_covered(rig, patient_film, begun, covered, tmp_path):
    """Without skin, the last d would be held."""
    jaw = jawusd.load(rig)
    told = list(live(rig, EXAMPLE, seconds=39.5 / FPS, skin=write_skin(jaw, tmp_path)))
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        true = dict(zip(truth["frames"].tolist(), truth["T_upper_lower"], strict=True))
    number = np.array([round(found.time_s * FPS) for found in told])
    hidden = (number >= 76) & (number < 100)
    state = np.array([found.state for found in told])
    assert hidden.sum() == 24 and (state[hidden] == "skin").all() and (state[number < 76] == "solved").all()
    d, last = np.array([found.d for found in told]), told[int(np.flatnonzero(hidden)[0]) - 1].d
    wanted = np.array([transform_point(true[k], jaw.landmarks[0]) for k in number])
    by_skin, held = (
        np.linalg.norm(transform_points(jaw.pose(one), jaw.landmarks[:1])[:, 0] - wanted, axis=1)[hidden].mean()
        for one in (d, np.broadcast_to(last, d.shape))
    )
    assert by_skin < 0.6 and by_skin < 0.3 * held, (by_skin, held)
    assert np.mean([found.familiar for found in told]) > 0.9
    print(f"{by_skin:.2f} mm by skin, {held:.2f} mm with the last d held")


@pytest.mark.slow
def test_the_command_tells_lines_and_osc(rig, begun, tmp_path):
    text = (EXAMPLE / "capture.toml").read_text()
    (tmp_path / "capture.toml").write_text(re.sub(r'"(\w+/[^"]+\.\w+|calibration.toml)"', rf'"{EXAMPLE}/\1"', text))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        address = f"127.0.0.1:{receiver.getsockname()[1]}"
        said = run("live", rig, tmp_path, "--allow-outside", "--seconds", 1, "--osc", address)
        heard = OscPacket(receiver.recv(4096)).messages
    lines = [json.loads(line) for line in said.splitlines()]
    assert lines and {timed.message.address for timed in heard} >= {"/jaw/d", "/jaw/state"}
    first = next(timed.message.params for timed in heard if timed.message.address == "/jaw/d")
    np.testing.assert_allclose(first, lines[0]["d"], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("stride", "least"), [(2, 11), (6, 7)])
def test_teeth_are_found_again_after_frames_left_out(rig, stride, least):
    """Pictures are missing repeatedly for up to a quarter of a second; poses marked as found stay accurate."""
    capture = open_capture(EXAMPLE)
    jaw = jawusd.load(rig)
    cameras = {camera.name: camera for camera in load_cameras(capture)}
    meshes = registered_meshes(load_labelled(capture)[0], jaw.meta)
    teeth = PreparedTeeth(capture, meshes, jaw, map)
    take = LiveTake(jaw, teeth.scans, teeth.axes, tuple(cameras.values()))
    with np.load(EXAMPLE / "truth" / "truth.npz") as truth:
        offsets = dict(zip(truth["camera_names"].tolist(), truth["offsets"].tolist(), strict=True))
        upper = dict(zip(truth["frames"].tolist(), truth["T_world_upper"], strict=True))
        relative = dict(zip(truth["frames"].tolist(), truth["T_upper_lower"], strict=True))
    frames = range(capture.bootstrap.frame, capture.bootstrap.frame + 12 * stride, stride)
    start = take.coordinates.pose_of(np.stack([upper[frames[0]], upper[frames[0]] @ relative[frames[0]]]))
    cutter = Cutter(cameras, teeth.scans, upper[frames[0]][:3, 3])
    found, errors = 0, []
    for frame, pictures in ColourFootage(open_videos(capture), offsets).walk(frames):
        if frame == frames[0]:
            assert take.begin(cutter.cut(pictures), start) > 0.15
            continue
        fit = take.step(cutter.cut(pictures), float(stride))
        if fit.found.all():
            found += 1
            tip = jaw.landmarks[0]
            wanted = transform_point(relative[frame], tip)
            errors.append(np.linalg.norm(transform_point(jaw.pose(fit.pose.d), tip) - wanted))
            variance = np.diag(take.covariance_d(fit))
            assert (variance > 0).all() and variance.max() < 4.0
    assert found >= least and max(errors) < 1.0 and np.median(errors) < 0.25
