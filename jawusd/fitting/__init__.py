"""Jaw models fitted to captured poses: decoder, bounds, error tables, and checks of the data.

The input is poses, not images: `formats.tracks.Tracks` or arrays. This package must not import another stage (capture,
tracking, paper, rig, ...); `pipeline` and `paper` import it.
"""

from jawusd.fitting.fit import FittingConfig, fit_model

__all__ = ["FittingConfig", "fit_model"]
