"""Uploads: hostile names, sizes and numbers; files are written only to a temporary folder."""

import asyncio

import pytest
from quiet_page import QuietPage
from viser import UploadedFile, _messages

from jawusd.viewer.widgets import MOST_BYTES

TABLE = b"frame,d1,d2,d3\n0,1,0,0\n9,9,0,0\n"


@pytest.fixture
def quiet(viewer):
    return QuietPage(viewer)


def send(quiet, *messages):
    """Dispatch messages of a page as the server does."""

    async def run():
        for message in messages:
            await quiet.client.gui._websock_interface._handle_incoming_message(0, message)

    asyncio.run_coroutine_threadsafe(run(), quiet.loop).result(60)


def start(widget, transfer, size, parts=2, name="keys.json"):
    return _messages.FileTransferStartUpload(widget._impl.uuid, transfer, name, "application/json", parts, size)


def pending(quiet):
    return quiet.client.gui._current_file_upload_states


HOSTILE = ["../../../etc/cron.d/x.csv", "..\\..\\x.csv", "/x.csv", "x\0.csv", "x" * 9000 + ".csv", "x.csv.CSV",
           "💀\n\x1b[2J.csv", ".csv"]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_names_of_uploads_name_no_files(name, quiet, folder):
    before = sorted(folder.parent.rglob("*"))
    quiet.enter(quiet.page.files.load, UploadedFile(name, TABLE))
    assert quiet.notices[-1][0] == "Loaded" and len(quiet.notices[-1][1]) <= 80
    assert quiet.notices[-1][1].isprintable()
    assert sorted(folder.parent.rglob("*")) == before


@pytest.mark.parametrize("name", ["x.usda", "x." + "y" * 300, "..", "", "x.csv.exe", "x.json\0"])
def test_other_types_are_refused(name, quiet):
    quiet.enter(quiet.page.files.load, UploadedFile(name, TABLE))
    assert quiet.notices[-1][0] == "Failed" and "not a .json or .csv file" in quiet.notices[-1][1]


def test_uploads_have_a_size(quiet):
    load = quiet.page.files.load
    send(quiet, start(load, "announced", MOST_BYTES + 1))
    assert pending(quiet) == {} and f"limit is {MOST_BYTES}" in quiet.notices[-1][1]
    send(quiet, start(load, "sent", 10))
    send(quiet, _messages.FileTransferPart(load._impl.uuid, "sent", 0, bytes(MOST_BYTES + 1)))
    assert pending(quiet) == {} and f"limit is {MOST_BYTES}" in quiet.notices[-1][1]


def test_one_upload_at_a_time(quiet):
    load = quiet.page.files.load
    send(quiet, *(start(load, f"number {k}", 2 * len(TABLE)) for k in range(50)))
    assert list(pending(quiet)) == ["number 0"] and "another upload" in quiet.notices[-1][1]
    send(quiet, *(_messages.FileTransferPart(load._impl.uuid, "number 0", k, TABLE) for k in range(2)))
    assert pending(quiet) == {}


def test_widgets_that_take_no_files_get_none(quiet):
    send(quiet, start(quiet.page.pose.sliders[0], "a", 100), start(quiet.page.files.name, "b", 100))
    assert pending(quiet) == {} and "does not accept that file" in quiet.notices[-1][1]
