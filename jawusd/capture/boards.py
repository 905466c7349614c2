"""Find calibration boards in videos or pictures: sharp pictures chosen, blurred ones refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.errors import CalibrationError, CaptureError
from jawusd.formats.capture import Boards
from jawusd.imaging.video import Video

__all__ = ["Sightings", "board_points", "board_symmetries", "edge_width_px", "find_boards"]

Array = NDArray[np.float64]

MOST_VIEWS = 80  # more add minutes, not accuracy
_PER_WINDOW = 2  # successive video pictures of which the sharpest is taken
_FEWEST_CORNERS = 8  # of a ChArUco board; fewer do not fix its pose
# 10 to 90 % width of the board's edges: wider than this share of the camera's median is motion, within these limits.
_BLUR_RATIO, _BLUR_LIMITS_PX = 1.5, (4.0, 8.0)
# The corner is refined in a window of this share of a cell: larger ones reach blur and lens, smaller ones only noise.
_WINDOW_SHARE, _WINDOW_PX = 0.12, (3, 12)
_FLAGS = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER


@dataclass(frozen=True, eq=False)
class Sightings:
    """Hold where the board's corners were seen.

    Attributes:
        names: camera names, C of them.
        sizes_px: picture (width, height) per camera.
        numbers: picture number of each view, shape (V,).
        corners_px: pixel of each corner, NaN where not seen, shape (C, V, N, 2).
        blurred: per camera the numbers of pictures refused because of blur.
        missed: per camera the numbers of pictures in which no board was found.
        notes: what a person should know of the clips.
    """

    names: tuple[str, ...]
    sizes_px: tuple[tuple[int, int], ...]
    numbers: NDArray[np.int64]
    corners_px: Array
    blurred: dict[str, list[int]]
    missed: dict[str, list[int]]
    notes: tuple[str, ...]


def board_points(boards: Boards) -> Array:
    """Return the inner corners row by row, origin at the board's middle [mm], shape (cols * rows, 3)."""
    i, j = np.meshgrid(np.arange(boards.cols), np.arange(boards.rows))
    x, y = i.ravel() - (boards.cols - 1) / 2, j.ravel() - (boards.rows - 1) / 2
    return np.stack([x, y, 0.0 * x], axis=1) * boards.square_mm


def board_symmetries(boards: Boards) -> list[NDArray[np.int64]]:
    """Return the orders in which a detector may list the corners of the same board, as permutations of (N,).

    A chessboard may come turned by half a turn, a square one by quarter turns; a ChArUco board numbers its corners.
    """
    grid = np.arange(boards.cols * boards.rows).reshape(boards.rows, boards.cols)
    if boards.pattern == "charuco":
        return [grid.ravel()]
    turns = (0, 1, 2, 3) if boards.cols == boards.rows else (0, 2)
    return [np.rot90(grid, turn).ravel() for turn in turns]


def find_boards(names: tuple[str, ...], boards: Boards, progress: Callable[[int, int], None]) -> Sightings:
    """Choose sharp pictures of the boards and find the corners in them.

    Args:
        names: the camera names, in the order of `boards.videos`.
        boards: the board, and one video or numbered picture pattern per camera.
        progress: told of every picture searched (done, total).

    Raises:
        CalibrationError: the clips share no pictures, show no board, or a board with other counts.
        CaptureError: a clip cannot be read.
    """
    clips = [_Clip(path) for path in boards.videos]
    chosen, notes = _choose(names, clips)
    total, done = len(chosen) * len(clips), 0

    def told(result: tuple) -> tuple:
        nonlocal done
        done += 1
        progress(done, total)
        return result

    def search(clip: _Clip) -> list[tuple[Array, float]]:
        search_one = _charuco(boards) if boards.pattern == "charuco" else _chessboard(boards)
        return [told(_found(search_one, image, boards)) for _, image in clip.pictures(chosen)]

    progress(0, total)
    with ThreadPoolExecutor(max_workers=min(len(clips), 4)) as pool:
        found = list(pool.map(search, clips))
    corners = np.array([[corner for corner, _ in camera] for camera in found])
    widths = np.array([[width for _, width in camera] for camera in found])
    seen = np.isfinite(widths)
    for name, clip, mask in zip(names, clips, seen):
        if mask.sum() < len(chosen) / 2:
            _refuse_other_board(name, clip, chosen, boards, int(mask.sum()))
    blurred = seen & (widths > _limits_px(widths)[:, None])
    corners[blurred] = np.nan
    used = (seen & ~blurred).any(0)
    numbers = np.array(chosen)
    return Sightings(
        names,
        tuple(clip.size_px for clip in clips),
        numbers[used],
        corners[:, used],
        {name: numbers[row].tolist() for name, row in zip(names, blurred)},
        {name: numbers[~row].tolist() for name, row in zip(names, seen)},
        tuple(notes),
    )


