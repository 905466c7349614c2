"""Nesting of layers: what would end the process is refused, what studios write is read."""

import subprocess
import sys
import zipfile

import numpy as np
import pytest
from pxr import Sdf

from jawusd.errors import RigError
from jawusd.rig.nesting import MOST_LEVELS, is_too_deep
from jawusd.rig.read import open_stage

HEADER = "#usda 1.0\n"


def nested(kind, levels):
    """Return the text of a valid layer."""
    return HEADER + {
        "prims": 'def "a" {\n' * levels + "}\n" * levels,
        "dictionaries": "( customLayerData = {" + "dictionary a = {\n" * levels + "}\n" * levels + "} )\n",
        "variant sets": 'def "A" {\n' + 'variantSet "v" = { "x" {\n' * levels + "}}\n" * levels + "}\n",
        "lists": 'def "A" {\ncustom double[] x = ' + "[" * levels + "1" + "]" * levels + "\n}\n",
        "comments between": "/* ) */".join(["[ # ]\n"] * levels),
        "paths": 'def "A" (\ninherits = <' + "/a" * levels + ">\n) {\n}\n",
        "expressions": '( subLayers = [@`' + "if(true, " * levels + '"x"' + ")" * levels + "`@] )\n",
        "expressions that close in text": '( subLayers = [@`' + 'if(")",' * levels + '"x"' + ")" * levels + "`@] )\n",
        "closed in strings": '")"\n("""\n""" # )\n' * levels,
    }[kind]  # fmt: skip


KINDS = ["prims", "dictionaries", "variant sets", "lists", "comments between", "paths", "expressions",
         "expressions that close in text", "closed in strings"]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_layers_that_would_end_the_process_are_refused(kind, tmp_path):
    file = tmp_path / "deep.usda"
    file.write_text(nested(kind, 20_000))
    with pytest.raises(RigError, match="nested too deeply"):
        open_stage(file)


@pytest.mark.parametrize("kind", ["prims", "variant sets"])
def test_layers_in_packages_are_refused(kind, tmp_path):
    with zipfile.ZipFile(tmp_path / "deep.usdz", "w", zipfile.ZIP_STORED) as package:
        package.writestr(zipfile.ZipInfo("first.usda"), HEADER)
        package.writestr(zipfile.ZipInfo("deep.usda"), nested(kind, 20_000))
    with pytest.raises(RigError, match="nested too deeply"):
        open_stage(tmp_path / "deep.usdz")


def test_binary_layers_with_deep_prims_are_refused(tmp_path):
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(nested("prims", 600))
    layer.Export(str(tmp_path / "deep.usdc"))
    with pytest.raises(RigError, match="nested too deeply"):
        open_stage(tmp_path / "deep.usdc")


@pytest.mark.parametrize("arc", ["inherits", "specializes", "references", "payload"])
def test_binary_layers_that_name_deep_prims_are_refused(arc, tmp_path):
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(f'{HEADER}def "A" (\n{arc} = <{"/a" * 400}>\n) {{\n}}\n')
    layer.Export(str(tmp_path / "deep.usdc"))
    with pytest.raises(RigError, match="nested too deeply"):
        open_stage(tmp_path / "deep.usdc")


@pytest.mark.parametrize("kind", ["prims", "dictionaries", "variant sets", "lists"])
def test_nesting_below_the_limit_is_read(kind, tmp_path):
    (tmp_path / "layer.usda").write_text(nested(kind, MOST_LEVELS // 2 - 2))
    assert open_stage(tmp_path / "layer.usda")


@pytest.mark.parametrize("value", ['"""%s"""', "'''%s'''", '"%s"', "'%s'", '"\\"%s"', '"""\\"""%s"""', '"a\\\\" # %s'])
def test_brackets_in_text_are_no_nesting(value, tmp_path):
    text = f'{HEADER}( doc = {value % ("([{" * 5000)}\n)\ndef "A" {{\n    // {"(" * 999}\n    /* {"[" * 999} */\n}}\n'
    (tmp_path / "layer.usda").write_text(text)
    assert open_stage(tmp_path / "layer.usda").GetPrimAtPath("/A")


@pytest.mark.parametrize("path", ["@./a%s.png@", "@@@./a@%s.png@@@", "@@@./a\\@@@%s@@@@@"])
def test_brackets_in_asset_paths_are_no_nesting(path, tmp_path):
    text = f'{HEADER}def "A" {{\n    asset x = {path % ("[" * 999)}\n    asset y = @b"c.png@\n}}\n'
    (tmp_path / "layer.usda").write_text(text)
    assert not is_too_deep(tmp_path / "layer.usda")
    assert Sdf.Layer.FindOrOpen(str(tmp_path / "layer.usda"))


def test_numbers_are_read(tmp_path):
    """Points and matrices as text, with more brackets than are held at once."""
    points = np.random.default_rng(0).normal(size=(3000, 3)).round(4).tolist()
    text = f'{HEADER}def "A" {{\n    point3f[] points = {[tuple(p) for p in points]}\n}}\n'
    (tmp_path / "layer.usda").write_text(text)
    assert len(open_stage(tmp_path / "layer.usda").GetAttributeAtPath("/A.points").Get()) == 3000


def test_hostile_repetition_is_read_in_linear_time(tmp_path):
    """Patterns over text that try every beginning never end on these."""
    parts = ['"a\n', '"""\\"""', "@@@a\n", "/*a", "<a/", "'''", "( ", "'\\\\", "@`("]
    for part in parts:
        (tmp_path / "layer.usda").write_text(HEADER + part * (4_000_000 // len(part)) + "x")
        is_too_deep(tmp_path / "layer.usda")


def test_the_limit_lies_below_where_small_stacks_end(tmp_path):
    """OpenUSD opens what is read in a thread with the smallest stack that systems give, 512 kB."""
    for kind in ("prims", "dictionaries", "variant sets", "lists", "paths"):
        (tmp_path / f"{kind}.usda").write_text(nested(kind, MOST_LEVELS // (2 if kind == "variant sets" else 1) - 2))
    code = f"""
import pathlib, threading
from pxr import Usd
threading.stack_size(512 * 1024)
for file in pathlib.Path({str(tmp_path)!r}).iterdir():
    thread = threading.Thread(target=lambda: Usd.Stage.Open(str(file)))
    thread.start()
    thread.join()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
