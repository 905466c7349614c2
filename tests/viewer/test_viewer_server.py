"""Access to the server: addresses, foreign pages, and a warning for public addresses."""

import contextlib
import logging
import signal
import socket
import subprocess
import sys
import time
import types
import urllib.error
import urllib.request

import pytest
from run_jawusd import heed_signals

from jawusd.base.errors import FormatError, OutputError
from jawusd.pipeline.view import open_viewer, viewed_actor
from jawusd.viewer.address import FirstPage, is_loopback
from jawusd.viewer.server import Viewer, is_own_page, wait_until_drawn


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("[::1]", True), ("127.9.9.9", True), ("0.0.0.0", False),
     ("192.168.1.4", False), ("example.com", False), ("", False)],
)  # fmt: skip
def test_which_addresses_are_this_machine_alone(host, local):
    assert is_loopback(host) is local


@pytest.mark.parametrize(
    ("host", "origin", "local", "own"),
    [
        ("localhost:8080", "http://localhost:8080", True, True),
        ("127.0.0.1:8080", "http://127.0.0.1:8080", True, True),
        ("localhost:8080", None, True, True),  # no browser
        ("localhost:8080", "https://evil.example", True, False),
        ("localhost:8080", "http://localhost:9999", True, False),
        ("localhost:8080", "null", True, False),
        ("evil.example:8080", "http://evil.example:8080", True, False),  # DNS rebinding
        ("studio.local:8080", "http://studio.local:8080", False, True),
        ("studio.local:8080", "http://evil.example", False, False),
        ("", None, True, False),
    ],
)
def test_pages_of_other_sites_are_not_served(host, origin, local, own):
    assert is_own_page(host, origin, local=local) is own


def test_an_address_of_another_machine_is_refused(folder):
    with pytest.raises(OutputError, match="cannot listen on 192.0.2.1"):
        open_viewer(folder, "192.0.2.1", 0)


def asked(page, request):
    """Return a connection to a page with a request sent."""
    connection = socket.create_connection(("127.0.0.1", page.port), timeout=60)
    connection.sendall(f"{request}\r\nHost: localhost\r\n".encode())
    connection.sendall(b"\r\n")
    return connection


def test_the_page_is_served_before_viser_is_imported_and_the_rig_read(folder):
    first = FirstPage("127.0.0.1", 0)
    with urllib.request.urlopen(first.url, timeout=60) as page:
        early = page.read()
    held = asked(first, "GET / HTTP/1.1\r\nUpgrade: websocket")
    told = []

    def load():
        assert held.recv(1) == b""  # closed once viser listens
        with urllib.request.urlopen(first.url, timeout=60) as page:
            told.append(page.read())
        return viewed_actor(folder)

    viewer = Viewer(load, "127.0.0.1", 0, first=first)
    viewer.stop()
    held.close()
    assert told == [early] and b"Viser" in early and viewer.url == first.url


def test_connections_made_just_before_viser_takes_over_are_answered():
    for _ in range(20):
        first = FirstPage("127.0.0.1", 0)
        pages = [asked(first, "GET / HTTP/1.1") for _ in range(5)]
        first.release()
        for page in pages:
            assert page.recv(12) == b"HTTP/1.1 200"
            page.close()
        first.close()


def test_nothing_is_served_after_a_rig_that_cannot_be_read(folder):
    (folder / "actor.usda").write_text("#usda 1.0\n")
    first = FirstPage("127.0.0.1", 0)
    with pytest.raises(FormatError):
        open_viewer(folder, "127.0.0.1", 0, first=first)
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(first.url, timeout=60)


def test_the_first_page_takes_the_next_free_port_and_idle_connections_do_not_block_it():
    first = FirstPage("127.0.0.1", 0)
    idle = socket.create_connection(("127.0.0.1", first.port), timeout=60)
    second = FirstPage("127.0.0.1", first.port)
    assert second.port > first.port
    for page in (first, second):
        with urllib.request.urlopen(page.url, timeout=60) as answer:
            assert answer.status == 200
        page.release()
        page.close()
    idle.close()
    with pytest.raises(OutputError, match="cannot listen on 192.0.2.1"):
        FirstPage("192.0.2.1", 0)


