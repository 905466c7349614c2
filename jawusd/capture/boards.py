"""Find calibration boards in videos or images, using only sharp images."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError
from jawusd.capture.board_detection import BoardClip, detector, different_board, edge_width_px, sharpness
from jawusd.formats.capture import Boards
from jawusd.media.clip import INTERLACED, INTERLACED_HINT

MOST_VIEWS = 80  # maximum number of views in a calibration; more views would not increase the accuracy
_LOOKED_AT = 6  # number of images that are searched for a board different from [boards]
_PER_WINDOW = 2  # number of consecutive video frames of which the sharpest is used
# An image is blurred if its 10 to 90 % edge width exceeds the camera's median by this factor; the limit is clamped to a
# range.
_BLUR_RATIO, _BLUR_LIMITS_PX = 1.5, (4.0, 8.0)


@dataclass(frozen=True, eq=False)
class BoardDetections:
    """Board corners detected in V views by C cameras; the board has N corners."""

    names: tuple[str, ...]  # camera names, length C
    sizes_px: tuple[tuple[int, int], ...]  # image (width, height) of each camera
    numbers: NDArray[np.int64]  # image number of each view, shape (V,)
    corners_px: Array  # pixel coordinates of the corners, NaN where hidden, shape (C, V, N, 2)
    blurred: dict[str, list[int]]  # numbers of the images rejected as blurred, by camera
    missed: dict[str, list[int]]  # numbers of the images in which no board was found, by camera
    notes: tuple[str, ...]  # remarks on the clips for the user


def board_points(boards: Boards) -> Array:
    """Return the inner corners row by row [mm], with the origin at the board's centre, shape (cols * rows, 3)."""
    i, j = np.meshgrid(np.arange(boards.cols), np.arange(boards.rows))
    x, y = i.ravel() - (boards.cols - 1) / 2, j.ravel() - (boards.rows - 1) / 2
    return np.stack([x, y, 0.0 * x], axis=1) * boards.square_mm


def board_symmetries(boards: Boards) -> list[NDArray[np.int64]]:
    """Return the orders in which a detector may list the N corners of a board, as permutations of shape (N,).

    A chessboard has a two-fold symmetry, a square one a four-fold one. ChArUco corners are numbered.
    """
    grid = np.arange(boards.cols * boards.rows).reshape(boards.rows, boards.cols)
    if boards.pattern == "charuco":
        return [grid.ravel()]
    turns = (0, 1, 2, 3) if boards.cols == boards.rows else (0, 2)
    return [np.rot90(grid, turn).ravel() for turn in turns]


def find_boards(names: tuple[str, ...], boards: Boards, progress: Callable[[int, int], None]) -> BoardDetections:
    """Select sharp images from each camera's board clip and find the corners in them.

    Raises:
        CalibrationError: the clips have no image number in common, or show no board or a different board.
        CaptureError: a clip cannot be read.
    """
    clips = [BoardClip(path) for path in boards.videos]
    chosen, notes = _choose(names, clips)
    total, done = len(chosen) * len(clips), 0

    def search(clip: BoardClip) -> list[tuple[Array, float]]:
        nonlocal done
        one, found = detector(boards), list[tuple[Array, float]]()
        for _, image in clip.pictures(chosen):
            corners = one(image)
            if corners is None:
                found.append((np.full((boards.cols * boards.rows, 2), np.nan), np.nan))
            else:
                found.append((corners, edge_width_px(image, corners, boards.cols)))
            done += 1
            progress(done, total)
        return found

    progress(0, total)
    with ThreadPoolExecutor(max_workers=min(len(clips), 4)) as pool:
        found = list(pool.map(search, clips))
    corners = np.array([[corner for corner, _ in camera] for camera in found])
    widths = np.array([[width for _, width in camera] for camera in found])
    seen = np.isfinite(widths)
    for name, clip, mask in zip(names, clips, seen):
        if (fault := _board_fault(clip, chosen, boards, int(mask.sum()))) is not None:
            raise CalibrationError(fault[0], camera=name, path=clip.path, hint=fault[1])
    limits = _limits_px(widths)
    blurred = seen & (widths > limits[:, None])
    for c in np.flatnonzero(seen.any(1) & (blurred == seen).all(1)):
        raise CalibrationError(
            f"all {seen[c].sum()} images of the board are blurred: its edges are {np.median(widths[c, seen[c]]):.1f} "
            f"px wide (10 to 90 %); the limit is {limits[c]:.1f} px.",
            camera=names[c],
            path=clips[c].path,
            hint="Film the board again: in focus, held still, with more light or a shorter exposure.",
        )
    notes += [f"camera {name}: {INTERLACED}. {INTERLACED_HINT}" for name, c in zip(names, clips) if c.is_interlaced]
    corners[blurred] = np.nan
    used = (seen & ~blurred).any(0)
    numbers = np.array(chosen)
    return BoardDetections(
        names,
        tuple(clip.size_px for clip in clips),
        numbers[used],
        corners[:, used],
        {name: numbers[row].tolist() for name, row in zip(names, blurred)},
        {name: numbers[~row].tolist() for name, row in zip(names, seen)},
        tuple(notes),
    )