def edge_width_px(image: NDArray[np.uint8], corners_px: Array, cols: int) -> float:
    """Return the 10 to 90 % width of a chessboard's edges from its gradient energy.

    A step of contrast C blurred by a Gaussian of sigma has the gradient energy C^2 / (2 sigma sqrt(pi)) per length of
    edge; a chessboard with cell sides a and b has (|a| + |b|) / |a x b| of edge per area.

    Args:
        image: gray picture, shape (h, w).
        corners_px: found corners row by row, NaN where not seen, shape (N, 2).
        cols: corners per row.
    """
    grid = corners_px.reshape(-1, cols, 2)
    along, down = np.nanmean(np.diff(grid, axis=1), axis=(0, 1)), np.nanmean(np.diff(grid, axis=0), axis=(0, 1))
    area = abs(along[0] * down[1] - along[1] * down[0])
    if not area > 0:
        return float("inf")
    density = (np.linalg.norm(along) + np.linalg.norm(down)) / area
    hull = cv2.convexHull(corners_px[np.isfinite(corners_px[:, 0])].astype(np.float32))
    x, y, w, h = cv2.boundingRect(hull)
    x, y = max(x, 0), max(y, 0)
    part = image[y : y + h, x : x + w].astype(np.float32)
    inside = np.zeros(part.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.round(hull - [x, y]).astype(np.int32), 1)
    gy, gx = np.gradient(part)
    energy = float((gx * gx + gy * gy)[inside > 0].mean())
    black, white = np.percentile(part[inside > 0], (5, 95))
    sigma = float(white - black) ** 2 * density / (2 * np.sqrt(np.pi) * energy)
    return 2 * 1.2816 * float(sigma)


class _Clip:
    """The board pictures of one camera: a video, or numbered pictures (a pattern with %d)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if "%" in path.name:
            self._video = None
            self.numbers = _numbered(path)
            self.size_px = _read(Path(str(path) % self.numbers[0])).shape[::-1]
        else:
            self._video = Video(path)
            self.numbers = list(range(self._video.count))
            self.size_px = self._video.size_px

    @property
    def is_video(self) -> bool:
        return self._video is not None

    def pictures(self, wanted: list[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (number, gray picture) of the wanted ones, in order."""
        if self._video is None:
            for number in wanted:
                path = Path(str(self.path) % number)
                image = _read(path)
                if image.shape[::-1] != self.size_px:
                    raise CalibrationError(
                        f"is {image.shape[1]} x {image.shape[0]} px, the first picture {self.size_px[0]} x "
                        f"{self.size_px[1]} px.",
                        path=path,
                    )
                yield number, image
            return
        needed = set(wanted)
        for frame in self._video.frames(min(wanted), max(wanted) + 1, threads=1):
            if frame.index in needed:
                yield frame.index, frame.image


def _numbered(pattern: Path) -> list[int]:
    numbers = []
    head, _, tail = pattern.name.partition("%")
    tail = tail[tail.find("d") + 1 :]
    for file in pattern.parent.iterdir():
        digits = file.name[len(head) : len(file.name) - len(tail)]
        if digits.isdigit() and file.name == pattern.name % int(digits):
            numbers.append(int(digits))
    if not numbers:
        raise CaptureError("no picture matches.", path=pattern, hint="Check [boards] videos in capture.toml.")
    return sorted(numbers)


