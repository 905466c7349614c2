"""What a person may choose about a fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

Method = Literal["anchored", "additive", "paper", "pca"]


@dataclass(frozen=True)
class FittingConfig:
    """Choose the model and how it is checked.

    Attributes:
        method: the model, see the table in the documentation.
        literal: with method "paper", keep the paper's fixed grouping of components.
        holdout_folds: contiguous parts of the take that are left out in turn to measure the error on unseen poses;
            0 to skip.
        trim_mad: frames farther from the model than the median by this many normalised median absolute deviations
            count as tracking failures and are left out.
        alpha: largest circumradius of the triangles of the paper's alpha shapes, range-normalised units.
        starts: random starts of the networks of method "paper"; the best is kept.
        seed: of the first start.
    """

    method: Method = "anchored"
    literal: bool = False
    holdout_folds: int = 5
    trim_mad: float = 4.5
    alpha: float = 0.23
    starts: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if self.method not in get_args(Method):
            raise ValueError(f"method must be one of {', '.join(get_args(Method))}, got {self.method!r}")
        if self.holdout_folds == 1 or self.holdout_folds < 0:
            raise ValueError(f"holdout_folds must be 0 or at least 2, got {self.holdout_folds}")
        if min(self.trim_mad, self.alpha) <= 0:
            raise ValueError(f"trim_mad and alpha must be positive, got {self.trim_mad} and {self.alpha}")
        if self.starts < 1:
            raise ValueError(f"starts must be at least 1, got {self.starts}")
