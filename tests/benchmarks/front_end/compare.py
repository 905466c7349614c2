"""Compare what tells teeth from the rest in footage: learned colours, the network of `net.py`, and both.

    python tests/benchmarks/front_end/compare.py NET CAPTURE [CAPTURE ...] [--kinds colours network both]

Every capture is tracked from its footage and picks alone (masks it names are not read), with the tracker of `jawusd
track` in which only the likelihood ratio of a pixel is exchanged: of its colour, as learned on the way; of the network,
which knows the take from nowhere; or the sum of both. Scored by the capture's truth: frames without a pose, distances
of the incisal point and of the worse condyle in the skull's frame [mm]: mean, median, largest, and processor seconds.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from jawusd.formats.capture import load_capture
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import LANDMARKS, transform_points
from jawusd.pipeline.subject import load_meshes, subject_of_capture
from jawusd.tracking.region.appearance import LearnedColours
from jawusd.tracking.region.view import RegionView

MOST = 3.0  # bound of log ratios, that of learned colours
LEVELS = 16  # of the network's log ratio: with the 4096 colours, what 16 bits hold
STRIDE = 8  # sizes the network takes are multiples of it
PLAIN = LearnedColours.views


class Network:
    """Rate pixels by the network: log ratio of tooth over anything else."""

    def __init__(self, path: Path) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def log_ratio(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the bounded log ratio of every pixel (h, w) of a picture (h, w, 3)."""
        height, width = rgb.shape[:2]
        padded = np.pad(rgb, ((0, -height % STRIDE), (0, -width % STRIDE), (0, 0)), mode="edge")
        inputs = np.ascontiguousarray(padded.transpose(2, 0, 1)[None], np.float32) / 255
        (logits,) = self._session.run(["logits"], {"rgb": inputs})
        upper, lower, other = logits[0, :, :height, :width]
        return np.clip(np.logaddexp(upper, lower) - other, -MOST, MOST)


@dataclass(frozen=True, eq=False)
class RatedView(RegionView):
    """A view whose pixels are rated by more than their colours."""

    colours: NDArray[np.uint16] | None = None  # colour bins, which new colours are counted by

    def _count(self, *arguments: object) -> None:
        plain = RegionView(self.rgb, self.colours, self.ratio, self.patches, self.axes, self.before, self.counts)
        plain._count(*arguments)


def rated(view: RegionView, network: Network, colours_too: bool) -> RatedView:
    """Return a view with the network's ratios, or their sum with the colours', bounded alike."""
    found = network.log_ratio(view.rgb)
    level = np.rint((found + MOST) / (2 * MOST) * (LEVELS - 1)).astype(np.uint16)
    values = np.linspace(-MOST, MOST, LEVELS, dtype=np.float32)
    bins = view.bins * np.uint16(LEVELS) + level
    own = view.ratio[..., None] if colours_too else np.zeros((*view.ratio.shape, 1), np.float32)
    ratio = np.clip(own + values, -MOST, MOST).reshape(*view.ratio.shape[:2], -1)
    return RatedView(view.rgb, bins, ratio, view.patches, view.axes, view.before, view.counts, colours=view.bins)


def exchange(network: Network | None, colours_too: bool) -> None:
    """Have trackers rate pixels by the network, by both, or, with None, by colours alone."""
    if network is None:
        LearnedColours.views = PLAIN
        return

    def views(self, pictures, before):
        out = PLAIN(self, pictures, before)
        return [
            replace(view, edges=rated(view.edges, network, colours_too)) if isinstance(view.edges, RegionView) else view
            for view in out
        ]

    LearnedColours.views = views


def without_masks(source: Path, folder: Path) -> Path:
    """Write a capture that names the same footage, scans and picks, and no masks."""
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("masks", "truth"))
    lines = (source / "capture.toml").read_text().splitlines()
    (folder / "capture.toml").write_text("\n".join(line for line in lines if not line.startswith("masks")) + "\n")
    return folder


def scored(capture: Path, kind: str) -> str:
    """Track a capture and return its row."""
    from typer.testing import CliRunner

    from jawusd.cli.main import app

    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "tracks.npz"
        start = time.process_time()
        ended = CliRunner().invoke(app, ["track", str(without_masks(capture, Path(scratch) / "take")), "-o", str(out)])
        seconds = time.process_time() - start
        if ended.exit_code:
            return f"{capture.name:<16}{kind:<10}{ended.stderr.strip() or ended.exception}"
        tracks = load_tracks(out)
    with np.load(capture / "truth" / "truth.npz") as archive:
        frames, exact = archive["frames"], archive["T_upper_lower"]
    loaded = load_capture(capture)
    points = subject_of_capture(loaded, load_meshes(loaded)).landmarks
    known = tracks.tracked() & np.isin(tracks.frames, frames)
    rows = np.searchsorted(frames, tracks.frames[known])
    gap = transform_points(tracks.T_upper_lower[known], points) - transform_points(exact[rows], points)
    away = np.linalg.norm(gap, axis=-1)
    incisor = away[:, LANDMARKS.index("incisor")]
    condyle = away[:, [LANDMARKS.index(name) for name in ("condyle_left", "condyle_right")]].max(1)
    figures = [f(x) for x in (incisor, condyle) for f in (np.mean, np.median, np.max)]
    row = "".join(f"{value:8.3f}" for value in figures)
    return f"{capture.name:<16}{kind:<10}{len(known) - known.sum():>5}{row}{seconds:8.0f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("net", type=Path)
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--kinds", nargs="+", default=["colours", "network", "both"])
    options = parser.parse_args()
    network = Network(options.net)
    print(f"{'capture':<16}{'by':<10}{'lost':>5}{'incisal point':^24}{'condyle':^24}{'CPU s':>8}")
    for capture in options.captures:
        for kind in options.kinds:
            exchange(None if kind == "colours" else network, kind == "both")
            print(scored(capture, kind), flush=True)


if __name__ == "__main__":
    main()
