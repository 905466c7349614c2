"""Masks that jawusd made: how to tell them, and what the tracker allows them."""

from __future__ import annotations

from typing import Any

from jawusd.formats.capture import Capture
from jawusd.pipeline.extras import stage

#: What `jawusd segment` leaves beside its masks, which lie there as CAMERA/upper/000123.png.
SUMMARY = "segment.json"


def are_made(capture: Capture) -> bool:
    """Tell whether the masks of a capture lie where `jawusd segment` wrote them."""
    rows = [row for camera in capture.cameras if camera.masks for row in (camera.masks.upper, camera.masks.lower)]
    return bool(rows) and all(len(row.parents) > 2 and (row.parents[2] / SUMMARY).is_file() for row in rows)


def tracking_config(capture: Capture) -> Any:
    """Return the tracker's numbers for the masks of a capture, a `TrackingConfig`."""
    config = stage("jawusd.tracking.config")
    return config.FOR_MADE_MASKS if are_made(capture) else config.TrackingConfig()
