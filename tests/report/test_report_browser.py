"""The report opened from disk in a browser: light and dark, no requests, no console errors, a moving replay."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from browser import headless_chromium, keep_picture, open_page
from PIL import Image
from report_data import experiments, report_data, solve_data, write_document

from jawusd.formats.mesh import Mesh
from jawusd.formats.report import Origin, ReplayPart
from jawusd.report import document as report_document
from jawusd.report.solve_page import solve_page

chromium = pytest.fixture(headless_chromium, scope="module")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the report of an example, and its data."""
    data, path = report_data(lost=(20, 21)), tmp_path_factory.mktemp("report") / "report.html"
    write_document(path, data)
    return path, data


@pytest.fixture(params=["light", "dark"])
def opened(request, chromium, written):
    """Open the report of an example; errors and requests are checked afterwards."""
    path, data = written
    page, trouble, requests = open_page(chromium, 1200, 900, color_scheme=request.param), [], []
    page.on("console", lambda message: trouble.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    yield page, data, request.param
    keep_picture(page, f"report_{request.param}", full_page=True)
    page.context.close()
    assert trouble == []
    assert [url for url in requests if not url.startswith("data:")] == [path.as_uri()]


def part(page, name):
    return page.locator(f'[data-replay="{name}"]')


def picture(page):
    """Return the rendered replay, (h, w, 3)."""
    with Image.open(io.BytesIO(part(page, "canvas").screenshot())) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def move_to(page, row):
    press = "e.dispatchEvent(new KeyboardEvent('keydown', { key }))"
    part(page, "timeline").evaluate(
        f"(e, keys) => {{ for (const key of keys) {press}; }}", ["Home"] + ["ArrowRight"] * row
    )


def ball(name, kind, radius, place=(0.0, 0.0, 0.0)):
    """Return a fixed ball for the replay."""
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return ReplayPart(name, kind, False, Mesh(np.asarray(made.vertices) + place, np.asarray(made.faces, np.int32)))


@pytest.mark.parametrize(("bone_mm", "seen"), [(10.8, "tooth"), (13.0, "bone")])
def test_bone_that_nearly_coincides_with_teeth_stays_behind_them(chromium, tmp_path, bone_mm, seen):
    parts = (ball("mandible", "bone", bone_mm), ball("lower_teeth", "tooth", 10.0))
    data = report_data(parts=parts)
    report_document.write_document(tmp_path / "report.html", data, figures={})
    page = open_page(chromium, 1200, 900)
    page.goto((tmp_path / "report.html").as_uri())
    drawn = picture(page)
    red, green, blue = drawn[drawn.shape[0] // 2, drawn.shape[1] // 2]
    page.context.close()
    colour = {"tooth": 0.90 / 0.95, "bone": 0.72 / 0.84}[seen]  # as in replay.js
    assert blue / red == pytest.approx(colour, abs=0.02)


@pytest.fixture(scope="module")
def wordy(tmp_path_factory):
    """Return a report with long names and sentences."""
    long, path = "x" * 300, tmp_path_factory.mktemp("wordy") / "report.html"
    data = report_data(experiments=experiments(sentences=("Record slow circling with the mouth half open. " * 6,)))
    data = replace(data, actor=long, origin=Origin("today", f"jawusd build {long}", {"jawusd": "1"}), left_out=(long,))
    write_document(path, data)
    return path


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390])
def test_no_width_scrolls_the_page_sideways(chromium, wordy, scheme, width):
    page = open_page(chromium, width, 844, color_scheme=scheme)
    page.goto(wordy.as_uri())
    wide = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    unfolded = page.evaluate("document.documentElement.scrollWidth")
    cells = page.locator("#verdicts td").evaluate_all("all => all.map(e => e.getBoundingClientRect().right)")
    links = page.locator("nav a").evaluate_all("all => all.map(e => e.getBoundingClientRect().right)")
    letters = page.locator("#tracking svg text").first.evaluate("e => e.getBoundingClientRect().height")
    keep_picture(page, f"report_{width}_{scheme}", full_page=True)
    page.context.close()
    assert wide[0] <= wide[1] == width
    assert unfolded <= width and len(links) > 5 and max(links) <= width
    assert len(cells) > 20 and max(cells) <= width  # verdicts are read without scrolling
    assert letters > 8  # drawings are legible and scroll separately


