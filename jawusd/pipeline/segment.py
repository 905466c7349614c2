"""Make masks from footage: segmentation and tracking take turns, frame by frame, both ways from the picks."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jawusd.errors import CaptureError, TrackingError, explain_missing_packages
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture import Capture, Masks
from jawusd.formats.tracks import LOST
from jawusd.geometry.arrays import Array
from jawusd.pipeline.journal import Journal
from jawusd.pipeline.overlay import open_footage
from jawusd.pipeline.prepare import input_hashes, load_meshes
from jawusd.pipeline.state import Progress, hash_files, hash_value

LEARNED = "learned.json"
ROWS = ("upper", "lower")
# Frames gone back at most from where a jaw that had gone astray was found [-], about a second, and distance at which
# the way back has met the way there [mm].
_ASTRAY_FRAMES, _MET_MM = 24, 0.7


@dataclass(frozen=True)
class SegmentOptions:
    """Choose how to segment.

    Attributes:
        keys: folder with masks or strokes a person drew for some frames, or None.
        resume: keep the frames that were finished before.
        jobs: threads.
    """

    keys: Path | None = None
    resume: bool = False
    jobs: int = 2


@explain_missing_packages()
def segment_teeth(
    capture: Capture, offsets: dict[str, int], folder: Path, options: SegmentOptions, progress: Progress
) -> dict[str, Any]:
    """Write masks of both rows of teeth for every frame and camera of a capture.

    Args:
        capture: the capture; its videos, calibration, scans, picks and frame range are used, its masks are not.
        offsets: frame offset by camera.
        folder: where the masks go, as CAMERA/upper/000123.png numbered by the camera's own frames.
        options: how to segment.
        progress: told of every frame.

    Returns:
        Per-frame confidences and what is to be looked at, as written to segment.json.

    Raises:
        CaptureError: fewer than two cameras have a video, or one cannot be decoded.
        TrackingError: no picks, or the teeth are not found where they say.
        OutputError: a file cannot be written.
    """
    with ThreadPoolExecutor(options.jobs) as pool:
        return _Segmenting(capture, offsets, folder, options, progress, pool).run()


def with_masks(capture: Capture, folder: Path) -> Capture:
    """Return the capture with the masks that `segment_teeth` wrote to a folder."""
    from jawusd.segmentation.files import mask_pattern

    cameras = tuple(
        camera
        if camera.video is None
        else camera.model_copy(update={"masks": Masks(**{row: mask_pattern(folder, camera.name, row) for row in ROWS})})
        for camera in capture.cameras
    )
    return capture.model_copy(update={"cameras": cameras})


class _Segmenting:
    """One run over the frames of a capture."""

    def __init__(self, capture, offsets, folder, options, progress, pool) -> None:
        from jawusd.segmentation.config import SegmentationConfig
        from jawusd.segmentation.files import KeyMasks
        from jawusd.segmentation.footage import ColourFootage
        from jawusd.tracking.sequence.guided import GuidedTracker

        self._capture, self._folder, self._progress, self._pool = capture, folder, progress, pool
        cameras, videos = open_footage(capture)
        if len(videos) < 2:
            raise CaptureError(
                f"{len(videos)} of {len(capture.cameras)} cameras have a video; masks are made from two at least.",
                path=capture.folder / "capture.toml",
            )
        self._names = [name for name in cameras if name in videos]
        self._cameras = {name: cameras[name] for name in self._names}
        self._meshes = [load_meshes(capture)[name] for name in ("upper_teeth", "lower_teeth")]
        self._footage = ColourFootage(videos, offsets)
        self._keys = KeyMasks(options.keys, {n: self._cameras[n].size_px for n in self._names})
        self._config = SegmentationConfig()
        self._tracker = GuidedTracker(*self._meshes, self._see, self._agreement, len(self._config.reach_mm), None, pool)
        self._first, self._stop = capture.frames or self._footage.range()
        self._journal = Journal(folder, self._inputs(offsets, options), options.resume)
        self._pictures: dict = {}
        self._segments: dict = {}
        self._segmenters: dict = {}

    def _inputs(self, offsets, options) -> str:
        keys = sorted(options.keys.rglob("*.png")) if options.keys else []
        drawn = {str(path.relative_to(options.keys)): hash_files([path]) for path in keys}
        described = self._capture.model_dump(mode="json", include={"bootstrap", "frames", "calibration_unit_mm"})
        files = input_hashes(self._capture, ["videos", "teeth", "calibration"])
        return hash_value([files, drawn, described, offsets])

    def run(self) -> dict[str, Any]:
        from jawusd.segmentation.state import state_files

        bootstrap = self._capture.bootstrap
        poses = self._tracker.picked(bootstrap, self._cameras)
        start = bootstrap.frame
        if not self._first <= start < self._stop:
            raise TrackingError(f"bootstrap.frame is {start}, frames run from {self._first} to {self._stop - 1}")
        if start not in self._journal.entries:
            self._journal.drop(list(self._journal.entries))
            for path in (*state_files(self._folder), self._folder / LEARNED):
                path.unlink(missing_ok=True)
            self._new_segmenters(poses)
            self._pictures = self._footage.at(start)
            self._write(start, self._tracker.begin(start, poses))
        self._tell("segment", len(self._journal.entries))
        for step, end in ((1, self._stop), (-1, self._first - 1)):
            self._go(start, end, step)
        if keyed := self._keyed():
            self._learn_and_repeat(keyed)
        return self._journal.entries

    def _tell(self, stage_name: str, done: int) -> None:
        self._progress(stage_name, done, self._stop - self._first)

    def _new_segmenters(self, poses: Array) -> None:
        from jawusd.segmentation.camera import CameraSegmenter

        self._segmenters = {
            name: CameraSegmenter(camera, self._meshes, poses, self._config) for name, camera in self._cameras.items()
        }

    def _go(self, start: int, end: int, step: int) -> None:
        """Go from the frame of the picks to one end of the take, past what was finished before."""
        from jawusd.segmentation.state import ColourStates

        done = start
        while done + step != end and done + step in self._journal.entries:
            done += step
        if done + step == end:
            return
        poses = self._journal.known(start)[0]
        self._new_segmenters(poses)
        colours = {name: segmenter.colours for name, segmenter in self._segmenters.items()}
        state = ColourStates(self._folder, colours)
        before = state.take_up(done, step)
        self._journal.drop(range(before + step if before is not None else start + step, done + step, step))
        if before is None:  # colours come from the poses found in the first frame
            before, self._pictures = start, self._footage.at(start)
            self._see(start, poses, 0)
        frames, follow = range(before + step, end, step), None
        walk = self._footage.walk(frames)
        for frame in frames:
            if follow is None:
                past = [self._past(done) for done in range(start, frame, step)]
                follow = self._tracker.follow(range(frame, end, step), past)
            _, self._pictures = next(walk)
            known = {name: model.counts() for name, model in colours.items()}
            _, record, found_again = next(follow)
            if (record.status == LOST).any():  # colours from where no teeth are would spoil all that follows
                for name, model in colours.items():
                    model.take_up(*known[name])
            state.keep(frame, step)
            if found_again:
                self._look_back(start, frame, step, record)
                follow = None  # what it knows has changed
            self._write(frame, record)
            self._tell("segment", len(self._journal.entries))

    def _look_back(self, start: int, found: int, step: int, record) -> None:
        """Go back from a frame in which a jaw was found again, until that meets the way there, and do it anew."""
        from jawusd.tracking.contour.frame_record import FrameSummary

        pictures, segments = self._pictures, self._segments
        colours = [(segmenter.colours, segmenter.colours.counts()) for segmenter in self._segmenters.values()]
        here = FrameSummary.of(record)
        # Twice, for a jaw at rest: nothing is known of how it moves.
        past = [*(self._past(frame) for frame in range(start, found, step)), here, here]
        frames = range(found - step, start, -step)[:_ASTRAY_FRAMES]
        walk, follow = self._footage.walk(frames), self._tracker.follow(frames, past)
        anew, met = [], len(frames) < _ASTRAY_FRAMES  # the frame of the picks is known
        for frame in frames:
            _, self._pictures = next(walk)
            _, again, _ = next(follow)
            if self._tracker.apart_mm(self._journal.known(frame)[0], again.solution.poses) < _MET_MM:
                met = True
                break
            anew.append((frame, again, self._segments))
        for frame, again, self._segments in anew if met else ():
            self._write(frame, again)
        self._pictures, self._segments = pictures, segments
        for model, counts in colours:
            model.take_up(*counts)

    def _past(self, frame: int):
        """Return what the tracker needs to know about a finished frame."""
        from jawusd.tracking.contour.frame_record import FrameSummary

        poses, status = self._journal.known(frame)
        kept = self._journal.entries[frame]["track"]
        coverage, score, residual = (np.array(kept[key], np.float64) for key in ("coverage", "score_px", "residual_px"))
        used = np.array(kept["used"], bool)
        return FrameSummary(poses, status, used, coverage, score, residual)

    def _keyed(self) -> list[int]:
        """Return the frames for which a person drew and whose poses are known."""
        drawn = {name: set(self._keys.frames(name)) for name in self._names}
        return [
            frame
            for frame in range(self._first, self._stop)
            if any(self._footage.own(name, frame) in drawn[name] for name in self._names)
            and LOST not in self._journal.entries[frame]["status"]
        ]

    def _learn_and_repeat(self, keyed: list[int]) -> None:
        """Learn colours and numbers from what a person drew, and segment all frames again where the teeth are."""
        from jawusd.segmentation.learn import learn_numbers

        self._new_segmenters(self._journal.known(self._capture.bootstrap.frame)[0])
        examples = []
        for frame in keyed:
            pictures, poses = self._footage.at(frame), self._journal.known(frame)[0]
            for name in self._names:
                own = self._footage.own(name, frame)
                keys = self._keys.of(name, own) if own is not None else [None, None]
                if pictures[name] is not None and any(keys):
                    examples.append(self._segmenters[name].study(pictures[name], poses, keys))
        finished = [example for example in examples if example is not None]
        if not finished:
            return
        config, learned = learn_numbers(finished, self._config)
        write_text_atomic(self._folder / LEARNED, json.dumps(learned) + "\n")
        for segmenter in self._segmenters.values():
            segmenter.adopt(config)
        again = [frame for frame in range(self._first, self._stop) if "again" not in self._journal.entries[frame]]
        for frame, pictures in self._footage.walk(range(again[0], self._stop)) if again else ():
            self._pictures = pictures
            self._write(frame, self._tracker.judge(frame, *self._journal.known(frame)), again=True)
            self._tell("segment again", frame + 1 - self._first)

    def _see(self, frame: int, poses: Array, turn: int) -> list:
        """Segment all cameras' pictures of a frame and return them as the tracker's views."""
        from jawusd.tracking.contour.views import View

        def one(name: str):
            image, own = self._pictures[name], self._footage.own(name, frame)
            if image is None:
                return None
            return self._segmenters[name].segment(image, poses, turn, self._keys.of(name, own))

        self._segments = dict(zip(self._names, self._pool.map(one, self._names), strict=True))
        views = []
        for name, found in self._segments.items():
            camera = self._cameras[name] if found is None else found.camera
            masks = np.zeros((2, 1, 1), np.uint8) if found is None else found.masks
            present = np.zeros(2, bool) if found is None else found.present
            views.append(View(camera.projection_matrix(), camera.centre_world(), masks, present))
        return views

    def _agreement(self, frame: int, guesses: Array) -> Array:
        """Return how well the colours of all cameras' pictures of a frame agree with guessed poses, shape (N,)."""
        seen = [name for name in self._names if self._pictures[name] is not None]
        each = self._pool.map(lambda name: self._segmenters[name].agreement(self._pictures[name], guesses), seen)
        return np.sum(list(each), axis=0) if seen else np.zeros(len(guesses))

    def _write(self, frame: int, record, again: bool = False) -> None:
        """Write the masks of a frame and what is known about it."""
        from jawusd.tracking.contour.frame_record import FrameSummary
        from jawusd.tracking.contour.quality import view_residual_px

        residual = view_residual_px(record.solution)
        cameras = {}
        for k, name in enumerate(self._names):
            found = self._segments[name]
            if found is not None:
                cameras[name] = {
                    "frame": self._footage.own(name, frame),
                    "contrast": found.contrast.tolist(),
                    "pixels": [int((m > 127).sum()) for m in found.masks],
                    "outline": found.outline.tolist(),
                    "unexpected": found.unexpected.tolist(),
                    "residual_px": residual[:, k].tolist(),
                    "uncovered": record.coverage[:, k].tolist(),
                }
        list(self._pool.map(lambda name: self._write_masks(name, cameras[name]["frame"]), cameras))
        past = vars(FrameSummary.of(record))
        track = {key: past[key].tolist() for key in ("used", "coverage", "score_px", "residual_px")}
        entry = {"poses": past["poses"].tolist(), "status": past["status"].tolist(), "cameras": cameras, "track": track}
        self._journal.add(frame, entry | ({"again": True} if again else {}))

    def _write_masks(self, name: str, own: int) -> None:
        from jawusd.segmentation.files import mask_path, write_mask

        masks = self._segmenters[name].recorded(self._segments[name])
        for row, made, key in zip(ROWS, masks, self._keys.of(name, own), strict=True):
            mask = np.where(key.mask > 127, np.uint8(255), np.uint8(0)) if key is not None and key.finished else made
            write_mask(mask_path(self._folder, name, row, own), mask)
