"""Rigs from unknown sources: no file outside their folder is read, by any kind of reference."""

import os
import subprocess
import sys

import pytest
from pxr import Sdf, Usd

from jawusd.base.errors import RigError
from jawusd.base.inputs import SETTING
from jawusd.rig import asset_paths, describe, untrusted
from jawusd.rig.asset_paths import file_of
from jawusd.rig.publish import write_package
from jawusd.rig.read import open_stage

OUTSIDE = '#usda 1.0\nover "Actor" {\n    string jaw:actor = "evil"\n    double jaw:d1 = 7\n}\n'


@pytest.fixture
def elsewhere(tmp_path):
    """Return a folder with layers that rigs must not read."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    for name in ("evil.usda", "clip.1.usda", "clip.2.usda"):
        (folder / name).write_text(OUTSIDE)
    return folder


def clips(values):
    return f'#usda 1.0\nover "Actor" (\n    clips = {{ dictionary default = {{\n{values}\n    }} }}\n)\n{{\n}}\n'


def named_by(how, elsewhere):
    """Return the text of a layer that refers to a file in another folder."""
    template = f'string templateAssetPath = "{elsewhere}/clip.#.usda"\ndouble templateStartTime = 1'
    template += "\ndouble templateEndTime = 2\ndouble templateStride = 1"
    times = "double2[] active = [(0, 0)]\ndouble2[] times = [(0, 0), (9, 9)]"
    arguments = "SDF_FORMAT_ARGS:a=b.c/d"
    return {
        "format arguments": f"#usda 1.0\n( subLayers = [@{elsewhere}/evil.usda:SDF_FORMAT_ARGS:a=b@] )\n",
        "dotted arguments": f'#usda 1.0\nover "A" ( references = @{elsewhere}/evil.usda:{arguments}@ ) {{}}\n',
        "expression": f"#usda 1.0\n( subLayers = [@`\"{elsewhere}/evil.usda\"`@] )\n",
        "clip template": clips(f'{template}\nstring primPath = "/Actor"'),
        "clips": clips(f'asset[] assetPaths = [@{elsewhere}/evil.usda@]\nstring primPath = "/Actor"\n{times}'),
        "clip manifest": clips(
            f'asset[] assetPaths = [@./rig.usdc@]\nasset manifestAssetPath = @{elsewhere}/evil.usda@\n'
            f'string primPath = "/Actor"\n{times}'
        ),
        "picture": f'#usda 1.0\nover "Actor" {{\n    asset inputs:file = @{elsewhere}/letter.png@\n}}\n',
        "graph": f'#usda 1.0\nover "Actor" {{\n    asset jaw:onnx = @{elsewhere}/letter.onnx@\n}}\n',
        "sound in a list": f'#usda 1.0\nover "Actor" {{\n    asset[] sounds = [@./a.wav@, @{elsewhere}/b.wav@]\n}}\n',
    }[how]  # fmt: skip


WAYS = ["format arguments", "dotted arguments", "expression", "clip template", "clips", "clip manifest", "picture",
        "graph", "sound in a list"]  # fmt: skip


@pytest.mark.parametrize("how", WAYS)
def test_a_shot_reads_nothing_elsewhere_but_rigs(how, anchored_folder, elsewhere):
    shot = anchored_folder / "shot.usda"
    shot.write_text(named_by(how, elsewhere))
    with pytest.raises(RigError, match="outside the folder of this file"):
        open_stage(shot)


@pytest.mark.parametrize("how", WAYS)
def test_a_rig_reads_nothing_elsewhere(how, anchored_folder, elsewhere):
    (anchored_folder / "more.usda").write_text(named_by(how, elsewhere))
    layer = Sdf.Layer.OpenAsAnonymous(str(anchored_folder / "actor.usda"))
    layer.subLayerPaths.insert(0, "./more.usda")
    layer.Export(str(anchored_folder / "actor.usda"))
    with pytest.raises(RigError, match="outside the folder of this file"):
        describe(anchored_folder / "actor.usda")


def test_shots_pack_no_files_from_elsewhere(anchored_folder, elsewhere, tmp_path):
    """A package would contain them."""
    (elsewhere / "letter.png").write_text("between us")
    for name in (f"{elsewhere}/letter.png", "./link.png"):
        text = f'( defaultPrim = "Actor" )\ndef "Actor" ( references = @actor.usda@ ) {{\n    asset a = @{name}@\n}}\n'
        (anchored_folder / "shot.usda").write_text(f"#usda 1.0\n{text}")
        (anchored_folder / "link.png").unlink(missing_ok=True)
        (anchored_folder / "link.png").symlink_to(elsewhere / "letter.png")
        with pytest.raises(RigError, match="outside the folder of this file"):
            write_package(tmp_path / "shot.usdz", anchored_folder / "shot.usda")
    assert not (tmp_path / "shot.usdz").exists()


def test_clips_that_link_elsewhere_are_not_read(anchored_folder, elsewhere):
    (anchored_folder / "clip.1.usda").symlink_to(elsewhere / "clip.1.usda")
    text = named_by("clip template", elsewhere).replace(str(elsewhere), ".")
    (anchored_folder / "shot.usda").write_text(text)
    with pytest.raises(RigError, match="outside the folder of this file"):
        open_stage(anchored_folder / "shot.usda")


@pytest.mark.parametrize("how", WAYS)
def test_folders_that_were_allowed_are_read_by_every_way(how, anchored_folder, elsewhere, monkeypatch):
    monkeypatch.setenv(SETTING, str(elsewhere))
    shot = anchored_folder / "shot.usda"
    shot.write_text(named_by(how, elsewhere))
    assert open_stage(shot)


def test_clips_in_the_own_folder_are_read(anchored_folder, elsewhere):
    for name in ("clip.1.usda", "clip.2.usda"):
        (elsewhere / name).rename(anchored_folder / name)
    shot = anchored_folder / "shot.usda"
    shot.write_text(named_by("clip template", elsewhere).replace(str(elsewhere), "."))
    assert open_stage(shot).GetAttributeAtPath("/Actor.jaw:d1") is not None


def test_expressions_that_another_layer_turns_elsewhere_are_not_read(anchored_folder, elsewhere):
    """Variables of a stronger layer determine the file of an expression."""
    inner = '#usda 1.0\n( expressionVariables = { string X = "./rig.usdc" }\n subLayers = [@`"${X}"`@] )\n'
    (anchored_folder / "inner.usda").write_text(inner)
    shot = anchored_folder / "shot.usda"
    variables = f'expressionVariables = {{ string X = "{elsewhere}/evil.usda" }}'
    shot.write_text(f"#usda 1.0\n( {variables}\n subLayers = [@./inner.usda@] )\n")
    with pytest.raises(RigError, match="outside the folder of this file"):
        open_stage(shot)


def test_variables_without_expressions_for_paths_are_read(anchored_folder):
    shot = anchored_folder / "shot.usda"
    shot.write_text('#usda 1.0\n( expressionVariables = { string SHOT = "010" }\n subLayers = [@./actor.usda@] )\n')
    assert describe(shot)


def test_files_of_package_paths():
    """The package that OpenUSD opens; for folders with brackets in their names, the file itself."""
    wanted = {
        "/a/rig.usdz[actor.usda]": "/a/rig.usdz",
        "/a/rig.usdz[in.usdz[actor.usda]]": "/a/rig.usdz",
        "/a/x[1]/rig.usdz[actor.usda]": "/a/x[1]/rig.usdz",
        "/a/x[1]/actor.usda": "/a/x[1]/actor.usda",
        "/a/link.usdz[1]/evil.usda": "/a/link.usdz[1]/evil.usda",
        "/a/actor.usda:SDF_FORMAT_ARGS:b=c": "/a/actor.usda",
    }
    assert {name: str(file_of(name)) for name in wanted} == wanted


@pytest.mark.parametrize("name", ["x[1]", "x[", "x]", "rig.usdz[1]"])
def test_rigs_in_folders_of_any_name_are_read(name, anchored_folder, tmp_path):
    folder = anchored_folder.rename(tmp_path / name)
    assert describe(folder / "actor.usda") and describe(folder / "actor.usdz")


def test_rigs_in_folders_that_openusd_cannot_follow_say_so(anchored_folder, tmp_path):
    folder = anchored_folder.rename(tmp_path / "a\nb")
    with pytest.raises(RigError, match="line break"):
        describe(folder / "actor.usda")


def test_links_in_folders_named_like_packages_are_not_read(anchored_folder, elsewhere):
    (anchored_folder / "a.usdz[1]").symlink_to(elsewhere)
    (anchored_folder / "shot.usda").write_text("#usda 1.0\n( subLayers = [@./a.usdz[1]/evil.usda@] )\n")
    with pytest.raises(RigError, match="outside the folder of this file"):
        open_stage(anchored_folder / "shot.usda")


def with_variables(values, rest):
    variables = "\n".join(f"string {name} = '{value}'" for name, value in values.items())
    return f"#usda 1.0\n( expressionVariables = {{\n{variables}\n}}\n {rest} )\n"


def attack_by_a_variable(folder, elsewhere):
    return with_variables({"X": f"{elsewhere}"}, 'subLayers = [@`"${X}/evil.usda"`@]')


def attack_by_a_variable_of_a_variable(folder, elsewhere):
    return with_variables({"X": f'`"{elsewhere}/${{Y}}"`', "Y": "evil.usda"}, 'subLayers = [@`"${X}"`@]')


def attack_by_a_condition(folder, elsewhere):
    text = f"`if(eq(${{X}}, 'a'), '{elsewhere}/evil.usda', './actor.usda')`"
    return with_variables({"X": "a"}, f"subLayers = [@{text}@]")


def attack_by_a_picture(folder, elsewhere):
    return with_variables({"X": "../elsewhere"}, "") + 'def "A" { asset a = @`"${X}/letter.png"`@\n}\n'


def attack_by_a_template(folder, elsewhere):
    values = "string templateAssetPath = '`\"${X}/clip.#.usda\"`'\ndouble templateStartTime = 1"
    values += '\ndouble templateEndTime = 2\ndouble templateStride = 1\nstring primPath = "/Actor"'
    return with_variables({"X": f"{elsewhere}"}, "") + clips(values).removeprefix("#usda 1.0\n")


def attack_by_variables_of_a_referenced_layer(folder, elsewhere):
    inner = with_variables({"X": f"{elsewhere}/letter.png"}, "") + 'def "A" { asset a = @`"${X}"`@\n}\n'
    (folder / "inner.usda").write_text(inner)
    return '#usda 1.0\n( subLayers = [@./inner.usda@] )\ndef "B" ( references = @./inner.usda@</A> ) {}\n'


def attack_by_a_link_with_an_absolute_path(folder, elsewhere):
    (folder / "link.usda").symlink_to(elsewhere / "evil.usda")
    return f"#usda 1.0\n( subLayers = [@{folder}/link.usda@] )\n"


def attack_by_a_linked_folder(folder, elsewhere):
    (folder / "more").symlink_to(elsewhere)
    return f"#usda 1.0\n( subLayers = [@{folder}/more/evil.usda@] )\n"


def attack_by_dots_in_an_absolute_path(folder, elsewhere):
    return f"#usda 1.0\n( subLayers = [@{folder}/../elsewhere/evil.usda@] )\n"


def attack_by_a_search_path(folder, elsewhere):
    """OpenUSD searches the working directory first, for references in any layer."""
    (folder / "below").mkdir()
    (folder / "below" / "inner.usda").write_text("#usda 1.0\n( subLayers = [@x/../../elsewhere/evil.usda@] )\n")
    return "#usda 1.0\n( subLayers = [@below/inner.usda@] )\n"


ATTACKS = [value for name, value in list(globals().items()) if name.startswith("attack_")]


@pytest.mark.parametrize("attack", ATTACKS)
def test_no_path_leads_elsewhere(attack, anchored_folder, elsewhere, monkeypatch):
    monkeypatch.chdir(anchored_folder)
    shot = anchored_folder / "shot.usda"
    shot.write_text(attack(anchored_folder, elsewhere))
    with pytest.raises(RigError, match="outside the folder of this file"):
        open_stage(shot)


def test_a_search_path_leads_to_rigs_alone(anchored_folder, tmp_path):
    """The search path is read when OpenUSD starts."""
    (tmp_path / "elsewhere" / "hero").mkdir(parents=True)
    (tmp_path / "elsewhere" / "evil.usda").write_text(OUTSIDE)
    anchored_folder.rename(tmp_path / "elsewhere" / "hero" / "v1")
    (tmp_path / "shots").mkdir()
    for name, asset in (("rig", "hero/v1/actor.usda"), ("other", "evil.usda")):
        text = f'#usda 1.0\n( defaultPrim = "A" )\ndef "A" ( references = @{asset}@</Actor> ) {{}}\n'
        (tmp_path / "shots" / f"{name}.usda").write_text(text)
    code = "import sys, jawusd; from jawusd.base.errors import RigError\ntry: print(jawusd.load(sys.argv[1]).kind)\n"
    code += "except RigError as error: print(error)"
    said = {}
    for name in ("rig", "other"):
        environment = {**os.environ, "PXR_AR_DEFAULT_SEARCH_PATH": str(tmp_path / "elsewhere")}
        command = [sys.executable, "-c", code, f"{name}.usda"]
        said[name] = subprocess.check_output(command, cwd=tmp_path / "shots", env=environment, text=True)
    assert said["rig"] == "anchored\n"
    assert "evil.usda, which is outside the folder of this file and not a rig" in said["other"]


def test_a_path_that_is_found_beside_the_shot_is_read(anchored_folder):
    """OpenUSD searches there for references of layers in other folders."""
    (anchored_folder / "below").mkdir()
    (anchored_folder / "below" / "inner.usda").write_text("#usda 1.0\n( subLayers = [@actor.usda@] )\n")
    (anchored_folder / "shot.usda").write_text("#usda 1.0\n( subLayers = [@below/inner.usda@] )\n")
    assert describe(anchored_folder / "shot.usda")["actor"] == "example"


def test_a_flattened_shot_is_read(anchored_folder):
    """Flattening writes absolute paths."""
    shot = anchored_folder / "shot.usda"
    Usd.Stage.Open(str(anchored_folder / "anim_capture.usdc")).Export(str(shot))
    assert f"@{anchored_folder}" in shot.read_text()
    assert describe(shot)["animation"]


def test_a_layer_in_a_subfolder_names_what_lies_above_in_the_rigs_folder(anchored_folder):
    """References from a subfolder up to the rig's folder are allowed, but not beyond it."""
    (anchored_folder / "layers").mkdir()
    (anchored_folder / "layers" / "look.usda").write_text('#usda 1.0\ndef "A" { asset a = @../geo.usdc@\n}\n')
    layer = Sdf.Layer.OpenAsAnonymous(str(anchored_folder / "actor.usda"))
    layer.subLayerPaths.insert(0, "./layers/look.usda")
    layer.Export(str(anchored_folder / "actor.usda"))
    assert describe(anchored_folder / "actor.usda")


