"""Results of single frames, reasons for lost arches, and a compact store for the frames of a whole take."""

from __future__ import annotations

import math
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import OutputError
from jawusd.formats.tracks import LOST, LostReason
from jawusd.tracking.contour.equations import OutlineSums, Solution
from jawusd.tracking.contour.quality import residual_px, score_px


class Loss(NamedTuple):
    """The check that an arch failed, with the measured value and its limit, both in the unit of the `LostReason`."""

    reason: LostReason
    value: float
    limit: float


#: Entry for an arch that is not lost, or for whose loss no reason was recorded.
NO_LOSS = Loss(LostReason.NONE, np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """The result of one frame."""

    solution: Solution  # the alignment; poses of lost arches are invalid
    status: NDArray[np.int8]  # status of both arches, as in `Tracks`, shape (2,)
    used: Mask  # whether each mask was used, shape (2, C)
    coverage: Array  # uncovered fraction of every mask, shape (2, C); NaN without a mask
    losses: tuple[Loss, Loss] = (NO_LOSS, NO_LOSS)  # reasons why arches are lost

    @property
    def found(self) -> Mask:
        """Whether each arch was found, shape (2,)."""
        return np.asarray(self.status != LOST)

    @property
    def uncertain(self) -> bool:
        """Whether less of the contour fits than usual: never, since such arches are lost."""
        return False


def whole_frames(records: Mapping[int, FrameRecord]) -> list[int]:
    """Return the numbers of the frames in which both arches are tracked, in ascending order."""
    return [frame for frame in sorted(records) if records[frame].found.all()]


@dataclass(frozen=True, eq=False)
class FrameSummary:
    """The part of a frame's result that later frames need."""

    poses: Array  # T_world_upper and T_world_lower, shape (2, 4, 4)
    status: NDArray[np.int8]  # this and the next two fields: as in `FrameRecord`
    used: Mask
    coverage: Array
    score_px: Array  # length of matched contour per arch and view [px], shape (2, C)
    residual_px: Array  # standard deviation of the residuals per arch, shape (2,)

    @classmethod
    def of(cls, record: FrameRecord) -> FrameSummary:
        """Return the summary of a record."""
        solution = record.solution
        seen = (record.status, record.used, record.coverage)
        return cls(solution.poses, *seen, score_px(solution), residual_px(solution))


_KEPT_FRAMES = 32
_IN_MEMORY = 16 << 20  # bytes held in memory before a file is used: enough for one or two minutes of footage
# Shapes of the sums per arch and view; the first is a symmetric 6 x 6 matrix.
_SUM_SHAPES = tuple(table.shape[2:] for table in OutlineSums.zeros(1))
_LOWER = np.tril_indices(6)
_MIRROR = np.empty((6, 6), np.int64)  # index of every entry of the full matrix in the lower triangle
_MIRROR[_LOWER] = _MIRROR[_LOWER[::-1]] = np.arange(len(_LOWER[0]))


class PackedRecords(MutableMapping[int, FrameRecord]):
    """A mapping of frames to records, which are packed into a temporary file so that long takes need little memory.

    Only sums over samples are stored in single precision, which suffices for thousands of distances accurate to
    0.01 px. Not thread-safe.
    """

    def __init__(self) -> None:
        self._store = _Store()
        self._places: dict[int, int] = {}
        self._unpacked: dict[int, FrameRecord] = {}  # cache of recently used records: mostly neighbouring frames

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
        return frame in self._places  # the inherited `__contains__` would unpack the record

    def __iter__(self) -> Iterator[int]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def kept(self, frames: Iterable[int]) -> PackedRecords:
        """Return a mapping with some of the frames that shares the storage of their records."""
        out = PackedRecords()
        out._store = self._store
        out._places = {frame: self._places[frame] for frame in frames}
        return out


class _Store:
    """An append-only file of packed records; replaced records remain in it, since other mappings may refer to them."""

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115  # open as long as this object exists
        self._end = 0
        weakref.finalize(self, self._file.close)

    def add(self, figures: Array, sums: NDArray[np.float32]) -> int:
        """Append a record; return its offset. Raises OutputError if the temporary folder is full."""
        place = self._end
        try:
            self._file.seek(place)
            for part in (np.array([len(figures), len(sums)], np.int64), figures, sums):
                self._end += self._file.write(part.tobytes())
        except OSError as error:
            raise OutputError(
                f"cannot write the temporary file of a long take: {error.strerror}.",
                path=tempfile.gettempdir(),
                hint="Free disk space, or set TMPDIR to another folder.",
            ) from error
        return place

    def read(self, place: int) -> tuple[Array, NDArray[np.float32]]:
        """Return the record at an offset."""
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
        [(float(loss.reason), loss.value, loss.limit) for loss in losses],
    )  # fmt: skip
    sums = [solution.outline.precision[..., _LOWER[0], _LOWER[1]], *solution.outline[1:]]
    sums += [matrix[:, _LOWER[0], _LOWER[1]] for matrix in (solution.scatters, solution.gum_scatters)]
    return _joined(figures), _joined(sums).astype(np.float32)


def _unpacked(figures: Array, sums: NDArray[np.float32]) -> FrameRecord:
    # Poses, centres, status and losses have fixed sizes; the other three arrays have one entry per arch and view.
    views = (len(figures) - 2 * 16 - 2 * 3 - 2 - 2 * 3) // (2 * 3)
    shapes = ((2, 4, 4), (2, 3), (2, views), (2,), (2, views), (2, views), (2, 3))
    poses, centres, visible, status, used, coverage, losses = _split(figures, shapes)
    half = (len(_LOWER[0]),)
    of_views = [(2, views, *shape) for shape in (half, *_SUM_SHAPES[1:])]
    precision, *others, scatters, gum_scatters = _split(sums.astype(np.float64), (*of_views, (2, *half), (2, *half)))
    outline = OutlineSums(precision[..., _MIRROR], *others)
    scatters, gum_scatters = (matrix[:, _MIRROR] for matrix in (scatters, gum_scatters))
    solution = Solution(poses, outline, centres, scatters, gum_scatters, visible)
    first, second = (Loss(LostReason(int(reason)), float(value), float(limit)) for reason, value, limit in losses)
    return FrameRecord(solution, status.astype(np.int8), used.astype(bool), coverage, (first, second))


def _joined(arrays: Iterable[ArrayLike]) -> Array:
    return np.concatenate([np.asarray(array, np.float64).ravel() for array in arrays])


def _split(flat: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Return the successive parts of a flat array, in the given shapes."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)]
