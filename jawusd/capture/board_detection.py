"""Read board clips, detect the corners of calibration boards in single images, and measure edge sharpness."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array
from jawusd.base.errors import CalibrationError, CaptureError
from jawusd.formats.capture import Boards
from jawusd.formats.capture_writing import BoardSketch
from jawusd.formats.file_names import is_pattern, numbered_files
from jawusd.media.pictures import read_gray, read_header, read_stored
from jawusd.media.pixels import to_display
from jawusd.media.video import Video

Search = Callable[[NDArray[np.uint8]], Array | None]

_TIMES, _FEW_MARKERS = 2, 4  # minimum number of images that show the same board, and of markers in each of them
_WIDTH_PX = 960  # image width for the search of an unknown board; sufficient for boards that fill a fifth of the image
_FAMILIES = ("4X4", "5X5", "6X6", "7X7")
_SIZES = (50, 100, 250, 1000)  # sizes of OpenCV's marker dictionaries; smaller ones are prefixes of larger ones
_FEWEST_CORNERS = 8  # minimum number of corners of a ChArUco board; fewer do not determine its pose
# Size of the corner refinement window as a fraction of a board cell. Blur and distortion bias corners in larger
# windows; noise dominates in smaller ones.
_WINDOW_SHARE, _WINDOW_PX = 0.12, (3, 12)
_LARGE_PX = 1000  # width above which an image is first searched at half resolution, in a quarter of the time
_FLAGS = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER


def detector(boards: Boards) -> Search:
    """Return a function that finds a board's corners in a gray image: (N, 2) row by row, NaN where hidden, or None.

    Raises:
        CalibrationError: the dictionary has too few markers for the board.
    """
    return _charuco(boards) if boards.pattern == "charuco" else _chessboard(boards)


def different_board(images: Sequence[NDArray[np.uint8]], boards: Boards, missed: bool) -> str | None:
    """Describe the board in gray images (h, w) if it differs from the board of [boards], otherwise return None.

    Absent markers are evidence of a smaller board only if the board of [boards] was `missed` in most images of the
    clip.
    """
    (cols, rows), times = _common_chessboard(images)
    described = f"{boards.cols} x {boards.rows}"
    if boards.pattern == "chessboard":
        if times >= _TIMES and {cols, rows} != {boards.cols, boards.rows}:
            return f"the board has {cols} x {rows} inner corners, but [boards] describes {described}"
        return None
    markers = cv2.aruco.ArucoDetector(_dictionary(boards))
    found = [markers.detectMarkers(np.ascontiguousarray(image))[1] for image in images]
    highest = [int(ids.max()) for ids in found if ids is not None and len(ids) >= _FEW_MARKERS]
    count = _marker_count(boards)
    if len(highest) < _TIMES:
        shown = f"a chessboard of {cols} x {rows} inner corners without markers of {boards.dictionary}"
        return f"the images show {shown}" if times >= _TIMES else None
    beyond = sum(number >= count for number in highest) >= _TIMES
    if beyond or (missed and max(highest) < count - 1):
        return (
            f"the board has markers 0 to {max(highest)}, but a board of {described} inner corners has 0 to {count - 1}"
        )
    return None


def _common_chessboard(images: Sequence[NDArray[np.uint8]]) -> tuple[tuple[int, int], int]:
    """Return the numbers of inner corners (columns, rows) of the most frequent chessboard, and its number of images."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found = [cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags=flags) for image in images]
    sizes = Counter((max(meta.shape), min(meta.shape)) for ok, _, meta in found if ok)
    return sizes.most_common(1)[0] if sizes else ((0, 0), 0)


def detect_board(pictures: Iterable[NDArray[np.uint8]]) -> BoardSketch | None:
    """Return the board found in the largest number of gray images (h, w), or None if no two images agree.

    A chessboard has its numbers of inner corners, and a ChArUco board its dictionary of markers.
    """
    markers: Counter[str] = Counter()
    highest: dict[str, int] = {}
    small = [_reduced(picture) for picture in pictures]
    for picture in small:
        for family, largest in _markers(picture):
            markers[family] += 1
            highest[family] = max(largest, highest.get(family, 0))
    family, times = markers.most_common(1)[0] if markers else ("", 0)
    if times >= _TIMES:
        size = next(size for size in _SIZES if size > highest[family])
        return BoardSketch("charuco", dictionary=f"DICT_{family}_{size}")
    (cols, rows), times = _common_chessboard(small)
    return BoardSketch("chessboard", cols, rows) if times >= _TIMES else None


