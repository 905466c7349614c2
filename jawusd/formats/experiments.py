"""Results of the paper's experiments on one take, for figures and a table in CSV with the columns `TABLE_COLUMNS`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.base.arrays import Array

TABLE_COLUMNS = ("experiment", "model", "quantity", "count", "mean_mm", "median_mm", "p95_mm", "max_mm")


@dataclass(frozen=True, eq=False)
class Distances:
    """Named set of distances measured in one experiment."""

    experiment: str  # "condyle path", "reconstruction" or "synthesis" (figs. 5, 12 and 13 of the paper)
    model: str
    quantity: str  # description of what was measured
    values_mm: Array  # distances [mm], one per pose or per point of a path, shape (N,)

    def row(self) -> dict[str, str | int | float]:
        """Return statistics of the distances as one row of the table, with the keys `TABLE_COLUMNS`."""
        v = self.values_mm
        figures = (len(v), v.mean(), np.median(v), np.percentile(v, 95), v.max()) if len(v) else (0, *[np.nan] * 4)
        count, *rest = figures
        labels = (self.experiment, self.model, self.quantity)
        return dict(zip(TABLE_COLUMNS, (*labels, int(count), *map(float, rest)), strict=True))


@dataclass(frozen=True, eq=False)
class CondylePath:
    """Opening movement of one model at the condyles, in the anatomical frame."""

    model: str
    opening_mm: Array  # vertical mouth openings at the incisal point [mm], shape (K,)
    points: Array  # centres of the left and right condyle [mm], shape (2, K, 3)
    # Outlines of the left condyle at some mouth openings, in the sagittal plane through its centre: segments (z, y)
    # [mm], each of shape (S, 2, 2); empty without a mandible mesh
    heads: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class ParameterPath:
    """Path of the left condyle when only one parameter of a model varies, in the anatomical frame."""

    model: str
    parameter: int  # index of the varied parameter: 0 opening, 1 laterotrusion, 2 protrusion
    values_mm: Array  # values of the varied parameter [mm], shape (K,)
    points: Array  # centres of the left condyle [mm], shape (K, 3)


@dataclass(frozen=True, eq=False)
class Coverage:
    """Captured part of the envelope of motion, in the parameters d of the default model."""

    d: Array  # parameters of the captured poses [mm], shape (N, 3)
    # boundary rings of the paper's bound in (d1, d2) and (d1, d3) [mm], each of shape (n, 2)
    outlines: tuple[tuple[Array, ...], tuple[Array, ...]]
    slices_d1: Array  # mouth openings d1 [mm], shape (K,)
    # lowest and highest valid d2 and d3 [mm] of the slice hull on the habitual path, shape (2, K, 2)
    slices: Array
    # points (d1, d2) and (d1, d3) [mm] inside the slice hull but far from all captured poses, each (G, 2)
    gaps: tuple[Array, Array]
    sentences: tuple[str, ...]  # descriptions of movements to record next


@dataclass(frozen=True, eq=False)
class Experiments:
    """Results of all experiments of the paper on one take."""

    actor: str
    frames: int  # number of captured poses used in the experiments
    # centres of the left and right condyle in all captured poses, anatomical frame [mm], shape (2, N, 3)
    captured_condyles: Array
    skull: Array  # outline of the skull near the left condyle: segments (z, y) [mm], shape (S, 2, 2)
    condyle_paths: tuple[CondylePath, ...]  # opening movements, one per model
    distances: tuple[Distances, ...]  # all sets of distances, in the order of the table
    coverage: Coverage  # captured part of the envelope of motion
    # remarks: numbers of frames excluded by each model, models that could not be fitted, experiments not requested
    notes: tuple[str, ...]
    # Condyle paths of the linear and the default model, for each parameter.
    parameter_paths: tuple[ParameterPath, ...] = ()

    def of(self, experiment: str) -> list[Distances]:
        """Return the sets of distances of one experiment."""
        return [found for found in self.distances if found.experiment == experiment]

    def table(self) -> list[dict[str, str | int | float]]:
        """Return the rows of the table as dictionaries with the keys `TABLE_COLUMNS`."""
        return [found.row() for found in self.distances]
