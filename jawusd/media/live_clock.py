"""Clock for live images; tests replace it."""

from __future__ import annotations

import threading
import time


def now_s() -> float:
    """Return the time [s] since an arbitrary origin."""
    return time.monotonic()


def wait_until(time_s: float, stopped: threading.Event) -> bool:
    """Wait until a time [s]; return whether `stopped` was set before then."""
    return stopped.wait(max(0.0, time_s - time.monotonic()))
