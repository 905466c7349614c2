"""Add to every build of the site: the reference made from the code, the page of the example rig, pictures of examples/.

mkdocs loads this file as a hook (mkdocs.yml); nothing that it makes is stored.
"""

import sys
import tempfile
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

import reference_commands  # noqa: E402
import reference_files  # noqa: E402
import reference_python  # noqa: E402
import reference_tables  # noqa: E402

from jawusd.pipeline.view import write_page  # noqa: E402
from jawusd.rig.layout import EXAMPLE_RIG  # noqa: E402

PICTURES = ("overlay.png", "face_solver.png")


def pages():
    """Return the text of every generated page by its place in the site."""
    return {
        "reference/commands.md": reference_commands.page(),
        "reference/capture-toml.md": reference_tables.capture_page(),
        "reference/usd.md": reference_tables.usd_page(),
        "reference/errors.md": reference_tables.errors_page(),
        "reference/files.md": reference_files.page(),
        **reference_python.pages(),
    }


def jaw_page():
    """Return the web page that poses the example rig."""
    with tempfile.TemporaryDirectory() as folder:
        write_page(EXAMPLE_RIG, Path(folder) / "jaw.html")
        return (Path(folder) / "jaw.html").read_text(encoding="utf-8")


def on_files(files, config):
    """Add the generated pages and the pictures."""
    files.append(File.generated(config, "jaw.html", content=jaw_page()))
    for place, text in pages().items():
        files.append(File.generated(config, place, content=text))
    for name in PICTURES:
        files.append(File.generated(config, f"pictures/{name}", abs_src_path=str(ROOT / "examples/pictures" / name)))
    return files
