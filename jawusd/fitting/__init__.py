"""Fit jaw models to captured poses: the model, its bounds, its errors and what the capture lacks."""

from jawusd.fitting.config import FittingConfig
from jawusd.fitting.fit import fit_model

__all__ = ["FittingConfig", "fit_model"]
