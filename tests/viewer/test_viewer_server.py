"""Who may look: addresses, foreign pages, and a warning when the world is let in."""

import signal
import subprocess
import sys

import pytest

from jawusd.errors import OutputError
from jawusd.viewer.server import Viewer, is_loopback, is_own_page


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
        ("evil.example:8080", "http://evil.example:8080", True, False),  # its name was made to point here
        ("studio.local:8080", "http://studio.local:8080", False, True),
        ("studio.local:8080", "http://evil.example", False, False),
        ("", None, True, False),
    ],
)
def test_pages_of_other_sites_are_not_served(host, origin, local, own):
    assert is_own_page(host, origin, local=local) is own


def test_an_address_of_another_machine_is_refused(folder):
    from jawusd.pipeline.view import viewed_actor

    with pytest.raises(OutputError, match="cannot listen on 192.0.2.1"):
        Viewer(viewed_actor(folder), "192.0.2.1", 0)


def heed_interrupts():
    """Undo what a shell does that starts the tests in the background: they, and their children, ignore interrupts."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def run_view(folder, *options):
    """Run `jawusd view` until it says where to look; return stdout's first line and stderr."""
    command = [sys.executable, "-m", "jawusd", "view", str(folder), "--no-browser", "--port", "0", *options]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts
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


def test_listening_to_the_world_is_warned_about(folder):
    line, _, errors, code = run_view(folder, "--host", "0.0.0.0")
    assert line.startswith("http://0.0.0.0:") and code == 0
    assert "warning: listening on 0.0.0.0" in errors
