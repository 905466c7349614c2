"""What every fitting method returns: a decoder and which frames it was fitted to."""

from __future__ import annotations

from dataclasses import dataclass

from jawusd.base.arrays import Mask
from jawusd.evaluator.models import JawModelForm


@dataclass(frozen=True, eq=False)
class FittedForm:
    """Hold a fitted decoder."""

    model: JawModelForm
    kept: Mask  # training frames that were not trimmed, shape (N,)
    notes: dict[str, object]  # JSON-able facts about the fit, for the header
