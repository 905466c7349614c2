"""Footage of the take beside the jaw: the timeline's frame, the menu's camera, and nothing without a capture."""

import shutil

import numpy as np
import pytest
from browser_tab import Tab, until
from viewed_example import EXAMPLE, FIRST, record_build

from jawusd.media.overlay import UPPER_COLOUR
from jawusd.pipeline.view import open_viewer
from jawusd.pipeline.view_capture import take_footage
from jawusd.viewer.page import OFF

CAMERAS = ("cam0", "cam1", "cam2")


@pytest.fixture
def built(folder, tmp_path):
    return record_build(shutil.copytree(folder, tmp_path / "built"), EXAMPLE)


@pytest.fixture
def beside(built):
    """Serve a rig whose capture is there, its jaw at rest."""
    running = open_viewer(built, "127.0.0.1", 0, play=False)
    yield running
    running.stop()


def test_images_follow_frame_and_camera_and_show_the_teeth(built):
    footage = take_footage(built)
    assert footage.cameras == CAMERAS and footage.frames == (FIRST, FIRST + 29)
    images = [footage.picture(*at).astype(float) for at in (("cam0", 22), ("cam0", 45), ("cam1", 22))]
    for image in images:
        assert (np.abs(image - UPPER_COLOUR).max(axis=-1) < 40).mean() > 0.002
        assert np.abs(image - images[0]).mean() > 2 or image is images[0]


def test_a_rig_without_its_capture_has_no_footage(folder, tmp_path):
    assert take_footage(folder) is None
    assert take_footage(record_build(folder, tmp_path / "moved")) is None
    (folder / "build.json").write_text("{}")
    assert take_footage(folder) is None


class Phone(Tab):
    """A page on a phone."""

    SIZE_PX = (390, 844)


def picture_of(tab):
    """Return the address of the image that the page shows; None without one."""
    images = tab.web.locator("img:visible")
    return images.first.get_attribute("src") if images.count() else None


@pytest.mark.slow
def test_the_page_shows_the_footage_of_the_frame(chromium, beside):
    tab = Tab(chromium, beside)
    panel = tab.page.footage
    assert panel.camera.value == "cam0" and panel.drawn is None  # frame 0 is before the take
    seen = []
    for frame in (22, 45):
        tab.page.motion.show(float(frame))
        until(lambda frame=frame: panel.drawn == ("cam0", frame))
        until(lambda: picture_of(tab) not in (None, *seen))
        seen.append(picture_of(tab))
    tab.picture("footage")
    menu = tab.web.get_by_label("footage", exact=True).first
    for choice in ("cam1", OFF):
        menu.click()
        tab.web.get_by_role("option", name=choice).click()
        until(lambda choice=choice: panel.drawn == (None if choice == OFF else (choice, 45)))
    until(lambda: picture_of(tab) is None)
    tab.web.close()
    assert tab.complaints == [] and tab.elsewhere == []


@pytest.mark.slow
def test_phones_begin_without_footage_and_rigs_alone_have_no_menu(chromium, beside, viewer):
    phone = Phone(chromium, beside)
    assert phone.page.footage.camera.value == OFF
    phone.page.motion.show(30.0)
    phone.said("inside the bound")
    assert picture_of(phone) is None
    phone.web.close()
    alone = Tab(chromium, viewer)
    assert alone.page.footage is None
    assert alone.web.get_by_label("footage", exact=True).count() == 0
    alone.web.close()
    assert phone.complaints == alone.complaints == []