def _reduced(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = picture.shape
    if width <= _WIDTH_PX:
        return np.ascontiguousarray(picture)
    size = (_WIDTH_PX, round(height * _WIDTH_PX / width))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _markers(picture: NDArray[np.uint8]) -> Iterable[tuple[str, int]]:
    """Yield each detected marker family and its highest marker number."""
    for family in _FAMILIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}_{_SIZES[-1]}"))
        numbers = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)[1]
        if numbers is not None and len(numbers) >= _FEW_MARKERS:
            yield family, int(numbers.max())


def _chessboard(boards: Boards) -> Search:
    def look(image: NDArray[np.uint8]) -> Array | None:
        ok, corners, meta = cv2.findChessboardCornersSBWithMeta(image, (boards.cols, boards.rows), flags=_FLAGS)
        if not ok or meta.shape != (boards.rows, boards.cols):
            return None
        return corners.reshape(-1, 2).astype(np.float64)

    def search(image: NDArray[np.uint8]) -> Array | None:
        height, width = image.shape
        corners = None
        if width >= _LARGE_PX:
            half = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
            corners = look(np.asarray(half, np.uint8))
        if corners is not None:
            corners = (corners + 0.5) * [width / (width // 2), height / (height // 2)] - 0.5
        else:
            corners = look(image)
        return None if corners is None else _refined(image, corners, boards)

    return search


def _refined(image: NDArray[np.uint8], corners_px: Array, boards: Boards) -> Array:
    """Refine corners to saddle points, which reduces their scatter to a third (Förstner & Gülch 1987, in OpenCV)."""
    grid = corners_px.reshape(boards.rows, boards.cols, 2)
    sides = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    half = int(np.clip(round(_WINDOW_SHARE * min(sides)), *_WINDOW_PX))
    start = np.ascontiguousarray(corners_px.reshape(-1, 1, 2), np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    moved = cv2.cornerSubPix(np.ascontiguousarray(image), start, (half, half), (-1, -1), stop)
    return moved.reshape(-1, 2).astype(np.float64)


def _charuco(boards: Boards) -> Search:
    dictionary, size = _dictionary(boards), (boards.cols + 1, boards.rows + 1)
    markers, known = _marker_count(boards), len(dictionary.bytesList)
    if markers > known:
        raise CalibrationError(
            f"[boards] a ChArUco board of {boards.cols} x {boards.rows} inner corners has {markers} markers; "
            f"{boards.dictionary} has only {known}."
        )
    # Boards with an even number of rows, drawn by OpenCV before version 4.6, have exchanged colours; they are still
    # sold.
    detectors = [_charuco_detector(boards, size, legacy) for legacy in (False, True)[: 2 - size[1] % 2]]

    def search(image: NDArray[np.uint8]) -> Array | None:
        for detector in list(detectors):
            corners, ids, _, _ = detector.detectBoard(np.ascontiguousarray(image))
            if ids is not None and len(ids) >= _FEWEST_CORNERS:
                detectors.sort(key=lambda other: other is not detector)  # try this detector first in the next image
                break
        else:
            return None
        out = np.full((boards.cols * boards.rows, 2), np.nan)
        out[np.ravel(ids)] = np.reshape(corners, (-1, 2))
        # Corners in a single row determine neither the pose of the board nor the cell size.
        grid = np.isfinite(out[:, 0]).reshape(boards.rows, boards.cols)
        whole = (grid[:, 1:] & grid[:, :-1]).any() and (grid[1:] & grid[:-1]).any()
        return out if whole else None

    return search


def _charuco_detector(boards: Boards, size: tuple[int, int], legacy: bool) -> cv2.aruco.CharucoDetector:
    board = cv2.aruco.CharucoBoard(size, boards.square_mm, float(boards.marker_mm or 0), _dictionary(boards))
    board.setLegacyPattern(legacy)
    return cv2.aruco.CharucoDetector(board)


def _dictionary(boards: Boards) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(boards.dictionary)))


def _marker_count(boards: Boards) -> int:
    """Return the number of white squares of a ChArUco board, which equals the number of its markers."""
    return (boards.cols + 1) * (boards.rows + 1) // 2


def edge_width_px(image: NDArray[np.uint8], corners_px: Array, cols: int) -> float:
    """Return the 10 to 90 % edge width [px] of a chessboard in a gray image (h, w) from its gradient energy.

    An edge of contrast C blurred by a Gaussian of standard deviation sigma has the gradient energy C^2 / (2 sigma
    sqrt(pi)) per edge length; a chessboard with cell sides a and b has the edge length (|a| + |b|) / |a x b| per area.
    The corners (N, 2) are listed row by row, `cols` per row, NaN where hidden.
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
    energy = float(np.asarray(gx * gx + gy * gy)[inside > 0].mean())
    contrast = float(np.percentile(part[inside > 0], 95) - np.percentile(part[inside > 0], 5))
    sigma = contrast**2 * density / (2 * np.sqrt(np.pi) * energy)
    return 2 * 1.2816 * float(sigma)


class BoardClip:
    """Board images of one camera: a video or numbered images.

    Attributes:
        path: the video, or the pattern of the image names.
        numbers: increasing image numbers; in a video, the numbers of the frames that show an image.
        size_px: (width, height) of all images.
    """

    def __init__(self, path: Path) -> None:
        """Find the images of a board clip.

        Raises:
            CaptureError: there are no images, or the first image cannot be read.
        """
        self.path = path
        self._files: dict[int, Path] = {}
        if is_pattern(path):
            self._video = None
            self._files = numbered_files(path)
            self.numbers = list(self._files)
            self.size_px = _read(self._files[self.numbers[0]]).shape[::-1]
        else:
            self._video = Video(path)
            self.numbers = sorted(set(self._video.timeline.numbers.tolist()))
            self.size_px = self._video.size_px

    @property
    def is_video(self) -> bool:
        """Return whether the images are frames of a video."""
        return self._video is not None

    @property
    def is_interlaced(self) -> bool:
        """Return whether any image read so far is flagged as interlaced."""
        return self._video is not None and self._video.is_interlaced

    def pictures(self, wanted: list[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield (number, gray image) for the given numbers, in order.

        Raises:
            CalibrationError: an image differs in size from the first image.
            CaptureError: an image cannot be read.
        """
        if self._video is None:
            for number in wanted:
                path = self._files[number]
                image = _read(path)
                if image.shape[::-1] != self.size_px:
                    raise CalibrationError(
                        f"is {image.shape[1]} x {image.shape[0]} px, but the first image is {self.size_px[0]} x "
                        f"{self.size_px[1]} px.",
                        path=path,
                    )
                yield number, image
            return
        shown = {self._video.timeline.picture(number): number for number in wanted}
        needed = {picture: number for picture, number in shown.items() if picture is not None}
        for frame in self._video.frames(min(needed), max(needed) + 1, threads=1):
            if frame.index in needed:
                yield needed[frame.index], frame.image


def _read(path: Path) -> NDArray[np.uint8]:
    image = read_gray(path)
    if image is not None:
        return image
    try:  # OpenCV does not read EXR and DPX
        stored, white = read_stored(path)
    except CaptureError as error:
        raise CaptureError("is not a readable image.", path=path, hint="Use PNG, JPEG, TIFF, EXR or DPX.") from error
    shown = to_display(stored, white, read_header(path).colour_space, None)
    return shown if shown.ndim == 2 else np.asarray(cv2.cvtColor(shown, cv2.COLOR_RGB2GRAY), np.uint8)


def sharpness(image: NDArray[np.uint8]) -> float:
    """Return the variance of an image's Laplacian (Pech-Pacheco et al. 2000), to compare images of one camera."""
    return float(cv2.Laplacian(image, cv2.CV_16S).var()) + 1e-9
