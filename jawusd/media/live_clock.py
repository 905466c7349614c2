"""The clock of live pictures: that of the machine, unless a test puts another in its place."""

from __future__ import annotations

import threading
import time


def now_s() -> float:
    """Return the time [s], from any beginning."""
    return time.monotonic()


def wait_until(time_s: float, stopped: threading.Event) -> bool:
    """Wait for a time [s]; return whether it was stopped before."""
    return stopped.wait(max(0.0, time_s - time.monotonic()))
