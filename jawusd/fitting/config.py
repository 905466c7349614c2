"""What a person may choose about a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Method = Literal["anchored"]


@dataclass(frozen=True)
class FittingConfig:
    """Choose the model and how it is checked.

    Attributes:
        method: the model, see the table in the documentation.
        holdout_folds: contiguous parts of the take that are left out in turn to measure the error on unseen poses;
            0 to skip.
        trim_mad: frames farther from the model than the median by this many normalised median absolute deviations
            count as tracking failures and are left out.
        alpha: largest circumradius of the triangles of the paper's alpha shapes, range-normalised units.
    """

    method: Method = "anchored"
    holdout_folds: int = 5
    trim_mad: float = 4.5
    alpha: float = 0.23

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}, got {self.method!r}")
        if self.holdout_folds == 1 or self.holdout_folds < 0:
            raise ValueError(f"holdout_folds must be 0 or at least 2, got {self.holdout_folds}")
        if min(self.trim_mad, self.alpha) <= 0:
            raise ValueError("trim_mad and alpha must be positive")