def _read(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise CaptureError("is not a picture that can be read.", path=path, hint="Use PNG, JPEG or TIFF.")
    return image


def _choose(names: tuple[str, ...], clips: list[_Clip]) -> tuple[list[int], list[str]]:
    """Return the numbers of the pictures to search, and notes."""
    notes = []
    counts = [len(clip.numbers) for clip in clips]
    shared = sorted(set.intersection(*(set(clip.numbers) for clip in clips)))
    if not shared:
        raise CalibrationError("the board clips share no picture number.", path=clips[0].path)
    if len(set(counts)) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in zip(names, counts))
        notes.append(
            f"the board clips hold different numbers of pictures ({listed}): the first {len(shared)} are taken as "
            "simultaneous; a clip that was cut at its beginning would spoil the result."
        )
    if not all(clip.is_video for clip in clips):
        step = max(1, -(-len(shared) // MOST_VIEWS))
        return shared[::step], notes
    sharpness = []
    with ThreadPoolExecutor(max_workers=min(len(clips), 4)) as pool:
        for values in pool.map(lambda clip: [_sharpness(image) for _, image in clip.pictures(shared)], clips):
            sharpness.append(np.array(values) / np.median(values))
    worst = np.min(sharpness, axis=0)  # a picture counts as sharp where it is so in all cameras
    windows = np.array_split(np.arange(len(shared)), min(MOST_VIEWS, -(-len(shared) // _PER_WINDOW)))
    return [shared[window[np.argmax(worst[window])]] for window in windows], notes


def _sharpness(image: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian (Pech-Pacheco et al. 2000), of use between pictures of one camera."""
    return float(cv2.Laplacian(image, cv2.CV_16S).var()) + 1e-9


def _limits_px(widths: Array) -> Array:
    """Return per camera the width of edges above which a picture is blurred, shape (C,)."""
    median = np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in widths])
    return np.clip(_BLUR_RATIO * median, *_BLUR_LIMITS_PX)


def _found(search: Callable[[NDArray[np.uint8]], Array | None], image: NDArray[np.uint8], boards: Boards) -> tuple:
    corners = search(image)
    if corners is None:
        return np.full((boards.cols * boards.rows, 2), np.nan), np.nan
    return corners, edge_width_px(image, corners, boards.cols)


def _chessboard(boards: Boards) -> Callable[[NDArray[np.uint8]], Array | None]:
    def search(image: NDArray[np.uint8]) -> Array | None:
        ok, corners, meta = cv2.findChessboardCornersSBWithMeta(image, (boards.cols, boards.rows), flags=_FLAGS)
        if not ok or meta.shape != (boards.rows, boards.cols):
            return None
        return _refined(image, corners.reshape(-1, 2).astype(np.float64), boards)

    return search


def _refined(image: NDArray[np.uint8], corners_px: Array, boards: Boards) -> Array:
    """Return corners moved to the saddle points (Förstner & Gülch 1987, by OpenCV): a third of the scatter."""
    grid = corners_px.reshape(boards.rows, boards.cols, 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    half = int(np.clip(round(_WINDOW_SHARE * min(sides)), *_WINDOW_PX))
    start = np.ascontiguousarray(corners_px.reshape(-1, 1, 2), np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    moved = cv2.cornerSubPix(np.ascontiguousarray(image), start, (half, half), (-1, -1), stop)
    return moved.reshape(-1, 2).astype(np.float64)


def _charuco(boards: Boards) -> Callable[[NDArray[np.uint8]], Array | None]:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(boards.dictionary)))
    size = (boards.cols + 1, boards.rows + 1)
    markers, known = size[0] * size[1] // 2, len(dictionary.bytesList)
    if markers > known:
        raise CalibrationError(
            f"[boards] a ChArUco board of {boards.cols} x {boards.rows} inner corners needs {markers} markers, "
            f"{boards.dictionary} has {known}."
        )
    board = cv2.aruco.CharucoBoard(size, boards.square_mm, float(boards.marker_mm or 0), dictionary)
    detector = cv2.aruco.CharucoDetector(board)

    def search(image: NDArray[np.uint8]) -> Array | None:
        corners, ids, _, _ = detector.detectBoard(np.ascontiguousarray(image))
        if ids is None or len(ids) < _FEWEST_CORNERS:
            return None
        out = np.full((boards.cols * boards.rows, 2), np.nan)
        out[np.ravel(ids)] = np.reshape(corners, (-1, 2))
        # Corners of one row do not fix a pose, nor the size of a cell.
        grid = np.isfinite(out[:, 0]).reshape(boards.rows, boards.cols)
        whole = (grid[:, 1:] & grid[:, :-1]).any() and (grid[1:] & grid[:-1]).any()
        return out if whole else None

    return search


def _refuse_other_board(name: str, clip: _Clip, chosen: list[int], boards: Boards, found: int) -> None:
    """Raise if the pictures show a chessboard with other counts than those given, or hardly any board."""
    counts: Counter[tuple[int, int]] = Counter()
    if boards.pattern == "chessboard":
        for _, image in clip.pictures(chosen[:: max(1, len(chosen) // 6)]):
            ok, _, meta = cv2.findChessboardCornersSBWithMeta(
                image, (3, 3), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
            )
            if ok:
                counts[max(meta.shape), min(meta.shape)] += 1
    if counts:
        (cols, rows), times = counts.most_common(1)[0]
        if times >= 2 and {cols, rows} != {boards.cols, boards.rows}:
            raise CalibrationError(
                f"camera {name}: the board has {cols} x {rows} inner corners, [boards] says {boards.cols} x "
                f"{boards.rows}.",
                path=clip.path,
                hint="Correct cols and rows; inner corners are one fewer than squares.",
            )
    if not found:
        extra = f" of {boards.dictionary}" if boards.pattern == "charuco" else ""
        raise CalibrationError(
            f"camera {name}: no {boards.pattern}{extra} with {boards.cols} x {boards.rows} inner corners in any of "
            f"{len(chosen)} pictures.",
            path=clip.path,
            hint="Check [boards]: pattern and inner corners; all of a chessboard must be in view, with a white rim.",
        )
