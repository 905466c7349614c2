"""Text output of the commands on captures and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jawusd.base.guard import SETTING
from jawusd.cli.output import shortened
from jawusd.formats.finding import Finding

if TYPE_CHECKING:
    from jawusd.formats.notes import CalibrationNotes, SyncNotes
    from jawusd.geometry import Camera
    from jawusd.photographs.align import PhotographFiles
    from jawusd.pipeline.check import Examined
    from jawusd.pipeline.scans import ScansSummary
    from jawusd.pipeline.segment_record import SegmentSummary
    from jawusd.pipeline.start_capture import CaptureStart


def check_lines(findings: Sequence[Finding]) -> list[str]:
    """Return findings as text, with a last line that counts them."""
    counts = [(sum(f.severity == kind for f in findings), kind) for kind in ("error", "warning", "note")]
    counted = ", ".join(f"{count} {kind}{'' if count == 1 else 's'}" for count, kind in counts)
    return [*(finding.line() for finding in findings), counted]


_LISTED = 10  # maximum number of images listed per camera
_LISTED_MASKS = 12


def calibration_lines(report: CalibrationNotes) -> list[str]:
    """Return a calibration report as text."""
    lines = [f"calibrated from {report['views']} views of the board"]
    for name, camera in report["cameras"].items():
        line = (
            f"  {name}: {camera['rms_px']:.3f} px rms, {camera['views']} views, {camera['coverage']:.0%} of the image"
        )
        for word, images in (("blurred", camera["blurred"]), ("missed", camera["missed"])):
            line += f"; {word}: {shortened(images, _LISTED)}" if images else ""
        lines.append(line)
    shape = report["board_shape"]
    if shape["distances"]:
        lines.append(
            f"  error of distances on the boards near the mouth: {shape['mean']:.4f} mm (mean), {shape['p95']:.4f} "
            f"(p95), {shape['max']:.4f} (max)"
        )
    lines.append(
        f"  expected error of distances in the mouth, from the noise of the corners: {report['expected_shape_mm']:.4f} "
        f"mm (mean); centre of the mouth from {report['mouth_from']}"
    )
    if (ratio := report["scale"]["ratio"]) is not None:
        lines.append(f"  the teeth confirm the board's size: scale {ratio:.4f} (+-{report['scale']['sigma']:.4f})")
    return lines + [f"  note: {note}" for note in report["notes"]] + [f"  advice: {text}" for text in report["advice"]]


def sync_lines(result: SyncNotes) -> list[str]:
    """Return frame offsets as text."""
    exact, sure = result.get("exact_frames", {}), result.get("confidence", {})
    lines = [f"by {result['method']}:"]
    for name, offset in result["offsets"].items():
        more = f" (exactly {exact[name]:+.2f}, confidence {sure[name]:.2f})" if name in exact else ""
        lines.append(f"  {name}: {offset:+d} frames{more}")
    return lines + [f"  note: {note}" for note in result.get("notes", [])]


def segment_lines(summary: SegmentSummary) -> list[str]:
    """Return the summary of a segmentation as text."""
    uncertain = summary["look_at"]
    lines = [f"{summary['frames']} frames segmented in {len(summary['masks'])} cameras"]
    if learned := summary.get("learned"):
        before, after = (f"{100 * value:.1f} %" for value in learned["disagreement"])
        lines.append(f"learned from {learned['pictures']} drawn masks: disagreement {before} before, {after} after")
    if uncertain:
        lines.append(f"{len(uncertain)} masks to inspect, worst first (thumbnails in {summary['sheet']}):")
    for row in uncertain[:_LISTED_MASKS]:
        where = f"  {row['camera']} frame {row['own_frame']:>5}  {row['row']:<5}"
        lines.append(f"{where}  confidence {row['confidence']:.2f}  {row['reason']}")
    return lines


def scans_lines(summary: ScansSummary) -> list[str]:
    """Return `label_scans` as text."""
    lines = []
    for scan in summary["scans"]:
        lines.append(
            f"{scan['arch']}: {scan['faces']} faces in {scan['pieces']} pieces, {scan['crown_percent']} % crown "
            f"(by {scan['labels_by']})"
        )
        cleaned = (
            (scan["merged_vertices"], "duplicate vertices merged"),
            (scan["empty_faces"], "empty faces"),
            (scan["repeated_faces"], "duplicate faces"),
        )
        if found := [f"{count} {what}" for count, what in cleaned if count]:
            lines.append(f"  {', '.join(found)}")
        if scan["labels_file"]:
            lines.append(f"  labels: {scan['labels_file']}")
        lines += [f"  {Finding.from_json(finding).line()}" for finding in scan["findings"]]
    return [*lines, f"picture: {summary['picture']}"]


def start_lines(start: CaptureStart) -> list[str]:
    """Return what was found for a draft capture, and what is missing, as text."""
    folder = start.path.parent
    lines = [f"{start.path}", *(f"  {line}" for line in start.found), *(f"note: {line}." for line in start.notes)]
    lines += [f"missing: {line}." for line in start.missing]
    before = f"Fill in {start.path}, then" if start.missing else "next"
    return [*lines, f"{before}: jawusd check {folder}"]


_LEAST_APART_MM = 10.0  # minimum extent of the camera positions; `capture.camera_checks` rejects captures below it


def camera_lines(cameras: list[Camera], files: list[Path]) -> list[str]:
    """Return cameras as text."""
    lines = []
    for camera in cameras:
        where = ", ".join(f"{value:.1f}" for value in np.round(camera.centre_world(), 1) + 0.0)  # -0.0 becomes 0.0
        lens = f"{camera.distortion.size} coefficients" if camera.distortion.size else "no distortion"
        width, height = camera.size_px
        lines.append(f"{camera.name}: {width} x {height} px, f {camera.K[0, 0]:.1f} px, {lens}, at {where} mm")
    places = np.array([camera.centre_world() for camera in cameras])
    apart = float(np.linalg.norm(np.ptp(places, axis=0)))
    if len(cameras) > 1 and apart < _LEAST_APART_MM:
        lines.append(f"note: all cameras are within {apart:.3g} mm; if the source is in metres, use --unit-mm 1000")
    return [*lines, *map(str, files)]


def examined_lines(found: Examined) -> list[str]:
    """Return the result of `jawusd doctor` as text."""
    memory = "" if found["memory_gb"] is None else f", {found['memory_gb']:g} GB of memory"
    limit = found["memory_limit_gb"]
    works = [name for name, ok in found["codecs"].items() if ok]
    fails = [name for name, ok in found["codecs"].items() if not ok]
    lines = [
        f"jawusd {found['jawusd']}, Python {found['python']}, {found['system']}",
        f"{found['cores']} cores{memory}, {found['free_gb']:g} GB free here",
        f"a command may use {f'{limit:g} GB of memory' if limit else 'all memory'} (set {SETTING} to change it)",
        "packages: " + ", ".join(f"{name} {number}" for name, number in found["versions"].items() if number),
    ]
    for extra, lacking in found["extras"].items():
        lines.append(f"extra {extra}: {'complete' if not lacking else 'missing ' + ', '.join(lacking)}")
    lines.append(f"OpenGL: {found['graphics']}")
    lines.append(f"decodes: {', '.join(works) or 'nothing'}{'; not: ' + ', '.join(fails) if fails else ''}")
    lines.append(f"compiled code: {found['cache']}")
    return [*lines, *(f"problem: {line}." for line in found["problems"])]


def photograph_lines(found: PhotographFiles) -> list[str]:
    """Return the result of an alignment of photographs as text."""
    lines = ["photograph           focal [px]  mirrored  outlines rms / median [px at 1440]  alone [mm]"]
    for photo in found.result.photos:
        lines.append(
            f"{photo.name:20} {photo.focal_px:10.0f}  {'yes' if photo.mirrored else 'no':>8}  "
            f"{photo.outline_rms_px:17.1f} / {photo.outline_median_px:<14.1f}  {photo.alone_off_mm:9.2f}"
        )
    lines.append("T_upper_lower [mm]")
    lines += ["  ".join(f"{value:12.6f}" for value in row) for row in found.result.T_upper_lower]
    lines += [finding.line() for finding in found.result.findings]
    return [*lines, *map(str, (found.file, *found.overlays))]