@pytest.mark.parametrize("where", ["sublayer", "reference", "payload", "over the layer's own"])
def test_expressions_are_read_by_the_variables_they_have(where, anchored_folder):
    named = {
        "sublayer": ('subLayers = [@`"./${X}.usda"`@]', ""),
        "reference": ("", 'def "A" ( references = @`"./${X}.usda"`@ ) {}\n'),
        "payload": ("", f'def "A" ( payload = @`"{anchored_folder}/${{X}}.usda"`@ ) {{}}\n'),
        "over the layer's own": ("", 'def "A" ( references = @./inner.usda@</B> ) {}\n'),
    }[where]
    inner = with_variables({"X": "/nowhere"}, "") + 'def "B" ( references = @`"./${X}.usda"`@ ) {}\n'
    (anchored_folder / "inner.usda").write_text(inner)
    shot = anchored_folder / "shot.usda"
    shot.write_text(with_variables({"X": "actor"}, named[0]) + named[1])
    assert describe(shot)["actor"] == "example"


def test_layers_named_in_endlessly_many_ways_are_refused(anchored_folder, monkeypatch):
    monkeypatch.setattr(untrusted, "_MAX_LAYER_READS", 50)
    for i in range(12):
        arcs = "".join(f'def "{c}" ( references = @./{c}{i + 1}.usda@</A> ) {{}}\n' for c in "ab")
        for c in "ab":
            (anchored_folder / f"{c}{i}.usda").write_text(with_variables({f"X{i}": c}, "") + arcs)
    with pytest.raises(RigError, match="more than 50 ways"):
        untrusted.check_file_access(anchored_folder / "a0.usda")


@pytest.mark.parametrize("name", ["shot.usda", "below.usda"])
def test_a_syntax_error_is_named_with_its_line(name, tmp_path):
    (tmp_path / "shot.usda").write_text("#usda 1.0\n( subLayers = [@./below.usda@] )\n")
    (tmp_path / name).write_text('#usda 1.0\ndef "A" {\n    double x = = 3\n}\n')
    with pytest.raises(RigError, match=r"read: line 3") as found:
        open_stage(tmp_path / "shot.usda")
    assert str(found.value.path).endswith(name)


def test_templates_are_checked_before_openusd_lists_their_folders(anchored_folder, elsewhere, monkeypatch):
    """It lists them whenever it is asked for the asset paths of a layer."""
    asked = []
    monkeypatch.setattr(asset_paths.UsdUtils, "ModifyAssetPaths", lambda *_: asked.append(1))
    (anchored_folder / "shot.usda").write_text(attack_by_a_template(anchored_folder, elsewhere))
    with pytest.raises(RigError, match="outside the folder of this file"):
        open_stage(anchored_folder / "shot.usda")
    assert asked == []
