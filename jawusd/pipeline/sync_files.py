"""What `jawusd sync` writes beside its result: brightness as a table and as a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from jawusd.errors import explain_missing_packages
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.light_curve import LightCurve
from jawusd.pipeline.state import Progress

PLOT_SUFFIXES = (".png", ".svg")


@explain_missing_packages()
def light_curves(videos: Mapping[str, Path], progress: Progress) -> dict[str, LightCurve]:
    """Return the brightness of every picture of every video; decodes all of them.

    Args:
        videos: clips by the names of their cameras.
        progress: told of the work.

    Raises:
        CaptureError: a video cannot be read.
    """
    from jawusd.capture.sync import light_curve

    found = {}
    for name, video in videos.items():
        progress("brightness", len(found), len(videos))
        found[name] = light_curve(video)
    progress("brightness", len(videos), len(videos))
    return found


def write_light_curves(path: Path, curves: Mapping[str, LightCurve]) -> None:
    """Write the mean brightness of every picture as CSV: camera, picture, time_s, brightness.

    Args:
        path: where to.
        curves: of `light_curves`, by camera.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = ["camera,picture,time_s,brightness"]
    for name, curve in curves.items():
        pictures = enumerate(zip(curve.times_s, curve.brightness))
        lines += [f"{name},{k},{time_s:.6f},{mean:.3f}" for k, (time_s, mean) in pictures]
    write_text_atomic(path, "\n".join([*lines, ""]))


@explain_missing_packages()
def write_sync_plot(path: Path, curves: Mapping[str, LightCurve], result: Mapping | None) -> None:
    """Draw the brightness of all clips before and after they were aligned.

    Args:
        path: .png or .svg.
        curves: by camera name.
        result: what `stages.sync_cameras` found; None if the cameras could not be aligned.

    Raises:
        OutputError: the file cannot be written.
        MissingDependencyError: matplotlib is not installed.
    """
    from jawusd.report.sync_plot import draw_sync

    title, offsets = "the cameras could not be aligned", None
    if result is not None:
        offsets = result["offsets"]
        listed = ", ".join(f"{name} {offsets[name]:+d}" for name in curves)
        title = f"aligned ({result['method']}): {listed} frames"
    draw_sync(curves, offsets, title, path)
