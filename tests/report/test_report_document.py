"""The report is a self-contained file, complete, and immune to injected markup."""

import base64
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from example_rig import moved
from package_copy import ROOT
from report_data import document, experiments, report_data

from jawusd.formats.finding import Finding
from jawusd.formats.report import Origin, Overlay, RigFacts
from jawusd.formats.tracks import LostReason
from jawusd.report.document import _frame_lists
from jawusd.report.jaw_pages import replay_data
from jawusd.report.templates import worded

SECTIONS = (
    "top", "verdicts", "take", "inputs", "tracking", "model", "bounds", "condyles", "ranges", "files", "left-out"
)  # fmt: skip
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"' {{ 7 * 7 }}"


class Page(HTMLParser):
    """Collect the elements of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text.append(data)

    def values(self, name):
        """Return all values of an attribute."""
        return [attrs[name] for _, attrs in self.tags if name in attrs]


def outside(text):
    """Return the external references of a page."""
    page = Page(text)
    names = ("src", "href", "xlink:href", "srcset", "action", "poster", "data", "ping")
    links = [value for name in names for value in page.values(name) if not value.startswith(("#", "data:"))]
    links += [match for match in re.findall(r"url\(([^)]*)\)", text) if not match.startswith("#")]
    return links + re.findall(r"https?://[^\s\"'<]*|@import|<link\b|<iframe\b", text)


@pytest.fixture(scope="module")
def page():
    return document(report_data(lost=(20, 21), experiments=experiments(sentences=("Record protrusion.",))))


@pytest.fixture
def words_alone(monkeypatch):
    """Skip the figures, which take most of the time of a page."""
    monkeypatch.setattr("report_data.all_figures", lambda data: {})


def test_reasons_of_losses_are_listed_with_their_frames(words_alone):
    data = report_data(lost=(20, 21))
    data.tracks.lost_reason[20:22, 1] = LostReason.LOW_SCORE
    listed = {reason: (count, frames) for reason, count, frames in _frame_lists(data)}
    first = data.tracks.frames[20]
    assert listed["lost, lower arch: low score"] == listed["lost by the tracker"] == (2, f"{first}\u2013{first + 1}")
    assert "lost, lower arch: low score" in document(data)
    assert all(count > 0 for _, count, _ in _frame_lists(data))


def test_outliers_are_listed_where_no_frame_was_excluded():
    data = report_data()
    meta = {**data.model.meta, "trimmed_frames": [22, 23, 30], "excluded_frames": {}}
    listed = _frame_lists(replace(data, model=replace(data.model, meta=meta)))
    assert ("excluded from the fit as outliers", 3, "22\u201323, 30") in listed


def test_nothing_comes_from_elsewhere(page):
    assert outside(page) == []
    policy = next(a["content"] for tag, a in Page(page).tags if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy


@pytest.mark.parametrize(
    "planted",
    [
        '<script src="lib.js"></script>',
        '<img src="//host/x.png">',
        "<style>@import 'x.css';</style>",
        '<p style="background: url(x.png)">',
        '<a href="https://example.org">x</a>',
    ],
)
def test_the_check_sees_what_would_be_fetched(page, planted):
    assert outside(page.replace("</body>", f"{planted}</body>"))


def test_every_section_and_figure_is_there_and_ids_are_unique(page):
    shown = Page(page)
    ids = shown.values("id")
    assert len(ids) == len(set(ids)) and set(SECTIONS) <= set(ids)
    plots = [attrs for tag, attrs in shown.tags if tag == "svg"]
    assert len(plots) == 7 and all(attrs["role"] == "img" and attrs["aria-label"] for attrs in plots)
    assert {href[1:] for href in shown.values("href")} <= set(ids)
    text = " ".join(shown.text)
    for words in (
        "Record protrusion.",
        "light flash",
        "by picks, on frame 30",
        "upper: 2",
        "31\u201333, 40",
        "cam1.mp4",
    ):
        assert words in text
    assert "by the tracker 2 50\u201351" in re.sub(r"\s+", " ", text)


def test_colours_of_figures_follow_the_theme(page):
    drawings = "".join(re.findall(r"<svg class=\"plot\".*?</svg>", page, flags=re.DOTALL))
    assert "var(--ink)" in drawings and "#000000" not in drawings and "#ffffff" not in drawings.lower()
    assert "<style" not in drawings
    for name in set(re.findall(r"var\(--([a-z]+)\)", page)):
        assert page.count(f"--{name}: #") == 2, name  # for light and for dark


def test_text_from_files_stays_text():
    data = report_data()
    data.model.meta["warnings"] = [{"code": HOSTILE, "message": HOSTILE}]
    data.model.meta["excluded_frames"] = {HOSTILE: [1]}
    data.tracks.meta["start"] = {"by": HOSTILE, "frame": HOSTILE}
    tracks = replace(data.tracks, camera_names=(HOSTILE, "cam1"))
    part = replace(data.parts[0], name=HOSTILE)
    text = document(
        replace(
            data,
            actor=HOSTILE,
            tracks=tracks,
            inferred=(HOSTILE,),
            left_out=(HOSTILE,),
            hashes={HOSTILE: HOSTILE},
            overlays=(Overlay(3, HOSTILE, b""),),
            experiments=replace(experiments(), actor=HOSTILE, notes=(HOSTILE,)),
            parts=(part, *data.parts[1:]),
        )
    )
    shown = Page(text)
    assert sum(tag == "script" for tag, _ in shown.tags) == 2 and "onerror" not in dict(shown.tags)
    assert not any("onerror" in attrs for _, attrs in shown.tags)
    assert HOSTILE in "".join(shown.text)


def test_when_how_and_with_what_a_build_was_made_is_told(words_alone):
    text = " ".join(Page(document(report_data())).text)
    for words in ("Capture someone", "built 2031-02-03 04:05:06 UTC with jawusd 1.2.3", "jawusd build 'some where' -o"):
        assert words in text
    text = " ".join(Page(document(report_data(origin=Origin("", "", {})))).text)
    assert "built at an unknown time" in text and "Versions: not recorded" in text


def test_commands_are_set_as_code_and_no_backtick_is_seen():
    said = "Run `jawusd check <it>` first."
    data = report_data(rig=RigFacts(0.02, ("error: see `jawusd validate`",)), inferred=(said,), left_out=(said,))
    data.model.meta["warnings"] = [{"code": "rotation_range", "message": said}]
    data.model.meta["excluded_frames"] = {said: [1]}
    data.tracks.meta["start"] = {"by": said, "frame": 3}
    data.tracks.meta["findings"] = [Finding("x", "warning", said).as_json()]
    data = replace(data, experiments=replace(experiments(), notes=(said,)), overlays=(Overlay(3, said, b""),))
    text = document(data)
    shown = re.sub(r"<(script|style).*?</\1>", "", text, flags=re.DOTALL)
    assert "`" not in shown
    assert shown.count("<code>jawusd check &lt;it&gt;</code>") == 10  # also in the verdict and in what to do
    assert worded("one ` alone") == "one ` alone"


@pytest.mark.slow
def test_a_long_take_stays_small():
    data = report_data(count=20000)
    many = np.random.default_rng(0).uniform([0, -9, -1], [40, 9, 7], (20000, 3))
    found = experiments()
    coverage = replace(found.coverage, d=many)
    captured = np.stack([many, many])
    text = document(replace(data, experiments=replace(found, coverage=coverage, captured_condyles=captured)))
    assert len(text) < 4e6


def test_how_masks_were_drawn_and_the_closed_bite_are_told(words_alone):
    data = report_data()
    registration = {
        "frames": [46, 50],
        "named": True,
        "applied": False,
        "shift_mm": [0.0, 0.3, 0.4],
        "turn_deg": [3.0, 0.0, 0.0],
        "shift_sigma_mm": [0.03, 0.0, 0.04],
        "turn_sigma_deg": [0.1, 0.0, 0.0],
        "T": np.eye(4).tolist(),
    }
    names = data.tracks.camera_names
    data.tracks.meta.update(
        outline_bias_px={name: [0.25, -0.5] for name in names},
        gum_bias_px={name: [0.75, 1.0] for name in names},
        gum_line_mm=[0.11, -0.12],
        registration=registration,
    )
    text = " ".join(Page(document(data)).text)
    assert "edges +0.25 / -0.50, gum line +0.75 / +1.00" in text
    assert "+0.11 mm (upper), -0.12 mm (lower)" in text
    assert "frames 46 to 50" in text and "from the closed bite by 0.50 ± 0.05 mm and 3.00 ± 0.10 degrees" in text


def test_without_experiments_pictures_and_meshes_the_page_says_so():
    text = " ".join(Page(document(report_data(experiments=None, overlays=(), parts=(), cameras=()))).text)
    assert "The experiments were not run" in text and "There are no images" in text
    assert "There is nothing to show" in text


def test_the_replay_carries_the_poses_and_the_meshes():
    data = report_data(lost=(20, 21))
    packed, model = replay_data(data), data.model
    A, rest = model.arrays["T_anatomical_skull"], model.arrays["T_rest"]
    motion = np.frombuffer(base64.b64decode(packed["captured"]), "<f4").reshape(-1, 3, 4)
    lost = np.isnan(motion).any((1, 2))
    assert np.flatnonzero(lost).tolist() == [20, 21]
    points = np.random.default_rng(0).normal(size=(9, 3)) * 60
    at_rest = moved((A @ rest)[None], points)[0]
    expected = moved((A @ data.tracks.T_upper_lower)[~lost], points)
    np.testing.assert_allclose(moved(motion[~lost], at_rest), expected, atol=1e-3)
    fitted = np.frombuffer(base64.b64decode(packed["fitted"]), "<f4").reshape(-1, 3, 4)
    np.testing.assert_allclose(moved(fitted[~lost], at_rest), expected, atol=1e-3)  # the take was made by the model
    for part, wanted in zip(packed["parts"], data.parts, strict=True):
        steps = np.frombuffer(base64.b64decode(part["vertices"]), "<u2").reshape(-1, 3)
        np.testing.assert_allclose(part["low"] + steps * part["step"], wanted.mesh.vertices, atol=0.002)
        faces = np.frombuffer(base64.b64decode(part["faces"]), "<u2").reshape(-1, 3)
        np.testing.assert_array_equal(faces, wanted.mesh.faces)
    states = np.frombuffer(base64.b64decode(packed["state"]), "u1")
    assert {packed["states"][k] for k in states[lost]} == {"lost"}


@pytest.mark.parametrize("name", ["scene", "replay", "pose"])
def test_the_scripts_are_javascript(name):
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no node to check the script with")
    script = ROOT / "jawusd" / "report" / "page" / f"{name}.js"
    assert len(script.read_text().splitlines()) <= 300
    subprocess.run([node, "--check", script], check=True, timeout=60)
