"""The result of one frame, why an arch was lost in it, and a compact store for the records of a whole take."""

from __future__ import annotations

import math
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import OutputError
from jawusd.formats.tracks import LOST, LostReason
from jawusd.tracking.contour.equations import OutlineSums, Solution
from jawusd.tracking.contour.quality import residual_px, score_px


class Loss(NamedTuple):
    """Name the check an arch failed, with the figure found and its limit in the unit of `LostReason`."""

    reason: LostReason
    value: float
    limit: float


#: Of an arch that is not lost, or whose loss has no recorded reason.
NO_LOSS = Loss(LostReason.NONE, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """Hold what is known about one instant."""

    solution: Solution  # the alignment; its poses of lost arches mean nothing
    status: NDArray[np.int8]  # of both arches, as in `Tracks`, shape (2,)
    used: Mask  # masks that took part, shape (2, C)
    coverage: Array  # E_SP over mask pixels, shape (2, C); NaN without a mask
    losses: tuple[Loss, Loss] = (NO_LOSS, NO_LOSS)  # why each arch is lost


def whole_frames(records: Mapping[int, FrameRecord]) -> list[int]:
    """Return the frames in which both arches are tracked, in order."""
    return [frame for frame in sorted(records) if (records[frame].status != LOST).all()]


@dataclass(frozen=True, eq=False)
class FrameSummary:
    """Hold what the frames after an instant need to know about it.

    Attributes:
        poses: T_world_upper and T_world_lower, shape (2, 4, 4).
        status, used, coverage: as in `FrameRecord`.
        score_px: contour that fits per arch and view, shape (2, C).
        residual_px: standard deviation of the residuals per arch, shape (2,).
    """

    poses: Array
    status: NDArray[np.int8]
    used: Mask
    coverage: Array
    score_px: Array
    residual_px: Array

    @classmethod
    def of(cls, record: FrameRecord) -> FrameSummary:
        """Return what to keep of a frame."""
        solution = record.solution
        seen = (record.status, record.used, record.coverage)
        return cls(solution.poses, *seen, score_px(solution), residual_px(solution))


_KEPT_FRAMES = 32
_IN_MEMORY = 16 << 20  # bytes before there is a file: takes of a minute or two need none
# Of a sum per arch and view; the first is a symmetric 6 x 6 matrix.
_SUM_SHAPES = tuple(table.shape[2:] for table in OutlineSums.zeros(1))
_LOWER = np.tril_indices(6)
_MIRROR = np.empty((6, 6), np.int64)  # of a whole matrix, where its entries lie in the lower half
_MIRROR[_LOWER] = _MIRROR[_LOWER[::-1]] = np.arange(len(_LOWER[0]))


class PackedRecords(MutableMapping[int, FrameRecord]):
    """Map frames to their records; each is packed when it is set and unpacked when it is looked up.

    Poses and figures keep double precision. Sums over samples have single precision: they are sums of thousands of
    distances known to a hundredth of a pixel. For one thread.
    """

    def __init__(self) -> None:
        self._store = _Store()
        self._places: dict[int, int] = {}
        self._unpacked: dict[int, FrameRecord] = {}  # those looked up last: mostly frames beside one another

    def __getitem__(self, frame: int) -> FrameRecord:
        if frame not in self._unpacked:
            found = _unpacked(*self._store.read(self._places[frame]))
            if len(self._unpacked) >= _KEPT_FRAMES:
                del self._unpacked[next(iter(self._unpacked))]
            self._unpacked[frame] = found
        return self._unpacked[frame]

    def __setitem__(self, frame: int, record: FrameRecord) -> None:
        self._places[frame] = self._store.add(*_packed(record))
        self._unpacked.pop(frame, None)

    def __delitem__(self, frame: int) -> None:
        del self._places[frame]
        self._unpacked.pop(frame, None)

    def __contains__(self, frame: object) -> bool:
        return frame in self._places  # by default, the record would be unpacked

    def __iter__(self) -> Iterator[int]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def kept(self, frames: Iterable[int]) -> PackedRecords:
        """Return the same records of some frames."""
        out = PackedRecords()
        out._store = self._store
        out._places = {frame: self._places[frame] for frame in frames}
        return out


class _Store:
    """Keep packed records one behind the other; what is replaced stays, for copies of the mapping may hold it."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115  # open as long as this object is used
        self._end = 0
        weakref.finalize(self, self._file.close)

    def add(self, figures: Array, sums: NDArray[np.float32]) -> int:
        """Write a record; return its place.

        Raises:
            OutputError: the folder for such files is full.
        """
        place = self._end
        try:
            self._file.seek(place)
            for part in (np.array([len(figures), len(sums)], np.int64), figures, sums):
                self._end += self._file.write(part.tobytes())
        except OSError as error:
            raise OutputError(
                f"a long take cannot be kept there while it is tracked: {error.strerror}.",
                path=tempfile.gettempdir(),
                hint="Make room, or name another folder in TMPDIR.",
            ) from error
        return place

    def read(self, place: int) -> tuple[Array, NDArray[np.float32]]:
        """Return the record at a place."""
        self._file.seek(place)
        figures, sums = np.frombuffer(self._file.read(16), np.int64).tolist()
        return (
            np.frombuffer(self._file.read(8 * figures), np.float64),
            np.frombuffer(self._file.read(4 * sums), np.float32),
        )


def _packed(record: FrameRecord) -> tuple[Array, NDArray[np.float32]]:
    solution, losses = record.solution, record.losses
    figures = (
        solution.poses, solution.centres, solution.visible_px, record.status, record.used, record.coverage,
        [(float(loss.reason), loss.value, loss.limit) for loss in losses], [solution.iterations],
    )  # fmt: skip
    sums = []
    for outline in (solution.silhouette, solution.gingival_margin):
        sums += [outline.precision[..., _LOWER[0], _LOWER[1]], *outline[1:]]
    sums += [matrix[:, _LOWER[0], _LOWER[1]] for matrix in (solution.scatters, solution.gum_scatters)]
    return _joined(figures), _joined(sums).astype(np.float32)


def _unpacked(figures: Array, sums: NDArray[np.float32]) -> FrameRecord:
    # Besides poses, centres, status, losses and iterations there are three figures per arch and view.
    views = (len(figures) - 2 * 16 - 2 * 3 - 2 - 2 * 3 - 1) // (2 * 3)
    of_figures, of_sums = _places(views)
    poses, centres, visible, status, used, coverage, losses, iterations = _split(figures, of_figures)
    parts = _split(sums.astype(np.float64), of_sums)
    count = len(_SUM_SHAPES)
    silhouette, margin = (OutlineSums(parts[k][..., _MIRROR], *parts[k + 1 : k + count]) for k in (0, count))
    scatters, gum_scatters = (part[:, _MIRROR] for part in parts[-2:])
    solution = Solution(poses, silhouette, margin, centres, scatters, gum_scatters, visible, int(iterations[0]))
    first, second = (Loss(LostReason(int(reason)), float(value), float(limit)) for reason, value, limit in losses)
    return FrameRecord(solution, status.astype(np.int8), used.astype(bool), coverage, (first, second))


def _joined(arrays: Iterable[ArrayLike]) -> Array:
    return np.concatenate([np.asarray(array, np.float64).ravel() for array in arrays])


_Places = list[tuple["slice[int, int, int]", tuple[int, ...]]]


@lru_cache(maxsize=8)
def _places(views: int) -> tuple[_Places, _Places]:
    """Return where the arrays of figures and of sums lie in a packed record, and their shapes."""
    half = (len(_LOWER[0]),)
    figures = ((2, 4, 4), (2, 3), (2, views), (2,), (2, views), (2, views), (2, 3), (1,))
    sums = [(2, views, *shape) for shape in (half, *_SUM_SHAPES[1:])]
    return _in_a_row(figures), _in_a_row((*sums, *sums, (2, *half), (2, *half)))


def _in_a_row(shapes: Iterable[tuple[int, ...]]) -> _Places:
    out, end = [], 0
    for shape in shapes:
        start, end = end, end + math.prod(shape)
        out.append((slice(start, end, 1), shape))
    return out


def _split(flat: Array, places: _Places) -> list[Array]:
    return [flat[part].reshape(shape) for part, shape in places]
