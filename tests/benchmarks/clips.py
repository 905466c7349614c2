"""Track the same frames of a capture from its footage, stored in different ways; print how far the tracks are apart.

    python tests/benchmarks/clips.py CAPTURE [--first FRAME] [--frames 8] [--kinds png8 exr ...]

CAPTURE has videos and picks; the frames begin with that of the picks, unless another is given. Each kind is made from
the decoded pictures of its videos: numbered pictures with a gap, aligned by their time codes, ProRes 422 HQ of 10 bits,
a phone's clip (H.264, variable rate, stored turned by 90 degrees). Masks are made from the footage, so that every pixel
counts. "away" is the largest distance of lower teeth vertices, against the upper ones, from where the videos as they
are put them. What of it is the codec's, and not the way the clip is read, is told by `prores_pixels` and
`phone_pixels`, the decoded pictures of those clips stored without loss, and by `noise`, the pictures with normal noise
of one level of 255.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from clip_files import KINDS, write_prores, write_sequence

from jawusd.formats.capture import Capture, load_capture
from jawusd.geometry import relative_pose, transform_points
from jawusd.media.video import Video
from jawusd.pipeline.calibrate import sync_cameras
from jawusd.pipeline.segment import SegmentOptions, segment_teeth
from jawusd.pipeline.subject import load_meshes

_AFTER = 2  # pictures after the last frame, so that clips end behind it
_GAP = 2  # place of the picture that is missing in sequences


def quiet(stage: str, done: int, total: int) -> None:
    """Print nothing."""


def write_phone(path: Path, images: np.ndarray, fps: float) -> Path:
    """Write H.264 with jittered times, stored turned, to be turned back by 90 degrees."""
    rng = np.random.default_rng(0)
    base = Fraction(1, 90000)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001), options={"crf": "10"})
        turned = np.rot90(images, 1, axes=(1, 2))
        stream.height, stream.width = turned.shape[1:3]
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", base
        stream.time_base = base
        stream.set_display_rotation(-90)
        for k, image in enumerate(turned):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = round(90000 * (k + (rng.uniform(-0.2, 0.2) if k else 0)) / fps), base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def written(kind: str, place: Path, images: np.ndarray, fps: float) -> Path:
    """Write a ProRes or a phone's clip."""
    place.mkdir(parents=True, exist_ok=True)
    if kind == "prores":
        return write_prores(place / "clip.mov", images, Fraction(fps).limit_denominator(1001))
    return write_phone(place / "clip.mp4", images, fps)


def sequence(place: Path, images: np.ndarray, kind: str, start: int) -> Path:
    """Write numbered pictures, but for one before the frames that are tracked."""
    return write_sequence(place, images, kind, first=1000 + start, left_out=(1000 + start + _GAP,))


def timecode(frame: int, fps: float) -> str:
    """Return the time code of a frame of the reference camera."""
    rate = round(fps)
    seconds, rest = divmod(36000 * rate + frame, rate)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}:{rest:02d}"


def restored(capture: Capture, offsets: dict[str, int], kind: str, folder: Path, first: int, count: int) -> tuple:
    """Return the capture with clips of another kind, and their offsets; frames count from the first."""
    cameras, shifted = [], {}
    lead = min(offsets.values()) - max(offsets.values())
    for camera in capture.cameras:
        video = Video(camera.video)
        start = max(0, first - offsets[camera.name] + lead)
        stop = min(video.count, first + count - offsets[camera.name] + _AFTER)
        images = np.stack([frame.image for frame in video.frames(start, stop, colour="rgb", threads=1)])
        place = folder / camera.name
        place.mkdir(parents=True)
        told = {}
        if kind.endswith("_pixels"):
            stored = written(kind.removesuffix("_pixels"), folder / "stored" / camera.name, images, capture.fps)
            images = np.stack([frame.image for frame in Video(stored).frames(colour="rgb", threads=1)])
            path = write_sequence(place, images, "png8", first=1000 + start)
        elif kind == "noise":
            noisy = np.rint(images + np.random.default_rng(1).normal(size=images.shape))
            path = write_sequence(place, noisy.clip(0, 255).astype(np.uint8), "png8", first=1000 + start)
        elif kind in KINDS:
            path = sequence(place, images, kind, start)
            told = {"timecode": timecode(offsets[camera.name] + start, capture.fps)}
        else:
            path = written(kind, place, images, capture.fps)
        cameras.append(camera.model_copy(update={"video": path, "masks": None, **told}))
        shifted[camera.name] = offsets[camera.name] + start
    zero = shifted[capture.reference]
    picks = capture.bootstrap.model_copy(update={"frame": capture.bootstrap.frame - zero})
    update = {"cameras": tuple(cameras), "frames": (first - zero, first + count - zero), "bootstrap": picks}
    shifted = {name: offset - zero for name, offset in shifted.items()}
    if kind in KINDS:
        update["sync"] = capture.sync.model_copy(update={"method": "timecode"})
        aligned = sync_cameras(capture.model_copy(update=update), quiet)["offsets"]
        if aligned != shifted:
            raise RuntimeError(f"{kind}: time codes give the offsets {aligned}, the clips have {shifted}")
    return capture.model_copy(update=update), shifted, zero


def poses(capture: Capture, offsets: dict[str, int], folder: Path) -> dict[int, np.ndarray]:
    """Return the pose of the lower teeth against the upper ones by frame, made from the footage."""
    entries = segment_teeth(capture, offsets, folder, SegmentOptions(jobs=1), quiet)
    found = {frame: np.array(entry["poses"]) for frame, entry in entries.items()}
    return {frame: relative_pose(pair[0], pair[1]) for frame, pair in found.items()}


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--first", type=int)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--kinds", nargs="*", default=["png8", "png16", "tiff16", "dpx10", "exr", "prores", "phone"])
    given = parser.parse_args()
    capture = load_capture(given.capture)
    first = capture.bootstrap.frame if given.first is None else given.first
    offsets = sync_cameras(capture, quiet)["offsets"]
    points = load_meshes(capture)["lower_teeth"].vertices
    own = capture.model_copy(
        update={
            "frames": (first, first + given.frames),
            "cameras": tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras),
        }
    )
    with tempfile.TemporaryDirectory() as scratch:
        wanted = poses(own, offsets, Path(scratch) / "own")
        print(f"{'footage':10} {'frames':>6} {'away mean':>10} {'max [mm]':>9}")
        for kind in given.kinds:
            place = Path(scratch) / kind
            other, shifted, zero = restored(capture, offsets, kind, place, first, given.frames)
            found = poses(other, shifted, place / "masks")
            pairs = [(T, wanted[frame + zero]) for frame, T in found.items()]
            apart = [transform_points(T, points) - transform_points(true, points) for T, true in pairs]
            away = [np.linalg.norm(one, axis=1).max() for one in apart]
            print(f"{kind:10} {len(away):6} {np.mean(away):10.5f} {np.max(away):9.5f}", flush=True)


if __name__ == "__main__":
    main()
