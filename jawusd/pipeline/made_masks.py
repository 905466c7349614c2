"""Masks that jawusd made: how to tell them, and what the tracker allows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jawusd.formats.capture import Capture

if TYPE_CHECKING:
    from jawusd.tracking.config import TrackingConfig

#: What `jawusd segment` leaves beside its masks, which lie there as CAMERA/upper/000123.png.
SUMMARY = "segment.json"


def are_made(capture: Capture) -> bool:
    """Tell whether the masks of a capture lie where `jawusd segment` wrote them."""
    rows = [row for camera in capture.cameras if camera.masks for row in (camera.masks.upper, camera.masks.lower)]
    return bool(rows) and all(len(row.parents) > 2 and (row.parents[2] / SUMMARY).is_file() for row in rows)


def tracking_config(capture: Capture) -> TrackingConfig:
    """Return the tracker's numbers for the masks of a capture."""
    from jawusd.tracking.config import FOR_MADE_MASKS, TrackingConfig

    return FOR_MADE_MASKS if are_made(capture) else TrackingConfig()
