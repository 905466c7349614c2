"""Make masks from footage: follow the teeth by their colours, and segment the images around them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import explain_missing_packages
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.capture import Capture
from jawusd.formats.tracks import LOST
from jawusd.pipeline.cameras import open_colour_footage
from jawusd.pipeline.picture_search import PictureSearch, picks_outside
from jawusd.pipeline.segment_guide import known_guide, save_guide
from jawusd.pipeline.segment_record import LEARNED, CameraEntry, FrameEntry, Journal, TrackEntry
from jawusd.pipeline.state import Progress, hash_files, hash_value
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.pipeline.videos import Follower
from jawusd.pipeline.workspace import input_hashes
from jawusd.segmentation.camera import CameraSegmenter, Segment, learn_numbers
from jawusd.segmentation.colours import ColourStates, SegmentationConfig, state_files
from jawusd.segmentation.files import ARCHES, KeyMasks, mask_path, write_mask
from jawusd.segmentation.picture import Pictures
from jawusd.tracking.contour.frame_record import FrameRecord, FrameSummary
from jawusd.tracking.contour.quality import view_residual_px
from jawusd.tracking.contour.views import View
from jawusd.tracking.region.picture_start import ArchStart
from jawusd.tracking.sequence.guided import GuidedTracker


@dataclass(frozen=True)
class SegmentOptions:
    """Options for making masks from footage."""

    keys: Path | None = None  # folder with masks or strokes drawn by hand for some frames
    resume: bool = False  # whether to keep the frames finished by an earlier run
    jobs: int = 2  # number of threads


@explain_missing_packages()
def segment_teeth(
    capture: Capture, offsets: dict[str, int], folder: Path, options: SegmentOptions, progress: Progress
) -> dict[int, FrameEntry]:
    """Write masks of both arches for every frame and camera of a capture, whose own masks are ignored.

    The files are CAMERA/upper/000123.png, numbered by the camera's own frames. Returns the record of all frames.

    Raises:
        CaptureError, TrackingError: fewer than two cameras have a video, or the teeth are not found.
        OutputError: a file cannot be written.
    """
    with ThreadPoolExecutor(options.jobs) as pool:
        return _Segmentation(capture, offsets, folder, options, progress, pool).run()


class _Segmentation:
    """One run of the segmentation over the frames of a capture."""

    def __init__(
        self,
        capture: Capture,
        offsets: dict[str, int],
        folder: Path,
        options: SegmentOptions,
        progress: Progress,
        pool: Executor,
    ) -> None:
        self._capture, self._folder, self._progress, self._pool = capture, folder, progress, pool
        self._cameras, self._footage = open_colour_footage(capture, offsets, "segmentation")
        meshes = load_meshes(capture)
        self._meshes = meshes["upper_teeth"], meshes["lower_teeth"]
        self._offsets = offsets
        self._keys = KeyMasks(options.keys, {name: camera.size_px for name, camera in self._cameras.items()})
        self._config = SegmentationConfig()
        self._subject = subject_of_capture(capture, meshes)
        self._tracker = GuidedTracker(*self._meshes, self._see, len(self._config.reach_mm), executor=pool)
        self._first, self._stop = capture.frames or self._footage.range()
        self._inputs = self._hashed_inputs(options.keys)
        self._journal = Journal(folder, self._inputs, options.resume)
        self._guide = known_guide(folder, self._inputs) if options.resume else {}
        self._pictures: Pictures = {}  # images of the frame that is being tracked
        self._segments: dict[str, Segment | None] = {}  # its latest masks by camera, None if there is no image
        self._segmenters: dict[str, CameraSegmenter] = {}

    def _hashed_inputs(self, keys: Path | None) -> str:
        drawn = {}
        if keys is not None:
            drawn = {str(path.relative_to(keys)): hash_files([path]) for path in sorted(keys.rglob("*.png"))}
        described = self._capture.model_dump(mode="json", include={"bootstrap", "frames", "calibration_unit_mm"})
        files = input_hashes(self._capture, ["videos", "teeth", "calibration"])
        return hash_value([files, drawn, described, self._offsets])

    def run(self) -> dict[int, FrameEntry]:
        """Segment all unfinished frames, and repeat all of them after learning from drawn masks."""
        start, poses = self._find_start()
        if not self._guide:  # follow the teeth through all frames by their colours
            follower, search = self._follower()
            follower.start_at(start, poses)
            self._guide = follower.run(range(self._first, self._stop), search, self._progress)
            save_guide(self._folder, self._inputs, self._guide)
        if start not in self._journal.entries:
            self._journal.drop(list(self._journal.entries))
            for path in (*state_files(self._folder), self._folder / LEARNED):
                path.unlink(missing_ok=True)
            self._new_segmenters(poses)
            self._pictures = self._footage.at(start)
            self._write(start, self._tracker.begin(start, self._guide[start].poses))
        self._progress("segment", len(self._journal.entries), self._stop - self._first)
        for step, end in ((1, self._stop), (-1, self._first - 1)):
            self._track_to(start, end, step)
        if keyed := self._keyed():
            self._learn_and_repeat(start, keyed)
        return self._journal.entries

    def _find_start(self) -> tuple[int, Array]:
        """Return the start frame and its poses, shape (2, 4, 4), from picks or, without picks, from a search."""
        picks = self._capture.bootstrap
        frames = range(self._first, self._stop)
        if picks is not None:
            if picks.frame not in frames:
                raise picks_outside(picks.frame, frames)
            return picks.frame, self._tracker.picked(picks, self._cameras)
        if self._journal.entries and self._guide:
            start = next(iter(self._journal.entries))  # the first recorded frame is the start
            return start, self._guide[start].poses
        begin = self._follower()[1].run(frames, self._progress)
        return begin.frame, begin.pose

    def _follower(self) -> tuple[Follower, PictureSearch[Array]]:
        """Return a tracker by colours, and a search for the teeth that uses it to refine poses."""
        follower = Follower(self._footage, self._cameras, self._tracker.scans, self._subject, self._pool)
        upper, lower = self._tracker.scans
        rows = ArchStart(self._meshes, (upper, lower), self._capture.anatomy.T_anatomical_skull, self._pool.map)
        return follower, PictureSearch(self._footage, self._cameras, self._offsets, rows, follower.start_at)

    def _new_segmenters(self, poses: Array) -> None:
        self._segmenters = {
            name: CameraSegmenter(camera, self._meshes, poses, self._config) for name, camera in self._cameras.items()
        }

    def _track_to(self, start: int, end: int, step: int) -> None:
        """Track from the start frame to one end of the take, skipping finished frames."""
        done = start
        while done + step != end and done + step in self._journal.entries:
            done += step
        if done + step == end:
            return
        poses = self._journal.known(start)[0]
        self._new_segmenters(poses)
        colours = {name: segmenter.colours for name, segmenter in self._segmenters.items()}
        state = ColourStates(self._folder, colours)
        before = state.restore(done, step)
        self._journal.drop(range(before + step if before is not None else start + step, done + step, step))
        if before is None:  # learn colours from the poses of the start frame
            before = start
            self._pictures = self._footage.at(start)
            self._see(start, poses, 0)
        frames = range(before + step, end, step)
        past = [self._past(frame) for frame in range(start, before + step, step)]
        guide = {frame: found.poses for frame, found in self._guide.items()}
        follow = self._tracker.follow(frames, guide, past)
        for frame, pictures in self._footage.walk(frames):
            known = {name: model.counts() for name, model in colours.items()}
            self._pictures = pictures
            _, record = next(follow)
            if (record.status == LOST).any():  # discard colours learned from a wrong image region
                for name, model in colours.items():
                    model.restore(*known[name])
            state.save(frame, step)
            self._write(frame, record)
            self._progress("segment", len(self._journal.entries), self._stop - self._first)

    def _past(self, frame: int) -> FrameSummary:
        """Return the tracker's summary of a finished frame."""
        poses, status = self._journal.known(frame)
        track = dict(self._journal.entries[frame]["track"])
        used = np.array(track.pop("used"), bool)
        return FrameSummary(poses, status, used, **{name: np.array(kept, np.float64) for name, kept in track.items()})

    def _keyed(self) -> list[int]:
        """Return the frames that have drawn masks or strokes, and known poses."""
        drawn = {name: set(self._keys.frames(name)) for name in self._cameras}
        return [
            frame
            for frame in range(self._first, self._stop)
            if any(self._footage.number(name, frame) in drawn[name] for name in self._cameras)
            and LOST not in self._journal.entries[frame]["status"]
        ]

    def _learn_and_repeat(self, start: int, keyed: Sequence[int]) -> None:
        """Learn colours and parameters from drawn masks, then segment all frames again at the known poses."""
        self._new_segmenters(self._journal.known(start)[0])
        examples = []
        for frame in keyed:
            pictures, poses = self._footage.at(frame), self._journal.known(frame)[0]
            for name, segmenter in self._segmenters.items():
                image, own = pictures[name], self._footage.number(name, frame)
                if image is not None and own is not None and any(keys := self._keys.of(name, own)):
                    examples.append(segmenter.study(image, poses, keys))
        finished = [example for example in examples if example is not None]
        if not finished:
            return
        config, learned = learn_numbers(finished, self._config)
        write_text_atomic(self._folder / LEARNED, json.dumps(learned) + "\n")
        for segmenter in self._segmenters.values():
            segmenter.configure(config)
        again = [frame for frame in range(self._first, self._stop) if "again" not in self._journal.entries[frame]]
        for frame, pictures in self._footage.walk(range(again[0], self._stop)) if again else ():
            self._pictures = pictures
            self._write(frame, self._tracker.judge(frame, *self._journal.known(frame)), again=True)
            self._progress("segment again", frame + 1 - self._first, self._stop - self._first)

    def _see(self, frame: int, poses: Array, turn: int) -> list[View]:
        """Segment the images of a frame, and return the masks as views for the tracker."""

        def one(name: str) -> Segment | None:
            image, own = self._pictures[name], self._footage.number(name, frame)
            if image is None or own is None:
                return None
            found = self._segmenters[name].segment(image, poses, turn, self._keys.of(name, own))
            # Skip arches that were not found by colour: a mask segmented around a wrong pose would confirm it.
            return None if found is None else found.only(self._guide[frame].found)

        self._segments = dict(zip(self._cameras, self._pool.map(one, self._cameras), strict=True))
        views = []
        for name, found in self._segments.items():
            camera = self._cameras[name] if found is None else found.camera
            masks = np.zeros((2, 1, 1), np.uint8) if found is None else found.masks
            present = np.zeros(2, bool) if found is None else found.present
            views.append(View(camera.projection_matrix(), camera.centre_world(), masks, present))
        return views

    def _write(self, frame: int, record: FrameRecord, again: bool = False) -> None:
        """Write the masks and the record of a frame."""
        residual = view_residual_px(record.solution)
        cameras: dict[str, CameraEntry] = {}
        for k, (name, found) in enumerate(self._segments.items()):
            own = self._footage.number(name, frame)
            if found is not None and own is not None:
                cameras[name] = {
                    "frame": own,
                    "contrast": found.contrast.tolist(),
                    "pixels": [int((m > 127).sum()) for m in found.masks],
                    "outline": found.outline.tolist(),
                    "unexpected": found.unexpected.tolist(),
                    "residual_px": residual[:, k].tolist(),
                    "uncovered": record.coverage[:, k].tolist(),
                }
        written = [(name, found, cameras[name]["frame"]) for name, found in self._segments.items() if found is not None]
        list(self._pool.map(lambda item: self._write_masks(*item), written))
        past = FrameSummary.of(record)
        entry: FrameEntry = {
            "poses": past.poses.tolist(),
            "status": past.status.tolist(),
            "cameras": cameras,
            "track": cast(TrackEntry, {name: getattr(past, name).tolist() for name in TrackEntry.__annotations__}),
        }
        if again:
            entry["again"] = True
        self._journal.add(frame, entry)

    def _write_masks(self, name: str, found: Segment, own: int) -> None:
        masks = self._segmenters[name].recorded(found)
        for arch, made, key in zip(ARCHES, masks, self._keys.of(name, own), strict=True):
            mask = np.where(key.mask > 127, np.uint8(255), np.uint8(0)) if key is not None and key.finished else made
            write_mask(mask_path(self._folder, name, arch, own), mask)