def test_a_port_that_another_program_takes_in_between_is_named(folder, caplog):
    class Robbed(FirstPage):
        def release(self):
            port = super().release()
            self.thief = socket.create_server(("127.0.0.1", port))
            return port

    first = Robbed("127.0.0.1", 0)
    viewer = open_viewer(folder, "127.0.0.1", 0, play=False, first=first)
    viewer.stop()
    first.thief.close()
    (warning,) = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert viewer.url in warning and viewer.url != first.url


def test_without_viser_no_address_is_printed(monkeypatch):
    monkeypatch.setattr("jawusd.viewer.address.find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match="viser"):
        FirstPage("127.0.0.1", 0)


def test_panels_wait_for_the_drawn_jaw_but_not_forever():
    class Storage:
        def __init__(self, error):
            self.error, self.asked = error, 0

        def get_item(self, key, timeout):
            self.asked += 1
            if self.error is not None:
                raise self.error

    for error, asked in ((None, 4), (TimeoutError(), 1), (RuntimeError("closed"), 1)):
        storage = Storage(error)
        wait_until_drawn(types.SimpleNamespace(local_storage=storage))
        assert storage.asked == asked


def run_view(folder, *options):
    """Run `jawusd view`, without a rig if folder is None, until it prints its address.

    Returns stdout's first line and the rest of it, stderr, and the exit code.
    """
    named = [] if folder is None else [str(folder)]
    command = [sys.executable, "-m", "jawusd", "view", *named, "--no-browser", "--port", "0", *options]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed_signals
    )
    try:
        line = process.stdout.readline()
    finally:
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=60)
    return line, rest, errors, process.returncode


def test_the_command_says_where_to_look_and_stops_quietly(folder):
    line, rest, errors, code = run_view(folder)
    assert line.startswith("http://localhost:") and rest == "" and code == 0
    assert "warning" not in errors and "Traceback" not in errors


def test_without_a_rig_the_example_is_shown():
    line, rest, errors, code = run_view(None)
    assert line.startswith("http://localhost:") and rest == "" and code == 0
    assert "warning" not in errors and "Traceback" not in errors


def test_listening_to_the_world_is_warned_about(folder):
    line, _, errors, code = run_view(folder, "--host", "0.0.0.0")
    assert line.startswith("http://0.0.0.0:") and code == 0
    assert "warning: listening on 0.0.0.0" in errors


@pytest.mark.parametrize(
    "message",
    [
        b"garbage",
        "text",
        b"",
        b"\x81\xa4type\xa4Nope",
        b"\x92\x01\x02",
        b"\x05",
        b"\x81\xa4type\xb0GuiUpdateMessage",
        b"\x83\xa4type\xb0GuiUpdateMessage\xa4uuid\xa1x\xa7updates\x05",
    ],
)
def test_messages_that_mean_nothing_are_one_line(message, viewer, caplog):
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    address = viewer.url.replace("http", "ws")
    protocol = f"viser-v{viser.__version__}"
    with connect(address, subprotocols=[protocol], origin=viewer.url, max_size=None) as page:
        page.send(message)
        with contextlib.suppress(ConnectionClosed, TimeoutError):
            while True:
                page.recv(timeout=3)
    assert all(record.exc_info is None for record in caplog.records if record.levelno > logging.DEBUG)
    assert all("\n" not in record.getMessage() for record in caplog.records)
    with connect(address, subprotocols=[protocol], origin=viewer.url, max_size=None) as page:
        assert page.recv(timeout=20)  # other clients are still served


def test_tasks_that_fail_are_one_line(viewer, caplog):
    loop = viewer._server.get_event_loop()
    error = KeyError("a\nb")
    loop.call_soon_threadsafe(loop.call_exception_handler, {"message": "Task exception", "exception": error})
    for _ in range(100):
        if caplog.records:
            break
        time.sleep(0.05)
    (record,) = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert "a message from a page could not be processed" in record.getMessage() and record.exc_info is None
