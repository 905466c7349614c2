"""Masks that jawusd made are known as such, and the tracker allows them more than drawn ones."""

from package_copy import ROOT

from jawusd.formats.capture import load_capture
from jawusd.pipeline.segment import with_masks
from jawusd.pipeline.segment_record import SUMMARY, has_auto_masks
from jawusd.pipeline.track import tracking_config
from jawusd.tracking import TrackingConfig


def test_only_masks_beside_a_summary_of_segmentation_are_made(tmp_path):
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    capture = with_masks(given, tmp_path)
    assert not has_auto_masks(given) and not has_auto_masks(capture)
    (tmp_path / SUMMARY).write_text("{}")
    assert has_auto_masks(capture)
    mixed = capture.model_copy(update={"cameras": (capture.cameras[0], *given.cameras[1:])})
    assert not has_auto_masks(mixed)
    none = tuple(camera.model_copy(update={"masks": None}) for camera in capture.cameras)
    assert not has_auto_masks(capture.model_copy(update={"cameras": none}))


def test_drawn_masks_are_judged_by_the_usual_numbers(tmp_path):
    given = load_capture(ROOT / "examples" / "capture" / "capture.toml")
    (tmp_path / SUMMARY).write_text("{}")
    assert tracking_config(given) == TrackingConfig()
    made = tracking_config(with_masks(given, tmp_path))
    assert made.suspect_residual > TrackingConfig().suspect_residual
