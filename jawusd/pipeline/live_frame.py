"""The result of one live frame, and its transmission over OSC."""

from __future__ import annotations

from dataclasses import dataclass

from jawusd.base.arrays import Array
from jawusd.base.errors import OutputError, explain_missing_packages
from jawusd.formats.performance import SolveState


@dataclass(frozen=True, eq=False)
class LiveJaw:
    """The jaw in one frame.

    Attributes:
        d: jaw parameters [mm], shape (3,).
        covariance: their covariance [mm^2], shape (3, 3).
        state: solved, skin or carried.
        familiar: as in `LiveFrame`.
    """

    d: Array
    covariance: Array
    state: SolveState
    familiar: bool | None = None


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """Result of one frame, which consists of the images of all sources at one time.

    Attributes:
        time_s: capture time of the images [s] since the start of the sources; for files, since their first images.
        d, sigma: jaw parameters and their standard deviations [mm], shape (3,).
        margin_mm: signed distance to the rig's bound [mm], positive inside.
        verdict: the rig's verdict on the pose.
        state: name of the `SolveState`: solved, skin or carried.
        latency_ms: time from the capture of the images to this result [ms].
        dropped: number of frames dropped since the last result.
        familiar: whether the face resembles those from which the map was learned; None without skin, or if the face
            tracker has no row near this time.
    """

    time_s: float
    d: Array
    sigma: Array
    margin_mm: float
    verdict: str
    state: str
    latency_ms: float
    dropped: int
    familiar: bool | None = None

    def as_json(self) -> dict[str, object]:
        """Return the result as JSON-serialisable values, rounded to significant digits."""
        return {
            "time_s": round(self.time_s, 4),
            "d": [round(value, 3) for value in self.d.tolist()],
            "sigma": [round(value, 3) for value in self.sigma.tolist()],
            "margin_mm": round(self.margin_mm, 3),
            "verdict": self.verdict,
            "state": self.state,
            "latency_ms": round(self.latency_ms, 1),
            "dropped": self.dropped,
            "familiar": self.familiar,
        }


class OscSender:
    """Sends one OSC bundle per frame over UDP.

    Arguments: /jaw/d and /jaw/sigma have three floats [mm], /jaw/margin one [mm], /jaw/time one [s]. /jaw/state has the
    integer 1 for solved, 2 for carried or 3 for skin, as in `SolveState`. /jaw/familiar, sent only if `familiar` is
    known, has 1 or 0.
    """

    @explain_missing_packages()
    def __init__(self, address: str) -> None:
        """Open a socket for HOST:PORT.

        Raises:
            OutputError: the address has no port, or the host is unknown.
            MissingDependencyError: python-osc is not installed.
        """
        from pythonosc.udp_client import UDPClient

        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise OutputError(f"{address!r} is not an address.", hint="Give HOST:PORT, for example 127.0.0.1:9000.")
        try:
            self._client = UDPClient(host.strip("[]"), int(port))
        except OSError as error:
            raise OutputError(f"unknown host {host!r} ({error}).") from error

    def close(self) -> None:
        """Close the socket."""
        self._client.close()

    @explain_missing_packages()
    def send(self, frame: LiveFrame) -> None:
        """Send one result; it is not an error if nothing receives it."""
        from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
        from pythonosc.osc_message_builder import OscMessageBuilder

        bundle = OscBundleBuilder(IMMEDIATELY)
        values: dict[str, list[float] | list[int]] = {
            "d": frame.d.tolist(),
            "sigma": frame.sigma.tolist(),
            "margin": [frame.margin_mm],
            "state": [int(SolveState[frame.state.upper()])],
            "time": [frame.time_s],
        }
        if frame.familiar is not None:
            values["familiar"] = [int(frame.familiar)]
        for name, numbers in values.items():
            message = OscMessageBuilder(f"/jaw/{name}")
            for number in numbers:
                message.add_arg(number)
            bundle.add_content(message.build())
        try:
            self._client.send(bundle.build())
        except OSError:  # the receiver has closed its port and may open it again
            return
