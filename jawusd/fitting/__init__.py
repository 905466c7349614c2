"""Fit jaw models to captured poses: decoder, bounds, error tables, and checks of the data.

The inputs are poses, not images, as `formats.tracks.Tracks` or arrays.
"""

from jawusd.fitting.fit import FittingConfig, fit_model

__all__ = ["FittingConfig", "fit_model"]