def test_tables_are_folded_and_a_link_opens_them(chromium, tmp_path):
    write_document(tmp_path / "report.html", report_data(experiments=experiments(sentences=("Gap: record chewing.",))))
    page = open_page(chromium, 1440, 900)
    page.goto((tmp_path / "report.html").as_uri())
    bottoms = page.locator(".verdict, #todo, #overlay h2, [data-replay=canvas]").evaluate_all(
        "all => all.map(e => e.getBoundingClientRect().bottom)"
    )
    assert len(bottoms) == 4 and max(bottoms) < 900 and not page.locator("table").first.is_visible()
    assert page.locator(".verdict").inner_text().endswith("Usable for animation. Re-record: chewing.")
    page.click("nav a[href='#model']")
    page.wait_for_selector("#model table", state="visible")
    assert not page.locator("#files table").is_visible()
    page.context.close()


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """Return the report of a performance."""
    path = tmp_path_factory.mktemp("solved") / "take.html"
    path.write_text(solve_page(solve_data()), encoding="utf-8")
    return path


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390])
def test_no_width_scrolls_the_page_of_a_performance_sideways(chromium, solved, scheme, width):
    page = open_page(chromium, width, 844, color_scheme=scheme)
    page.goto(solved.as_uri())
    wide = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    keep_picture(page, f"solve_{width}_{scheme}", full_page=True)
    page.context.close()
    assert wide[0] <= wide[1] == width


def luminance(color):
    """Return the relative luminance of "rgb(r, g, b)" (WCAG 2.2)."""
    share = np.array([float(v) for v in color[color.index("(") + 1 : -1].split(",")[:3]]) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_the_replay_shows_the_frame_that_is_asked_for(opened):
    page, data, _ = opened
    for row in (0, 30):
        move_to(page, row)
        d = " ".join(part(page, "d").inner_text().split())
        assert d == "d1 {:.1f} d2 {:.1f} d3 {:.1f} mm".format(*(data.model.d[row] + 0.0))
        assert part(page, "frame").inner_text() == f"frame {data.model.frames[row]}, tracked"
    wide = picture(page)
    assert len(np.unique(wide.reshape(-1, 3), axis=0)) > 50  # shaded meshes, not an empty canvas
    move_to(page, 0)
    assert np.abs(picture(page) - wide).max() > 50
    move_to(page, 20)
    assert part(page, "frame").inner_text() == f"frame {data.model.frames[20]}, lost"
    page.locator("[data-frame]").first.click()
    assert part(page, "frame").inner_text().startswith(f"frame {data.overlays[0].frame},")


def test_the_timeline_of_the_replay_scrubs_shows_the_bound_and_parts_are_hidden(opened):
    page, data, scheme = opened
    move_to(page, 0)
    area = json.loads(part(page, "timeline").get_attribute("data-area"))
    box, (first, last) = part(page, "timeline").bounding_box(), area["view"]
    at = [
        area["left"] + (data.model.frames[row] - first) / (last - first) * (area["right"] - area["left"])
        for row in (20, 30)
    ]
    page.mouse.click(box["x"] + at[1], box["y"] + 10)
    assert part(page, "frame").inner_text() == f"frame {data.model.frames[30]}, tracked"
    move_to(page, 0)
    with Image.open(io.BytesIO(part(page, "timeline").screenshot())) as shown:
        lost, tracked = (shown.convert("RGB").getpixel((round(x), 24)) for x in at)
    green = (0, 158, 115) if scheme == "light" else (53, 199, 155)
    assert np.abs(np.subtract(tracked, green)).max() < 8
    assert np.ptp(lost) < 20  # grey
    shown = picture(page)
    page.locator('[data-part="tooth"]').uncheck()
    assert (np.abs(picture(page) - shown).sum(axis=2) > 30).sum() > 30


@pytest.mark.slow
def test_it_plays_turns_and_is_readable(opened):
    page, _, scheme = opened
    before = part(page, "frame").inner_text()
    part(page, "play").click()
    page.wait_for_function("text => document.querySelector('[data-replay=frame]').textContent !== text", arg=before)
    part(page, "play").click()
    assert part(page, "play").inner_text() == "Play"
    seen = picture(page)
    page.get_by_role("button", name="left").click()
    assert np.abs(picture(page) - seen).max() > 50
    colors = "e => [getComputedStyle(e).color, getComputedStyle(e).backgroundColor]"
    ink, paper = map(luminance, page.locator("#verdicts").evaluate(colors))
    assert (ink > paper) == (scheme == "dark")
    light, dark = max(ink, paper), min(ink, paper)
    assert (light + 0.05) / (dark + 0.05) > 7
    for element in page.locator(".grade").all()[:8]:
        grade = luminance(element.evaluate("e => getComputedStyle(e).color"))
        light, dark = max(grade, paper), min(grade, paper)
        assert (light + 0.05) / (dark + 0.05) > 4.5
