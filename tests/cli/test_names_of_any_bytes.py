"""Every command in folders with unusual names: it works, or fails with one plain message."""

import functools
import json
import os
import shutil
import subprocess
import sys
import unicodedata

import numpy as np
import pytest
from example_rig import example_rig
from names_driver import calls
from package_copy import ROOT
from report_data import report_data
from run_jawusd import face_csv
from short_example import write_short

from jawusd.cli.commands import SUMMARIES
from jawusd.formats.keys import load_keys
from jawusd.formats.model import save_model
from jawusd.formats.poses import write_parameters
from jawusd.formats.tracks import save_tracks
from jawusd.pipeline.state import BuildState

NAMES = {
    "signs": "-o --force %d #* $x'\"`{} \U0001f9b7 zähne".encode(),
    "control": "a\nerror: b \x1b[31mred\x07 \u202eevil\u2066".encode(),
    "not UTF-8": b"take\xff\xfe\xe4",
    "255 bytes": b"n" * 255,
}
#: With locale C, Python uses UTF-8 unless told not to; then names are ASCII.
LOCALES = {"UTF-8": {"LC_ALL": "C"}, "ASCII": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}}
# Commands that work with any name; only OpenUSD, and texts that contain the name, do not support all of them.
ALWAYS = {"doctor", "pose of a model", "fit", "sync"}
KNOWN_CODES = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12}


@pytest.fixture(scope="module")
def files(tmp_path_factory, actor):
    """A folder with inputs of every kind."""
    folder = tmp_path_factory.mktemp("files")
    shutil.copytree(actor.parent, folder / "rig")
    data = report_data(count=90)
    save_model(folder / "rig" / "model.npz", data.model)
    save_tracks(folder / "rig" / "tracks.npz", data.tracks)
    state = BuildState(folder / "rig")
    state.finish("sync", "", [folder / "rig" / "model.npz"], 1.0, {"offsets": {}, "method": "given"})
    write_short(folder / "capture", 16)
    shutil.copytree(folder / "capture", folder / "broken")
    (folder / "broken" / "scans" / "upper_teeth.ply").write_bytes(b"ply\n")
    (folder / "footage").mkdir()
    (folder / "footage" / "left.mp4").write_bytes(b"x")
    (folder / "list.txt").write_text("broken\n")
    (folder / "line.png").write_bytes(b"x")
    d = np.stack([np.linspace(0, 12, 40), np.zeros(40), np.zeros(40)], axis=1)
    write_parameters(folder / "d.csv", np.arange(40), d)
    rows = [",".join(["frame", *(f"m{i}{j}" for i in range(4) for j in range(4))])]
    rows += [",".join(map(str, [k, *T.ravel()])) for k, T in enumerate(example_rig().pose(d))]
    (folder / "poses.csv").write_text("\n".join(rows))
    face_csv(folder / "face.csv", [(0.1, 0, 0, 0)] * 40)
    keys = {"fps": 24, "interpolation": "linear", "keys": [{"frame": 0, "d": [0, 0, 0]}, {"frame": 5, "d": [5, 0, 0]}]}
    (folder / "keys.json").write_text(json.dumps(keys))
    load_keys(folder / "keys.json")
    return folder


def test_all_commands_are_called():
    assert {words[0] for words in calls("x").values()} == set(SUMMARIES)


IN_LOCALE = {"UTF-8": tuple(NAMES), "ASCII": ("signs", "not UTF-8")}


@pytest.fixture(scope="module")
def ended(files, tmp_path_factory):
    """Return the function that says how every command ended in the folders of a locale, by name.

    One process runs all of them: starting one takes longer than most commands. A name that the file system does not
    support has no outcome.
    """

    @functools.cache
    def ended_in(locale):
        desk = tmp_path_factory.mktemp("desk")
        names = [name for name in IN_LOCALE[locale] if copied(files, os.path.join(os.fsencode(desk), NAMES[name]))]
        if locale == "UTF-8":  # a build of all stages; a name that they take, others take
            with open(os.path.join(os.fsencode(desk), NAMES["signs"], b"list.txt"), "w") as captures:
                captures.write("capture\n")
        folders = [b"./" + NAMES[name] if NAMES[name].startswith(b"-") else NAMES[name] for name in names]
        driver = ROOT / "tests" / "support" / "names_driver.py"
        environment = {**os.environ, **LOCALES[locale], "PYTHONPATH": str(ROOT)}
        command = [sys.executable, str(driver), *folders]
        done = subprocess.run(command, cwd=desk, env=environment, capture_output=True, timeout=900, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
        return dict(zip(names, json.loads(done.stdout), strict=True))

    return ended_in


def copied(files, place):
    """Copy the inputs to a folder; tell whether the file system supports its name."""
    try:
        shutil.copytree(os.fsencode(files), place)
    except OSError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize(("locale", "name"), [(locale, name) for locale, names in IN_LOCALE.items() for name in names])
def test_no_name_of_a_folder_ends_a_command_in_a_traceback(ended, name, locale):
    found = ended(locale).get(name)
    if found is None:
        pytest.skip("no such names here")
    assert [(call, end["trace"]) for call, end in found.items() if end["trace"]] == []
    for call, end in found.items():
        assert end["code"] in KNOWN_CODES and "Traceback" not in end["err"], (call, end)
        printed = end["err"] + end["out"]
        hidden = [letter for letter in printed if unicodedata.category(letter) in ("Cc", "Cf", "Cs") and letter != "\n"]
        assert hidden == [], (call, printed)
        assert end["code"] in (0, 1) or "jawusd: " in end["err"] or "Usage: " in end["err"], (call, end)
        assert "not a USD file" not in end["err"], (call, end)
    if name in ("signs", "255 bytes"):
        for call in ("info", "pose", "validate", "animate", "encode", "cameras", "report", "view"):
            assert found[call]["code"] == 0 or locale == "ASCII", (call, found[call])
    assert {call: found[call]["err"] for call in ALWAYS if found[call]["code"] not in (0, 1)} == {}