def _choose(names: tuple[str, ...], clips: list[BoardClip]) -> tuple[list[int], list[str]]:
    """Return the numbers of the images to search, and notes for the user."""
    notes = []
    counts = [len(clip.numbers) for clip in clips]
    shared = sorted(set.intersection(*(set(clip.numbers) for clip in clips)))
    if not shared:
        raise CalibrationError("no image number occurs in all board clips.", path=clips[0].path)
    if len(set(counts)) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in zip(names, counts))
        notes.append(
            f"the board clips have different numbers of images ({listed}): {len(shared)} images with equal number or "
            "time are assumed to be simultaneous; a clip trimmed at its start would invalidate the result."
        )
    if not all(clip.is_video for clip in clips):
        step = max(1, -(-len(shared) // MOST_VIEWS))
        return shared[::step], notes
    sharp = []
    with ThreadPoolExecutor(max_workers=min(len(clips), 4)) as pool:
        for values in pool.map(lambda clip: [sharpness(image) for _, image in clip.pictures(shared)], clips):
            sharp.append(np.array(values) / np.median(values))
    worst = np.min(sharp, axis=0)  # views in which every camera's image is sharp are preferred
    windows = np.array_split(np.arange(len(shared)), min(MOST_VIEWS, -(-len(shared) // _PER_WINDOW)))
    return [shared[window[np.argmax(worst[window])]] for window in windows], notes


def _limits_px(widths: Array) -> Array:
    """Return for each camera the edge width [px] above which an image is blurred, shape (C,)."""
    median = np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in widths])
    return np.clip(_BLUR_RATIO * median, *_BLUR_LIMITS_PX)


def _board_fault(clip: BoardClip, chosen: list[int], boards: Boards, found: int) -> tuple[str, str] | None:
    """Return what is wrong if images show no board, or a board different from [boards], and what to do."""
    missed = found < len(chosen) / 2
    if missed and clip.is_interlaced:
        return f"the board was found in {found} of {len(chosen)} images: {INTERLACED}.", INTERLACED_HINT
    if not missed and boards.pattern == "chessboard":
        return None  # only a ChArUco board can be detected as part of a different board
    some = [image for _, image in clip.pictures(chosen[:: max(1, len(chosen) // _LOOKED_AT)])]
    if (other := different_board(some, boards, missed)) is not None:
        hint = "Correct [boards] in capture.toml; cols and rows count inner corners, one less than squares."
        return f"{other}.", hint
    if found:
        return None
    extra = f" of {boards.dictionary}" if boards.pattern == "charuco" else ""
    board = f"{boards.pattern}{extra} with {boards.cols} x {boards.rows} inner corners"
    return (
        f"no {board} was found in any of {len(chosen)} images.",
        "Check pattern and inner corners in [boards]; a chessboard must be fully in view, sharp, and have a white rim.",
    )
