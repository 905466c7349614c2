"""Send what is followed live as Open Sound Control messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jawusd.base.errors import OutputError, explain_missing_packages

if TYPE_CHECKING:
    from jawusd.pipeline.live import LiveFrame


class OscSender:
    """Send a bundle per instant over UDP.

    /jaw/d and /jaw/sigma carry three floats [mm], /jaw/margin one [mm], /jaw/time one [s], and /jaw/state 1 for solved
    or 2 for carried, as `SolveState`.
    """

    @explain_missing_packages()
    def __init__(self, address: str) -> None:
        """Take HOST:PORT.

        Raises:
            OutputError: the address has no port, or no such host is known.
            MissingDependencyError: python-osc is not installed.
        """
        from pythonosc.udp_client import UDPClient

        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise OutputError(f"{address!r} is no address.", hint="Give HOST:PORT, for example 127.0.0.1:9000.")
        try:
            self._client = UDPClient(host.strip("[]"), int(port))
        except OSError as error:
            raise OutputError(f"{host!r} is no host that is known here ({error}).") from error

    def close(self) -> None:
        """Close the socket."""
        self._client.close()

    @explain_missing_packages()
    def send(self, frame: LiveFrame) -> None:
        """Send an instant; nobody need listen."""
        from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
        from pythonosc.osc_message_builder import OscMessageBuilder

        from jawusd.formats.performance import SolveState

        bundle = OscBundleBuilder(IMMEDIATELY)
        values: dict[str, list[float] | list[int]] = {
            "d": frame.d.tolist(),
            "sigma": frame.sigma.tolist(),
            "margin": [frame.margin_mm],
            "state": [int(SolveState[frame.state.upper()])],
            "time": [frame.time_s],
        }
        for name, numbers in values.items():
            message = OscMessageBuilder(f"/jaw/{name}")
            for number in numbers:
                message.add_arg(number)
            bundle.add_content(message.build())
        try:
            self._client.send(bundle.build())
        except OSError:  # a receiver that closed its port answers so; the next one may listen again
            return
