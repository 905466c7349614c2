"""Poses of both arches from masks in several views."""

from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.sequence.take import track_capture

__all__ = ["TrackingConfig", "track_capture"]
