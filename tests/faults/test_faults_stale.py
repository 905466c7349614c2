"""A changed input or setting invalidates exactly the stages that depend on it."""

import os
import shutil

import pytest
from package_copy import ROOT
from stage_results import stage_result

from jawusd.base.errors import CaptureError
from jawusd.pipeline import build, workspace
from jawusd.pipeline.build import BuildOptions
from jawusd.pipeline.workspace import Workspace, input_files, open_capture

EXAMPLE = ROOT / "examples" / "capture"
FROM_TRACK = ["track", "fit", "refine", "bake", "report"]
OFFSETS = {"cam0": 0, "cam1": 2, "cam2": -1}


@pytest.fixture
def capture(tmp_path):
    """A copy of the example; its files are links until a test replaces them."""
    folder = tmp_path / "capture"
    same_disk = EXAMPLE.stat().st_dev == tmp_path.stat().st_dev
    shutil.copytree(EXAMPLE, folder, copy_function=os.link if same_disk else shutil.copy)
    return folder


@pytest.fixture
def rebuilt(monkeypatch, tmp_path, capture):
    """Return a function that builds with stages that only write what they depend on, and returns those that ran."""
    ran, meanwhile = [], {}

    def stub(name, write):
        def work(run, *others):
            ran.append(name)
            meanwhile.pop(name, lambda: None)()
            path = run.folder / f"{name}.txt"
            path.write_text(write(run, *others))
            return [path], stage_result(name, run.capture.sync.offsets or OFFSETS)

        monkeypatch.setattr(build, f"_{name}", work)

    for name in ("sync", "track", "refine", "bake", "report"):
        stub(name, lambda *_: "always the same")
    stub("fit", lambda run, options: f"{run.capture.name} {run.capture.fps} {options.model}")
    monkeypatch.setattr(build, "build_summary", dict, raising=False)
    # the changed files need not be readable
    monkeypatch.setattr(build, "check_capture", lambda *_, **__: [])
    monkeypatch.setattr(build, "all_labelled", lambda _: True)

    def run(during=None, change=None, **options):
        """Build, and change the capture while a stage runs."""
        ran.clear()
        meanwhile.clear()
        if during:
            meanwhile[during] = lambda: change(capture)
        build.build(capture, tmp_path / "out", BuildOptions(resume=True, **options), lambda *_: None)
        return list(ran)

    return run


def replace(path, change):
    """Write a modified file without writing through a link."""
    data = change(path.read_bytes())
    path.unlink()
    path.write_bytes(data)


def edit(old, new):
    """Return a function that changes capture.toml."""

    def change(folder):
        def swapped(data):
            assert old.encode() in data
            return data.replace(old.encode(), new.encode(), 1)

        replace(folder / "capture.toml", swapped)

    return change


def grow(name):
    """Return a function that changes a file's content in a way that its reader may ignore."""
    return lambda folder: replace(folder / name, lambda data: data + b"\n")


def bone_as_another(folder):
    edit('mandible = "scans/mandible.ply"\n', "")(folder)
    edit("scans/skull.ply", "scans/mandible.ply")(folder)


@pytest.mark.parametrize(
    ("change", "stale"),
    [
        (lambda folder: None, []),
        (grow("scans/upper_teeth.ply"), FROM_TRACK),
        (grow("scans/lower_teeth.ply"), FROM_TRACK),
        (grow("scans/mandible.ply"), FROM_TRACK),
        (grow("scans/skull.ply"), ["bake", "report"]),
        (bone_as_another, FROM_TRACK),
        (grow("masks/cam1/lower.mkv"), FROM_TRACK),
        (grow("calibration.toml"), FROM_TRACK),
        (grow("video/cam2.mp4"), ["sync", "report"]),
        (edit("fps = 24.0", "fps = 24.5"), ["sync", "fit", "refine", "bake", "report"]),
        (edit('name = "synthetic_0"', 'name = "other"'), ["fit", "refine", "bake", "report"]),
        (edit("frames = [20, 320]", "frames = [20, 300]"), FROM_TRACK),
        (edit("x = 793.13", "x = 793.5"), FROM_TRACK),
        (edit("[motion]", "[anatomy.landmarks]\nincisor = [0.0, 1.0, 2.0]\n\n[motion]"), FROM_TRACK),
        (edit('calibration = "calibration.toml"', 'calibration = "calibration.toml"\ncalibration_unit_mm = 2.0'),
         FROM_TRACK),
        (edit('method = "flash"', 'method = "audio"'), ["sync"]),
        (edit('method = "flash"', "offsets = {cam0 = 0, cam1 = 1, cam2 = 1}"), ["sync", *FROM_TRACK]),
    ],
)  # fmt: skip
def test_a_change_redoes_exactly_what_depends_on_it(rebuilt, capture, change, stale):
    assert rebuilt() == ["sync", *FROM_TRACK]
    change(capture)
    assert rebuilt() == stale
    assert rebuilt() == []


