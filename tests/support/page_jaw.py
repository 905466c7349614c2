"""The page that poses a rig without a server, opened in a browser, for tests."""

import io
import json

import numpy as np
from browser import keep_picture, open_page
from PIL import Image

SET = "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }"


class Jaw:
    """The open page: what it shows, and what a visitor does."""

    def __init__(self, chromium, file, width=1100, height=800, **context):
        self.web, self.trouble, self.requests = open_page(chromium, width, height, **context), [], []
        self.web.on("console", lambda message: self.trouble.append(message.text) if message.type == "error" else None)
        self.web.on("pageerror", lambda error: self.trouble.append(str(error)))
        self.web.on("request", lambda request: self.requests.append(request.url))
        self.web.goto(file.as_uri())
        self.part = lambda name: self.web.locator(f'[data-jaw="{name}"]')

    def close(self, name):
        keep_picture(self.web, name, full_page=True)
        self.web.context.close()
        assert self.trouble == []
        assert [url for url in self.requests if not url.startswith(("blob:", "data:"))] == self.requests[:1]

    def pose(self):
        """Return d (3,) [mm] and the motion (4, 4) that the page shows."""
        shown = self.web.locator("#jaw").evaluate("e => [e.dataset.d, e.dataset.motion]")
        return np.array(json.loads(shown[0])), np.reshape(json.loads(shown[1]), (4, 4)).T

    def grabbable(self):
        """Return the place of a pixel of the moving parts on the vertical middle of the canvas."""
        box = self.part("canvas").bounding_box()
        for y in np.linspace(box["y"] + 0.3 * box["height"], box["y"] + box["height"], 60):
            self.web.mouse.move(box["x"] + box["width"] / 2, y)
            if self.part("canvas").evaluate("e => e.style.cursor") == "move":
                return box["x"] + box["width"] / 2, y + 6
        raise AssertionError("nothing moves in the middle of the page")

    def pull(self, start, dx, dy):
        """Drag from a place in the page [px]."""
        self.web.mouse.move(*start)
        self.web.mouse.down()
        self.web.mouse.move(start[0] + dx, start[1] + dy, steps=8)
        self.web.mouse.up()

    def drag(self, dx, dy):
        self.pull(self.grabbable(), dx, dy)
        return self.pose()

    def read_keys(self):
        return json.loads(self.web.locator("#jaw").evaluate("e => e.dataset.keys ?? '[]'"))

    def area(self):
        return json.loads(self.part("timeline").get_attribute("data-area"))

    def place(self, frame, value=None):
        """Return the place in the page [px] of a frame on the timeline: at a value [mm] or on the ruler."""
        area, box = self.area(), self.part("timeline").bounding_box()
        (first, last), (low, high) = area["view"], area["range"]
        x = area["left"] + (frame - first) / (last - first) * (area["right"] - area["left"])
        y = 10 if value is None else area["bottom"] - (value - low) / (high - low) * (area["bottom"] - area["top"])
        return box["x"] + x, box["y"] + y

    def seek(self, frame):
        self.web.mouse.click(*self.place(frame))
        assert self.part("frame").inner_text() == f"frame {frame}"

    def set_pose(self, d):
        self.part("close").click()
        for name, value in zip(("d1", "d2", "d3"), d, strict=True):
            self.part(name).evaluate(SET, value)

    def strip(self, frame):
        """Return the grade of a frame in the strip below the ruler: the nearest colour of the style sheet."""
        with Image.open(io.BytesIO(self.part("timeline").screenshot())) as picture:
            x, y = self.place(frame)
            box = self.part("timeline").bounding_box()
            shown = np.array(picture.convert("RGB").getpixel((round(x - box["x"] + 3), 24)))
        colors = {"green": (0, 158, 115), "orange": (230, 159, 0), "vermilion": (213, 94, 0)}
        return min(colors, key=lambda name: np.abs(np.array(colors[name]) - shown).sum())
