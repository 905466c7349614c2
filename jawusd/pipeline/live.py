"""Track the jaw of a subject with a rig in live video, and send the parameters over OSC: `jawusd live`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np

import jawusd
from jawusd.base.errors import AnyPath, CaptureError, OutputError, explain_missing_packages, naming_file
from jawusd.evaluator import JawRig
from jawusd.formats.capture import Capture
from jawusd.formats.performance import SolveState
from jawusd.media import live_source
from jawusd.media.live_source import LiveSource
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.cameras import load_cameras
from jawusd.pipeline.live_jaw import LiveFrame, LiveJaw, LiveSkin
from jawusd.pipeline.picture_search import arches_apart, least_fit, orientations, rough_masks
from jawusd.pipeline.skin import SkinOptions
from jawusd.pipeline.state import no_progress
from jawusd.pipeline.subject import load_meshes
from jawusd.pipeline.videos import Cutter, PreparedTeeth, VideoOptions, VideoShot
from jawusd.pipeline.workspace import open_capture
from jawusd.segmentation.picture import Pictures
from jawusd.tracking.contour.scan import teeth_centre
from jawusd.tracking.performance.coordinates import Pose
from jawusd.tracking.region.performance import LiveTake

_PATIENCE_S = 2.0  # time without visible teeth [s] after which a new search begins
_WAIT_S = 0.25
_MOST_BEHIND_S = 0.15  # lag behind the newest images [s] above which frames are dropped
_UNKNOWN_MM = 10.0  # standard deviation of d in frames in which only the skin is known [mm]
_BEFORE = 6  # number of frames tracked before playback of files begins, to estimate the motion


@explain_missing_packages()
def live(
    rig: AnyPath,
    shot: Capture | AnyPath,
    sources: Mapping[str, str] | None = None,
    *,
    prim: str | None = None,
    fixed_head: bool = False,
    jobs: int = 2,
    seconds: float | None = None,
    silence_s: float = 10.0,
    allow_outside: bool = False,
    skin: SkinOptions | None = None,
) -> Iterator[LiveFrame]:
    """Yield one result per frame; frames are dropped if images arrive faster than they are tracked.

    Args:
        rig: `actor.usda`, another layer of it, or `model.npz`.
        shot: a capture with the calibrated cameras and the rig's scans; if no sources are given, its videos are played
            in real time.
        sources: device, stream address or file of each camera, by camera name.
        prim: path of the rig's prim, if a stage has several.
        fixed_head: the cameras are head-mounted.
        seconds: duration after which tracking stops [s]; None: when the sources end.
        silence_s: maximum time without an image from a device or stream [s].
        skin: facial skin, which determines d in frames with hidden teeth; see `LiveSkin`.

    Raises:
        FormatError, RigError: the rig or a skin file cannot be read.
        FittingError: the skin contradicts the visible teeth.
        CaptureError, CalibrationError, SyncError: the shot or a source cannot be read.
        TrackingError: the scans are not in occlusion.
    """
    capture = open_capture(shot, allow_outside=allow_outside)
    jaw = jawusd.load(rig, prim=prim)
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(jobs))
        follower = _Follower(capture, jaw, sources or {}, fixed_head, pool, skin)
        stack.callback(follower.stop)
        yield from follower.run(seconds, silence_s)


class OscSender:
    """Sends one OSC bundle per frame over UDP.

    Arguments: /jaw/d and /jaw/sigma have three floats [mm], /jaw/margin one [mm], /jaw/time one [s]. /jaw/state has the
    integer 1 for solved, 2 for carried or 3 for skin, as in `SolveState`. /jaw/familiar, sent only if `familiar` is
    known, has 1 or 0.
    """

    @explain_missing_packages()
    def __init__(self, address: str) -> None:
        """Open a socket for HOST:PORT.

        Raises:
            OutputError: the address has no port, or the host is unknown.
            MissingDependencyError: python-osc is not installed.
        """
        from pythonosc.udp_client import UDPClient

        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise OutputError(f"{address!r} is not an address.", hint="Give HOST:PORT, for example 127.0.0.1:9000.")
        try:
            self._client = UDPClient(host.strip("[]"), int(port))
        except OSError as error:
            raise OutputError(f"unknown host {host!r} ({error}).") from error

    def close(self) -> None:
        """Close the socket."""
        self._client.close()

    @explain_missing_packages()
    def send(self, frame: LiveFrame) -> None:
        """Send one result; it is not an error if nothing receives it."""
        from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
        from pythonosc.osc_message_builder import build_msg

        bundle = OscBundleBuilder(IMMEDIATELY)
        values: dict[str, list[float] | list[int]] = {
            "d": frame.d.tolist(),
            "sigma": frame.sigma.tolist(),
            "margin": [frame.margin_mm],
            "state": [int(SolveState[frame.state.upper()])],
            "time": [frame.time_s],
        }
        if frame.familiar is not None:
            values["familiar"] = [int(frame.familiar)]
        for name, numbers in values.items():
            bundle.add_content(build_msg(f"/jaw/{name}", numbers))
        try:
            self._client.send(bundle.build())
        except OSError:  # the receiver has closed its port and may open it again
            return


def next_instant(times_s: Sequence[Sequence[float]], after_s: float) -> float | None:
    """Return the time of the next frame to process; None if a source has no image of that frame yet.

    The oldest frame after `after_s` and within `_MOST_BEHIND_S` of the newest one is chosen, since tracking catches up
    after a search. The times of the buffered images of each source increase.
    """
    if not all(len(kept) for kept in times_s):
        return None
    slowest = min(times_s, key=lambda kept: kept[-1])
    since = max(after_s, slowest[-1] - _MOST_BEHIND_S)
    return next((time_s for time_s in slowest if time_s > since), None)


def _with_sources(capture: Capture, sources: Mapping[str, str]) -> tuple[Capture, dict[str, str]]:
    """Return the capture restricted to cameras with a source, and the sources; source files replace its videos."""
    names = [camera.name for camera in capture.cameras]
    if unknown := sorted(set(sources) - set(names)):
        message = f"sources are given for unknown cameras {', '.join(unknown)}; the capture has {', '.join(names)}."
        raise CaptureError(message, path=capture.file)
    videos = {camera.name: str(camera.video) for camera in capture.cameras if camera.video is not None}
    where = dict(sources) or videos
    if not where:
        hint = "Give devices or streams with --source CAMERA=/dev/video0."
        raise CaptureError("no camera has a video, and no source is given.", path=capture.file, hint=hint)
    files = {name: Path(one) for name, one in where.items() if Path(one).is_file()}
    cameras = tuple(
        camera.model_copy(update={"video": files.get(camera.name, camera.video)})
        for camera in capture.cameras
        if camera.name in where
    )
    return capture.model_copy(update={"cameras": cameras, "bootstrap": None}), where


class _Follower:
    """Tracker of the teeth in live sources."""

    def __init__(
        self,
        capture: Capture,
        jaw: JawRig,
        sources: Mapping[str, str],
        fixed_head: bool,
        pool: Executor,
        skin: SkinOptions | None,
    ) -> None:
        self._capture, where = _with_sources(capture, sources)
        self._jaw, self._period_s = jaw, 1.0 / capture.fps
        self._files = all(Path(one).is_file() for one in where.values())
        self._skin = None if skin is None else LiveSkin(jaw, skin, recorded=self._files)
        self._offsets = dict.fromkeys(where, 0)
        if self._files:
            self._offsets = sync_cameras(self._capture, no_progress)["offsets"]
        with naming_file(capture.file):
            self._cameras = {camera.name: camera for camera in load_cameras(capture) if camera.name in where}
            meshes = load_meshes(capture, jaw.meta)
        self._pool = pool
        self._teeth = PreparedTeeth(self._capture, meshes, jaw, pool.map)
        cameras = tuple(self._cameras.values())
        scans, axes = self._teeth.scans, self._teeth.axes
        self._take = LiveTake(jaw, scans, axes, cameras, fixed_head=fixed_head, executor=pool)
        self._sources: dict[str, LiveSource] = {
            name: LiveSource(where[name], camera.size_px, -self._offsets[name] * self._period_s)
            for name, camera in self._cameras.items()
        }
        self._cutter: Cutter | None = None
        self._last_d = np.zeros(3)

    def stop(self) -> None:
        """Stop reading the sources."""
        for source in self._sources.values():
            source.stop()
        if self._skin is not None:
            self._skin.face.stop()

    def run(self, seconds: float | None, silence_s: float) -> Iterator[LiveFrame]:
        """Yield one result per frame until the sources end."""
        start = self._begin_in_files() if self._files else 0
        for source in self._sources.values():
            source.open(start * self._period_s)
        for source in self._sources.values():
            source.wait_open(silence_s)
        begin = live_source.now_s() - start * self._period_s
        for source in self._sources.values():
            source.play(begin)
        if self._skin is not None:
            self._skin.face.play(begin, silence_s)
        last, blind_since = begin + (start - 0.5) * self._period_s, 0.0
        while (at := self._next(last, silence_s)) is not None:
            if seconds is not None and at - begin > start * self._period_s + seconds:
                return
            pictures, passed_s, last = self._pictures(at), at - last, at
            if self._cutter is None or 0 < blind_since < at - _PATIENCE_S:
                self._begin_in_pictures(pictures)
                blind_since = 0.0
                jaw = self._without_teeth(at, passed_s)
            else:
                jaw = self._tracked(self._cutter, pictures, at, passed_s)
                blind_since = 0.0 if jaw.state == SolveState.SOLVED else blind_since or at
            if jaw is not None:
                yield self._result(jaw, at, begin, round(max(1.0, passed_s / self._period_s)) - 1)

    def _tracked(self, cutter: Cutter, pictures: Pictures, at: float, passed_s: float) -> LiveJaw:
        """Return the jaw in images taken `passed_s` [s] after the previous ones."""
        fit = self._take.step(cutter.cut(pictures), max(1.0, passed_s / self._period_s))
        state = SolveState.SOLVED if fit.found.all() else SolveState.CARRIED
        jaw = LiveJaw(fit.pose.d, self._take.covariance_d(fit), state)
        if self._skin is not None:
            jaw = self._skin.fuse(at, jaw, passed_s)
            if jaw.state == SolveState.SKIN:
                self._take.carry(jaw.d, jaw.covariance)
        self._last_d = jaw.d
        return jaw

    def _without_teeth(self, at: float, passed_s: float) -> LiveJaw | None:
        """Return the jaw by skin alone, in a frame in which the teeth are searched for; None if unknown."""
        if self._skin is None:
            return None
        unknown = LiveJaw(self._last_d, _UNKNOWN_MM**2 * np.eye(3), SolveState.CARRIED)
        jaw = self._skin.fuse(at, unknown, passed_s)
        return jaw if jaw.state == SolveState.SKIN else None

    def _result(self, jaw: LiveJaw, at: float, begin: float, dropped: int) -> LiveFrame:
        verdict = self._jaw.validate_parameters(jaw.d[None], tolerance_mm=None)
        return LiveFrame(
            time_s=at - begin,
            d=jaw.d,
            sigma=np.sqrt(np.diag(jaw.covariance)),
            margin_mm=float(verdict.margin_mm[0]),
            verdict=verdict.words()[0],
            state=str(jaw.state),
            latency_ms=1e3 * (live_source.now_s() - at),
            dropped=dropped,
            familiar=jaw.familiar,
        )

    def _begin_in_files(self) -> int:
        """Search for the teeth before the files are played; return the frame at which playback starts."""
        cameras, options = self._cameras, VideoOptions()
        shot = VideoShot(self._capture, cameras, self._offsets, self._teeth, self._jaw, options, no_progress)
        begin = shot.begin()
        after = range(begin.frame, min(begin.frame + _BEFORE, shot.footage.range()[1]))
        for frame, pictures in shot.footage.walk(after):
            if frame == begin.frame:
                self._learn(pictures, begin.pose)
            elif self._cutter is not None:
                self._take.step(self._cutter.cut(pictures))
        return after.stop

    def _learn(self, pictures: Pictures, near: Pose) -> None:
        """Learn the colours of the teeth from images, given an approximate pose; start tracking if the teeth fit."""
        centre = teeth_centre(self._teeth.scans, self._take.coordinates.arches(near))
        cutter = Cutter(self._cameras, self._teeth.scans, centre, self._pool)
        if self._take.begin(cutter.cut(pictures), near) >= least_fit(len(self._cameras)):
            self._cutter = cutter

    def _begin_in_pictures(self, pictures: Pictures) -> None:
        """Search for the teeth in images in which the arches are visibly apart."""
        none = dict.fromkeys(self._cameras, 0)
        for turns in orientations(self._cameras):
            apart = arches_apart(pictures, turns)
            if len(apart) < min(2, len(self._cameras)):
                continue
            near = self._teeth.search.at(rough_masks(apart, none, 0), self._cameras, none, 0)
            if near is not None:
                self._learn(pictures, near)
            if self._cutter is not None:
                return

    def _next(self, last: float, silence_s: float) -> float | None:
        """Wait for the next frame of which all sources have an image; return its time, None once a source has ended."""
        after = last + 0.5 * self._period_s
        while True:
            at = next_instant([source.times_s() for source in self._sources.values()], after)
            if at is not None or any(source.ended for source in self._sources.values()):
                return at
            for source in self._sources.values():
                source.wait(after, _WAIT_S)
                source.refuse_silence(silence_s)

    def _pictures(self, at: float) -> Pictures:
        """Return the image of each source at a time; None for sources without an image near that time."""
        found = {name: source.at(at) for name, source in self._sources.items()}
        return {n: p.rgb if p is not None and abs(p.time_s - at) <= self._period_s else None for n, p in found.items()}
