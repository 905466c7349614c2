"""Jaw models fitted to captured poses: decoder, bounds, error tables, and checks of the data.

Independent of images: poses come as `formats.tracks.Tracks` or as arrays. Must not import another stage (capture,
tracking, paper, rig, ...); `pipeline` and `paper` import it.
"""

from jawusd.fitting.fit import FittingConfig, fit_model

__all__ = ["FittingConfig", "fit_model"]
