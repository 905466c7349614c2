"""The built site: its reference has everything that the code has, its links lead somewhere, it loads nothing."""

import importlib
import os
import pkgutil
import re
import subprocess
import sys
import zlib
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

import pytest
from browser import headless_chromium, keep_picture
from doc_blocks import COMMANDS
from package_copy import ROOT

import jawusd
from jawusd.base.errors import JawusdError
from jawusd.formats.capture import capture_keys

pytest.importorskip("mkdocs", reason="jawusd[docs] is not installed")
SCHEMA = ROOT / "schemas" / "generatedSchema.usda"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Build the documentation, any warning being an error, and return its folder."""
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}, capture_output=True,
        text=True, timeout=500, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


class Page(HTMLParser):
    """Hold what a page names: anchors, links, and what it loads."""

    def __init__(self, text):
        super().__init__()
        self.anchors, self.links, self.loaded = set(), [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.anchors |= {values[key] for key in ("id", "name") if values.get(key)}
        if tag == "a" and values.get("href"):
            self.links.append(values["href"])
        source = values.get("src") or (values.get("href") if tag == "link" else None)
        if source and values.get("rel") not in ("canonical", "next", "prev"):
            self.loaded.append(source)


def faults(folder):
    """Return every link and file of the pages of a folder that leads nowhere, and everything loaded from elsewhere."""
    pages = {path: Page(path.read_text()) for path in folder.rglob("*.html")}
    found = []
    for path, page in pages.items():
        if path.name == "404.html":  # served at any address: its links start at the root of the server
            continue
        for link in page.links + page.loaded:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if link in page.loaded and parts.scheme != "data":
                    found.append(f"{path.relative_to(folder)} loads {link}")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            anchors = pages[target].anchors if target in pages else set()
            if not target.exists() or (parts.fragment and unquote(parts.fragment) not in anchors):
                found.append(f"{path.relative_to(folder)}: {link}")
    return found


def test_links_lead_somewhere_and_nothing_is_loaded_from_elsewhere(site):
    assert len(list(site.rglob("*.html"))) > 40
    assert faults(site) == []


@pytest.mark.parametrize(
    "text",
    [
        '<a href="nowhere.html">x</a>',
        '<a href="#nothing">x</a>',
        '<a href="b.html#nothing">x</a>',
        '<img src="picture.png">',
        '<script src="https://cdn.example/x.js"></script>',
        '<link rel="stylesheet" href="https://fonts.example/css">',
    ],
)
def test_a_link_that_leads_nowhere_is_found(tmp_path, text):
    (tmp_path / "b.html").write_text('<h1 id="there">B</h1>')
    (tmp_path / "a.html").write_text('<a href="b.html#there">B</a>')
    assert faults(tmp_path) == []
    (tmp_path / "a.html").write_text(text)
    assert len(faults(tmp_path)) == 1


def inventory(site):
    """Return every documented Python name; the file is the one that Sphinx reads, four lines and a zlib stream."""
    data = (site / "objects.inv").read_bytes()
    body = zlib.decompress(data.split(b"\n", 4)[4]).decode()
    return {line.split(" ")[0] for line in body.splitlines()}


def packages():
    """Yield the package and every package in it that says what it offers."""
    yield jawusd
    for module in pkgutil.walk_packages(jawusd.__path__, "jawusd."):
        if module.ispkg and ".plugins." not in module.name:
            package = importlib.import_module(module.name)
            if hasattr(package, "__all__"):
                yield package


def undocumented(known):
    """Return the offered names, and the public methods of offered classes, that are not among the known ones."""
    found = []
    for package in packages():
        for name in package.__all__:
            value = getattr(package, name)
            home = f"{getattr(value, '__module__', package.__name__)}.{name}"
            if not {f"{package.__name__}.{name}", home} & known and name != "__version__":
                found.append(f"{package.__name__}.{name}")
            if isinstance(value, type) and value.__module__.startswith("jawusd"):
                methods = [k for k, v in vars(value).items() if not k.startswith("_") and callable(v) and v.__doc__]
                places = (f"{package.__name__}.{name}", home)
                found += [f"{home}.{m}" for m in methods if not {f"{place}.{m}" for place in places} & known]
    return found


def test_every_public_name_is_in_the_reference(site):
    known = inventory(site)
    assert undocumented(known) == []
    assert undocumented(known - {"jawusd.evaluator.JawRig.pose", "jawusd.evaluator.rig.JawRig.pose"})
    assert "<code>jawusd.__version__</code>" in (site / "reference/python/jawusd.html").read_text()


def test_every_file_format_is_in_the_reference(site):
    known = inventory(site)
    folder = ROOT / "jawusd" / "formats"
    internal = {"atomic", "text", "nuke_script", "capture_writing"}  # they read or write parts of other files
    for path in folder.glob("*.py"):
        names = re.findall(r"^def ((?:load|read|save|write)_\w+)", path.read_text(), flags=re.M)
        if path.stem not in internal:
            assert [name for name in names if f"jawusd.formats.{path.stem}.{name}" not in known] == []
    assert {"jawusd.library.index", "jawusd.pipeline.state"} <= known


def sections(text):
    """Return the text of each second-level section of a page by its anchor."""
    parts = re.split(r'<h2 id="([^"]+)"', text)
    return dict(zip(parts[1::2], (re.sub(r"<[^>]+>", "", part) for part in parts[2::2])))


def test_every_command_and_option_is_in_the_reference(site):
    found = sections((site / "reference/commands.html").read_text())
    assert set(found) == {"jawusd", *(f"jawusd-{name}" for name in COMMANDS)}
    for name, command in COMMANDS.items():
        options = [option for parameter in command.params for option in parameter.opts if option.startswith("-")]
        assert [option for option in options if option not in found[f"jawusd-{name}"]] == [], name


def test_every_key_of_a_capture_is_in_the_reference(site):
    anchors = Page((site / "reference/capture-toml.html").read_text()).anchors
    keys = [re.sub(r"\W+", "-", f"{entry.table} {entry.name}").strip("-") for entry in capture_keys()]
    assert len(keys) > 40
    assert [key for key in keys if key not in anchors] == []


def test_every_usd_attribute_is_in_the_reference(site):
    anchors = Page((site / "reference/usd.html").read_text()).anchors
    attributes = set(re.findall(r"\b(jaw:[\w:]+)(?= ?[=(\n])", SCHEMA.read_text()))
    assert len(attributes) > 60
    assert [name for name in attributes if name.replace(":", "-") not in anchors] == []


def kinds(error=JawusdError):
    """Yield an exception and all below it."""
    yield error
    for below in error.__subclasses__():
        yield from kinds(below)


def test_every_error_is_in_the_reference(site):
    text = (site / "reference/errors.html").read_text()
    named = [kind.__name__ for kind in kinds() if kind.__module__ == "jawusd.base.errors"]
    assert len(named) > 10
    assert [name for name in named if f">{name}</code>" not in text] == []


def test_pages_link_to_the_glossary(site):
    linked = 'class="term" href="../glossary.html#'
    people = [path for folder in ("start", "guides", "explanation") for path in (site / folder).glob("*.html")]
    assert len(people) > 20
    assert [path.name for path in people if linked not in path.read_text()] == []


def test_terms_of_others_are_not_linked(site):
    text = (site / "benchmarks.html").read_text()
    assert "Cramer-Rao bound" in text
    assert ">model</a>" in text


@pytest.fixture(scope="module")
def chromium():
    yield from headless_chromium()


@pytest.mark.slow
def test_no_page_is_wider_than_a_phone(site, chromium):
    context = chromium.new_context(viewport={"width": 390, "height": 844}, color_scheme="dark", offline=True)
    page, wide = context.new_page(), []
    for path in sorted(site.rglob("*.html")):
        page.goto(path.as_uri(), wait_until="load")
        if page.evaluate("document.documentElement.scrollWidth") > 390:
            wide.append(path.name)
    assert wide == []
    page.goto((site / "start/film.html").as_uri())
    keep_picture(page, "docs_film_390_dark", full_page=True)
    page.set_content("<table style='width: 800px'><tr><td>x</td></tr></table>")
    assert page.evaluate("document.documentElement.scrollWidth") > 390
    context.close()