@pytest.mark.parametrize(
    ("options", "stale"),
    [
        ({"model": "additive"}, ["fit", "refine", "bake", "report"]),
        ({"solver": "paper"}, FROM_TRACK),
        ({"solver": "contour", "jobs": 7}, []),
    ],
)
def test_an_option_redoes_exactly_what_depends_on_it(rebuilt, options, stale):
    rebuilt()
    assert rebuilt(**options) == stale


def test_a_moved_capture_is_the_same_capture(rebuilt, capture, tmp_path):
    rebuilt()
    capture.rename(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").rename(capture)
    assert rebuilt() == []


def test_files_beside_numbered_masks_do_not_count(capture):
    folder = capture / "masks" / "cam0" / "numbered"
    folder.mkdir()
    for name in ("000001.png", "000002.png", ".jawusd-tmp-000003-x.png", "notes.txt", "Thumbs.db"):
        (folder / name).write_bytes(b"x")
    edit("masks/cam0/upper.mkv", "masks/cam0/numbered/%06d.png")(capture)
    found = input_files(open_capture(capture), ["masks"])["masks cam0 upper"]
    assert [path.name for path in found] == ["000001.png", "000002.png"]


@pytest.mark.parametrize("stage", ["track", "fit", "refine"])
@pytest.mark.parametrize(
    ("change", "named"),
    [
        (grow("masks/cam1/lower.mkv"), "masks cam1 lower"),
        (grow("scans/upper_teeth.ply"), "upper_teeth"),
        (grow("video/cam2.mp4"), "video cam2"),
        (grow("calibration.toml"), "calibration"),
        (edit("frames = [20, 320]", "frames = [20, 300]"), r"capture\.toml"),
        (edit("[motion]", "[motion"), r"capture\.toml"),
        (lambda folder: (folder / "masks/cam0/upper.mkv").unlink(), "masks cam0 upper"),
    ],
)
def test_inputs_that_change_while_a_stage_runs_stop_the_build(rebuilt, capture, stage, change, named):
    with pytest.raises(CaptureError, match=rf"changed while the stage {stage} ran: .*{named}.* is not recorded"):
        rebuilt(during=stage, change=change)


def test_a_stage_that_met_edited_inputs_runs_again(rebuilt, capture):
    with pytest.raises(CaptureError, match="refine"):
        rebuilt(during="refine", change=grow("masks/cam1/lower.mkv"))
    assert rebuilt() == FROM_TRACK
    with pytest.raises(CaptureError, match="bake"):
        rebuilt(during="bake", change=edit('name = "synthetic_0"', 'name = "other"'), model="pca")
    assert rebuilt(model="pca") == ["fit", "refine", "bake", "report"]


def touch(name):
    return lambda folder: os.utime(folder / name)


@pytest.mark.parametrize(
    "change",
    [
        touch("masks/cam1/lower.mkv"),
        grow("masks/cam1/notes.txt"),
        edit("[motion]", "# a remark\n[motion]"),
        lambda folder: replace(folder / "scans/upper_teeth.ply", bytes),
    ],
)
def test_what_only_looks_like_a_change_stops_nothing(rebuilt, capture, change):
    (capture / "masks/cam1/notes.txt").write_text("x")
    assert rebuilt(during="track", change=change) == ["sync", *FROM_TRACK]


def test_untouched_inputs_are_read_once(capture, monkeypatch, tmp_path):
    read = []
    monkeypatch.setattr(workspace, "hash_files", lambda files: read.extend(files) or str(files))
    run = Workspace(tmp_path / "out", open_capture(capture), lambda: open_capture(capture))
    for _ in range(3):
        assert run.hashes(["masks", "teeth"]) and run.changed_inputs() == []
    assert len(read) == len(set(read)) == 8
    grow("masks/cam1/lower.mkv")(capture)
    run.changed_inputs()
    assert len(read) == 9
