"""Masks that jawusd made are known as such, and the tracker allows them more than drawn ones."""

from types import SimpleNamespace

import numpy as np
import pytest
from package_copy import ROOT

from jawusd.formats.capture import load_capture
from jawusd.geometry import make_transform
from jawusd.pipeline.segment import with_masks
from jawusd.pipeline.segment_guide import guide_findings, save_guide
from jawusd.pipeline.segment_record import SUMMARY, auto_masks_folder
from jawusd.pipeline.track import tracking_config
from jawusd.tracking import TrackingConfig
from jawusd.tracking.region.tracker import RegionPose


def test_only_masks_beside_a_summary_of_segmentation_are_made(tmp_path):
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    capture = with_masks(given, tmp_path)
    assert auto_masks_folder(given) is None and auto_masks_folder(capture) is None
    (tmp_path / SUMMARY).write_text("{}")
    assert auto_masks_folder(capture) == tmp_path
    mixed = capture.model_copy(update={"cameras": (capture.cameras[0], *given.cameras[1:])})
    assert auto_masks_folder(mixed) is None
    none = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    assert auto_masks_folder(capture.model_copy(update={"cameras": none})) is None


def test_drawn_masks_are_judged_by_the_usual_numbers(tmp_path):
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    (tmp_path / SUMMARY).write_text("{}")
    assert tracking_config(given) == TrackingConfig()
    made = tracking_config(with_masks(given, tmp_path))
    assert made.suspect_residual > TrackingConfig().suspect_residual


@pytest.mark.parametrize(
    ("wrong", "lost", "words"), [(0, 0, None), (1, 0, None), (2, 3, "in parts"), (9, 2, "not usable")]
)
def test_masks_and_colours_that_disagree_make_footage_doubtful(tmp_path, wrong, lost, words):
    frames = np.arange(10, 50)
    guide = {int(f): RegionPose(np.tile(np.eye(4), (2, 1, 1)), np.ones(2, bool)) for f in frames}
    save_guide(tmp_path, "inputs", guide)
    (tmp_path / SUMMARY).write_text("{}")
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    poses = np.tile(make_transform(np.eye(3), [0.3, 0.0, 0.0]), (len(frames), 1, 1))
    poses[:wrong, 1, 3] = 1.5  # mm
    poses[wrong : wrong + lost] = np.nan
    tracks = SimpleNamespace(frames=frames, raw_T_upper_lower=poses)
    found = guide_findings(with_masks(given, tmp_path), tracks, np.eye(3))
    assert guide_findings(given, tracks, np.eye(3)) == []  # drawn masks
    if words is None:
        assert found == []
    else:
        assert words in found[0].message and f"{wrong + lost} of 40" in found[0].message and found[0].frame == 10
