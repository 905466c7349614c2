"""Read and write the fitted jaw model: `model.npz`, format jawusd-model/2.

The decoder arrays (`JawModel.arrays`) have the names of the evaluator, which validates them on construction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from numpy.typing import NDArray

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath
from jawusd.base.npz import read_npz, take, upgraded_model
from jawusd.formats.atomic import write_described_npz
from jawusd.formats.notes import ErrorTable, ModelMeta, check_notes

FAMILY, VERSION = "jawusd-model", 2
_CAPTURED = ("captured_frames", "captured_d", "captured_residual_mm", "captured_trained")


def error_table(errors: Mapping[str, Array]) -> ErrorTable:
    """Return mean, median, p95, max [mm] and count of errors (n,) [mm] by name; empty columns are omitted."""
    return {
        name: {
            "mean": float(values.mean()),
            "median": float(np.median(values)),
            "p95": float(np.percentile(values, 95)),
            "max": float(values.max()),
            "frames": len(values),
        }
        for name, values in errors.items()
        if len(values)
    }


@dataclass(eq=False)
class JawModel:
    """Fitted model, and the jaw parameters of the captured poses."""

    arrays: dict[str, Array]  # arrays of the decoder by name; see `jawusd.evaluator`
    frames: NDArray[np.int64]  # captured frame numbers, shape (F,)
    d: Array  # jaw parameters of the captured poses [mm], NaN for lost frames, shape (F, 3)
    residual_mm: Array  # rms landmark distance between pose and model [mm], NaN for lost frames, shape (F,)
    trained: Mask  # whether each frame was used to fit the model, shape (F,)
    # kind, method, actor, error tables, warnings, configuration, versions, hashes
    meta: dict[str, object] = field(default_factory=dict)

    @property
    def notes(self) -> ModelMeta:
        """Values of `meta` that have a schema."""
        return cast(ModelMeta, self.meta)


def save_model(path: AnyPath, model: JawModel) -> None:
    """Write a model atomically.

    Raises:
        OutputError: the file cannot be written.
        ValueError: the captured arrays differ in length.
    """
    count = len(model.frames)
    captured = dict(zip(_CAPTURED, (model.frames, model.d, model.residual_mm, model.trained), strict=True))
    for name, value in captured.items():
        if len(value) != count:
            raise ValueError(f"{name} has {len(value)} rows, expected {count}")
    write_described_npz(path, f"{FAMILY}/{VERSION}", {**model.arrays, **captured}, model.meta)


def load_model(path: AnyPath) -> JawModel:
    """Read a model.

    Raises:
        FormatError: the file is not a model file, or arrays or header values have the wrong shape or type.
        VersionError: the file was written by a newer version.
        UnitsError: the file uses other units or another twist order.
    """
    arrays, meta = read_npz(path, FAMILY, VERSION)
    check_notes(meta, ModelMeta, path)
    arrays = upgraded_model(arrays, path)
    frames = take(arrays, "captured_frames", (None,), path)
    count = len(frames)
    shapes = {"captured_d": (count, 3), "captured_residual_mm": (count,), "captured_trained": (count,)}
    captured = {name: take(arrays, name, shape, path, finite=False) for name, shape in shapes.items()}
    decoder = {name: value for name, value in arrays.items() if name not in _CAPTURED}
    return JawModel(
        arrays=decoder,
        frames=frames.astype(np.int64),
        d=captured["captured_d"],
        residual_mm=captured["captured_residual_mm"],
        trained=captured["captured_trained"].astype(bool),
        meta=meta,
    )
