"""The address of a viewer, and its page while viser is imported; this module imports neither viser nor numpy."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import select
import socket
import socketserver
import threading
from importlib.util import find_spec
from pathlib import Path

from jawusd.base.errors import OutputError

_PAGE = Path("client", "build", "index.html")  # the whole page of viser, within the package
_HEADER_BYTES, _PATIENCE_S = 16_384, 5.0
_POLL_S = 0.01  # how long `release` may wait for the thread that accepts connections
_PORTS = 1000  # number of ports tried


class FirstPage:
    """Serve viser's page at an address until viser listens there, so that a browser can load it early.

    The page's own connection to viser is held until `close`; the page then connects again at once.
    """

    def __init__(self, host: str, port: int) -> None:
        """Start serving on a port: 0 selects any free port; instead of a port in use, the next free one is taken.

        Raises ModuleNotFoundError without viser, and OutputError for a foreign address or without a free port.
        """
        found = find_spec("viser")
        if found is None or found.origin is None:
            raise ModuleNotFoundError("No module named 'viser'", name="viser")
        page = (Path(found.origin).parent / _PAGE).read_bytes()
        head = f"HTTP/1.1 200 OK\r\nContent-Type: text/html; charset=utf-8\r\nContent-Length: {len(page)}\r\n"
        self._server = _listen(host, port)
        self._server.answer = head.encode() + b"Connection: close\r\n\r\n" + page
        self._thread = threading.Thread(target=self._server.serve_forever, args=(_POLL_S,), daemon=True)
        self._thread.start()
        self.port = int(self._server.server_address[1])
        self.url = url_of(host, self.port)

    def release(self) -> int:
        """Answer what has connected, stop listening, and return the port for viser."""
        self._server.shutdown()
        for _ in range(self._server.request_queue_size):  # closing resets connections that are not yet accepted
            if not select.select([self._server], [], [], 0)[0]:
                break
            self._server.handle_request()
        self._server.server_close()
        return self.port

    def close(self) -> None:
        """Close the connections that were held; call this once viser listens."""
        self._server.released.set()


class _Server(socketserver.ThreadingTCPServer):
    """Answer every request with the page."""

    daemon_threads = True
    allow_reuse_address = os.name == "posix"  # on Windows, another program could then take the port
    request_queue_size = 128  # number of connections that wait to be accepted
    answer = b""

    def __init__(self, family: socket.AddressFamily, address: tuple[str, int]) -> None:
        self.address_family = family
        self.released = threading.Event()
        super().__init__(address, _Handler)


class _Handler(socketserver.BaseRequestHandler):
    server: _Server

    def handle(self) -> None:
        """Send the page, or hold a request for a WebSocket."""
        self.request.settimeout(_PATIENCE_S)
        asked = b""
        with contextlib.suppress(OSError):  # browsers also open connections that they do not use
            while b"\r\n\r\n" not in asked and len(asked) < _HEADER_BYTES:
                part = self.request.recv(_HEADER_BYTES)
                if not part:
                    return
                asked += part
            if b"\r\nupgrade: websocket" in asked.lower():
                self.server.released.wait()
            else:
                self.request.sendall(self.server.answer)


def _listen(host: str, port: int) -> _Server:
    """Return a server on a port, or on the next free one."""
    family = check_address(host)
    for tried in range(port, min(port + _PORTS, 65536)):
        try:
            return _Server(family, (host, tried))
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
    raise OutputError(f"no port from {port} on is free.", hint="Choose another one with --port.")


def check_address(host: str) -> socket.AddressFamily:
    """Return the family of an address after checking that it can be bound; viser would try ports forever.

    Raises OutputError if the address cannot be bound.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError as error:
        raise OutputError(
            f"cannot listen on {host}: {error.strerror}.",
            hint="Use the default, 127.0.0.1, to serve browsers on this machine.",
        ) from error
    return family


def url_of(host: str, port: int) -> str:
    """Return the URL of a page, for display."""
    return f"http://{'localhost' if is_loopback(host) else host}:{port}"


def is_loopback(host: str) -> bool:
    """Return whether an address is reachable only from this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
