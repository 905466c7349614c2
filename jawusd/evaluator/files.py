"""Read a rig from ``model.npz``, format jawusd-model/2, with numpy alone."""

from __future__ import annotations

import os

from jawusd.base.errors import EvaluatorError, FormatError
from jawusd.base.npz import read_npz, upgraded_model
from jawusd.evaluator.rig import JawRig

FAMILY, VERSION = "jawusd-model", 2


def load(path: str | os.PathLike[str]) -> JawRig:
    """Read a rig from a ``model.npz`` as `jawusd fit` writes it.

    Raises:
        FormatError: not such a file, damaged, or arrays missing, of wrong shape or not finite.
        VersionError: written by a newer jawusd.
        UnitsError: lengths, angles or twists in another convention.
    """
    arrays, meta = read_npz(path, FAMILY, VERSION)
    arrays = upgraded_model(arrays, path)
    try:
        return JawRig(arrays, meta)
    except EvaluatorError as error:
        raise FormatError(error.message, path=path, hint="Fit the model again, or get an undamaged copy.") from error
