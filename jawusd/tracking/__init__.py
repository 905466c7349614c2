"""Track the poses of both dental arches from masks or images of several cameras.

Each part imports only earlier ones in this order: `follow`; `contour`; `initialization`; `sequence` and `performance`;
`region`.
"""

from jawusd.tracking.config import TrackingConfig
from jawusd.tracking.sequence.take import track_capture

__all__ = ["TrackingConfig", "track_capture"]
