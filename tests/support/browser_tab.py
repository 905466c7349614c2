"""One open page of the viewer in a browser, and what it complained about."""

import time

import numpy as np
from browser import keep_picture

from jawusd.geometry import matrix_from_wxyz

# What viser's own page says on its console; nothing here comes from jawusd.
KNOWN = ("THREE.Clock: This module has been deprecated", "Unable to preventDefault inside passive event listener")
PATIENCE_S = 120.0  # software GL on a busy machine


class Tab:
    """Drive one open page of a viewer, and keep what its browser complained about."""

    #: What the page shows once it is there.
    READY = "nearest captured"
    SIZE_PX = (1200, 720)
    PIXEL_RATIO = 1  # pixels of the screen to one of the page

    def __init__(self, chromium, viewer):
        self.viewer, self.complaints, self.elsewhere = viewer, [], []
        before = set(viewer.pages)
        self.web = chromium.new_page(
            viewport=dict(zip(("width", "height"), self.SIZE_PX)),
            device_scale_factor=self.PIXEL_RATIO,
            accept_downloads=True,
        )
        self.web.set_default_timeout(1000 * PATIENCE_S)
        self.web.on("console", self._heard)
        self.web.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.web.on("request", self._asked)
        self.web.goto(viewer.url)
        self.web.wait_for_selector(f"text={self.READY}")
        self.page = viewer.pages[(set(viewer.pages) - before).pop()]
        until(lambda: self.web.locator(".mantine-Notification-closeButton").count())
        self.web.locator(".mantine-Notification-closeButton").first.click()  # "Software WebGL" lies over the jaw

    @property
    def session(self):
        """Return what the visitor does with a rig."""
        return self.page.session

    def _heard(self, message):
        if message.type == "error" and not message.text.startswith(KNOWN):
            self.complaints.append(message.text)

    def _asked(self, request):
        if not request.url.startswith((self.viewer.url + "/", "blob:", "data:")):
            self.elsewhere.append(request.url)

    def type_slider(self, index, value):
        box = self.web.locator("input.mantine-NumberInput-input:visible").nth(index)
        box.fill(str(value))
        box.press("Enter")

    def tab(self, name):
        self.web.get_by_role("tab", name=name).click()

    def press(self, name):
        self.web.get_by_role("button", name=name, exact=True).click()

    def said(self, text):
        self.web.wait_for_selector(f"text={text}")

    def download(self, button, path):
        with self.web.expect_download() as found:
            self.press(button)
        found.value.save_as(path)

    def pixel(self, place):
        """Return where a place in anatomical axes [mm] is on the screen."""
        camera = self.page.client.camera
        x = matrix_from_wxyz(camera.wxyz).T @ (np.asarray(place) - camera.position)
        box = self.web.locator("canvas").first.bounding_box()
        # Not camera.image_height: that counts what is drawn, and viser draws more coarsely when it is slow.
        scale = 0.5 * box["height"] / np.tan(0.5 * camera.fov) / x[2]
        return box["x"] + 0.5 * box["width"] + scale * x[0], box["y"] + 0.5 * box["height"] + scale * x[1]

    def resting_place(self, widget):
        """Return the bounding box of a widget once it stands still; it has none while it is drawn anew."""
        before, box = None, widget.bounding_box()
        while box is None or box != before:
            time.sleep(0.5)
            before, box = box, widget.bounding_box()
        return box

    def keep_every_tab(self, name, names):
        """Save a picture of each tab, light and dark; return widths (of the page, of the screen) of all of them."""
        widths = []
        for scheme in ("dark", "light"):
            if scheme == "light":
                self.tab(names[0])
                self.web.get_by_label("dark page").click()
            for one in names:
                self.tab(one)
                time.sleep(0.5)
                self.picture(f"{name}_{one.lower()}_{self.SIZE_PX[0]}_{scheme}")
                widths.append(tuple(self.web.evaluate("[document.documentElement.scrollWidth, innerWidth]")))
        return widths

    def picture(self, name):
        keep_picture(self.web, f"viewer_{name}")


def until(condition):
    """Wait until a condition holds."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
