"""Print how fast the viewer answers: server time of sliders and drags, and the page in a browser.

    python tests/benchmarks/viewer.py actor/actor.usda
    python tests/benchmarks/viewer.py actor/actor.usda --browser /usr/bin/chromium

The server's figures are the median and the 95 % quantile of the time from a visitor's event to the last message put
into the queue, viser's own included: on the clock, and of the processor, which other programs do not lengthen. With
--browser also: from opening the page to the jaw, and from a slider's event to the number and the jaw on the screen.
"""

import argparse
import asyncio
import sys
import time
from pathlib import Path

import numpy as np

from jawusd.geometry.se3 import transform_point
from jawusd.pipeline.view import open_viewer

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from quiet_page import QuietPage

ROUNDS = 200
KEYS = 20


def timed(loop, actions):
    """Return wall and processor milliseconds (n, 2) of actions in the event loop, where events of a visitor run."""

    async def run(action):
        began = time.perf_counter(), time.thread_time()
        action()
        return 1e3 * (time.perf_counter() - began[0]), 1e3 * (time.thread_time() - began[1])

    return np.array([asyncio.run_coroutine_threadsafe(run(action), loop).result() for action in actions])


def drags(page, rng):
    """Return drag events: the pointer wanders by millimetres from the incisal point."""
    session = page.session
    session.set_pose([12.0, 0.0, 0.0])
    place = transform_point(session.pose(), session.rig.landmarks[0])
    session.grab(place)
    path = place + np.cumsum(rng.normal(0, 0.6, (ROUNDS, 3)), axis=0) * np.exp(-np.arange(ROUNDS) / 300)[:, None]

    def one(pointer):
        session.drag_to(pointer)
        page.scene.show_grab(session.grabbed_point(), pointer)
        page.refresh()

    return [lambda pointer=pointer: session.drag_to(pointer) for pointer in path], [
        lambda pointer=pointer: one(pointer) for pointer in path
    ]


def slides(page, rng):
    """Return slider events: the opening goes up and down, the others wander."""
    session = page.session
    values = rng.uniform(0, float(session.rig.d_range[0, 1]), ROUNDS)

    def one(index, value):
        session.set_parameter(index, value)
        page.refresh()

    return [lambda k=k, value=value: one(k % 3, value if k % 3 == 0 else value / 10) for k, value in enumerate(values)]


def in_browser(viewer, path):
    """Print the seconds from opening the page to the jaw, and the milliseconds from slider to screen."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        )
        tab = browser.new_page(viewport={"width": 1200, "height": 720})
        tab.add_init_script(_WATCH)
        began = time.monotonic()
        tab.goto(viewer.url)
        tab.wait_for_function("seen.faces > 1000")
        tab.evaluate("finish()")
        print(f"page opened to jaw drawn            {time.monotonic() - began:8.2f} s")
        tab.wait_for_selector("text=nearest captured")
        print(f"page opened to panels               {time.monotonic() - began:8.2f} s")
        box = tab.locator("input.mantine-NumberInput-input").first
        box.fill("10")
        time.sleep(2.0)
        number, drawn = np.median(tab.evaluate(_KEY_TO_SCREEN, KEYS), axis=0)
        print(f"slider key to number on the screen  {number:8.1f} ms median of {KEYS}")
        print(f"slider key to jaw drawn             {drawn:8.1f} ms median of {KEYS}")
        frame = np.median(tab.evaluate(_FRAME))
        print(f"one picture of the jaw              {frame:8.1f} ms median")
        browser.close()


# Notes what the page's WebGL draws: the number of calls, the faces of the largest mesh, and when a mesh (known by its
# number of corners) was last drawn in another place than before. Not every picture shows something new: viser also
# draws one every second.
_WATCH = """
window.seen = {draws: 0, faces: 0, gl: null, moved: 0};
const gl = WebGL2RenderingContext.prototype, {drawElements, uniformMatrix4fv, useProgram, getUniformLocation} = gl;
const names = new WeakMap(), places = new Map(), matrices = new WeakMap();
let program = null;
gl.getUniformLocation = function (owner, name) {
  const location = getUniformLocation.call(this, owner, name);
  if (location) names.set(location, name);
  return location;
};
gl.useProgram = function (owner) { program = owner; return useProgram.call(this, owner); };
gl.uniformMatrix4fv = function (location, ...given) {
  if (names.get(location) === 'modelViewMatrix') matrices.set(program, given[1].join());
  return uniformMatrix4fv.call(this, location, ...given);
};
gl.drawElements = function (...given) {
  seen.draws++; seen.gl = this; seen.faces = Math.max(seen.faces, given[1] / 3);
  const place = matrices.get(program), before = given[1] > 3000 ? places.get(given[1]) : undefined;
  if (before !== undefined && before !== place) seen.moved = performance.now();
  places.set(given[1], place);
  return drawElements.apply(this, given);
};
// Reading a pixel waits for everything drawn before.
window.finish = () => seen.gl.readPixels(0, 0, 1, 1, 0x1908, 0x1401, new Uint8Array(4));
window.rest = (ms) => new Promise((go) => setTimeout(go, ms));
"""
_KEY_TO_SCREEN = """async (count) => {
  const thumb = document.querySelector('[role=slider]'), waits = [];
  const shown = () => [...document.querySelectorAll('td')].map((cell) => cell.textContent).join();
  thumb.focus();
  for (let k = 0; k < count; k++) {
    await rest(700); // events of a visitor that wait for each other tell nothing of one
    finish();
    const before = shown(), began = performance.now();
    thumb.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight', code: 'ArrowRight', bubbles: true}));
    while (shown() === before && performance.now() - began < 3000) await rest(1);
    const number = performance.now() - began;
    while (seen.moved < began && performance.now() - began < 3000) await rest(1);
    finish();
    waits.push([number, performance.now() - began]);
  }
  return waits;
}"""
_FRAME = """async () => {
  const times = [];
  for (let k = 0; k < 8; k++) { // viser draws at least once a second
    const draws = seen.draws;
    while (seen.draws === draws) await rest(1);
    const began = performance.now();
    finish();
    times.push(performance.now() - began);
    await rest(300);
  }
  return times;
}"""


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rig")
    parser.add_argument("--browser", help="a Chromium")
    given = parser.parse_args()
    began = time.perf_counter()
    viewer = open_viewer(given.rig, "127.0.0.1", 0, play=False)
    print(f"rig read, meshes made, server up    {time.perf_counter() - began:8.2f} s")
    quiet = QuietPage(viewer)
    page = quiet.page
    print(f"page made on the server             {1e3 * quiet.made_s:8.1f} ms")
    rng = np.random.default_rng(0)
    poses, whole = drags(page, rng)
    for name, actions in (
        ("drag event to pose", poses),
        ("drag event to messages", whole),
        ("slider to messages", slides(page, rng)),
    ):
        ms = timed(quiet.loop, actions)
        wall, cpu = np.median(ms, axis=0)
        high = np.quantile(ms, 0.95, axis=0)
        print(f"{name:35s} {wall:8.2f} ms median, {high[0]:.2f} ms 95 % (processor {cpu:.2f}, {high[1]:.2f})")
    if given.browser:
        in_browser(viewer, given.browser)
    viewer.stop()


if __name__ == "__main__":
    main()
