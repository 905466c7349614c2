"""Fit jaw models to captured poses: the model, its bounds, its errors and the movements it lacks."""

from jawusd.fitting.fit import FittingConfig, fit_model

__all__ = ["FittingConfig", "fit_model"]
