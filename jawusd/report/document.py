"""Write the report of a build as one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from jawusd.base.errors import AnyPath
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.finding import Finding
from jawusd.formats.mesh import DEEP, TOUCHING
from jawusd.formats.notes import TracksMeta, registration_sizes
from jawusd.formats.report import BuildVerdict, ReportData, verdict_sentence
from jawusd.formats.tracks import LOST, LostReason
from jawusd.report.figures import human_ranges, model_figure, tracking_figure
from jawusd.report.jaw_pages import replay_data
from jawusd.report.style import inline_svg
from jawusd.report.templates import rendered
from jawusd.report.verdicts import MARKS, WORDS, judge, summary

_LISTED = 60  # maximum number of frame ranges in a list
_PLACES = ("mandible", "incisor", "molar_left", "molar_right", "condyle_left", "condyle_right")


def write_document(path: AnyPath, data: ReportData, figures: Mapping[str, Markup] | None = None) -> BuildVerdict:
    """Write the report to an HTML file and return its summary; raises OutputError.

    `figures` are plots by their slot on the page; default: those of `draw_figures`.
    """
    write_text_atomic(path, document(data, figures))
    return summary(judge(data))


def document(data: ReportData, figures: Mapping[str, Markup] | None = None) -> str:
    """Return the report as HTML, with text from files escaped; see `write_document`."""
    verdicts = judge(data)
    verdict = summary(verdicts)
    return rendered(
        "report.html.j2",
        ("scene.js", "timeline.js", "replay.js"),
        data=data,
        verdicts=verdicts,
        verdict=verdict,
        sentence=verdict_sentence(verdict),
        words=WORDS,
        marks=MARKS,
        replay=replay_data(data),
        figures=draw_figures(data) if figures is None else figures,
        paper=(DEEP, *TOUCHING),
        ranges=human_ranges(data.tracks, data.model),
        errors=_error_tables(data),
        frames=_frame_lists(data),
        uncertainty=data.model.meta.get("uncertainty", {}),
        start=_start(data),
        cameras=_cameras(data),
        findings=_findings(data),
        bite=_bite(data),
    )


def draw_figures(data: ReportData) -> dict[str, Markup]:
    """Return the plots of the tracks and the model by their slot on the page."""
    return {
        "tracking": inline_svg(tracking_figure(data.tracks), "tracking", "Tracking state and errors of every frame."),
        "model": inline_svg(model_figure(data.model), "model", "Parameters, model error and margin of every frame."),
    }


def _error_tables(data: ReportData) -> list[tuple[str, str, list[tuple[str, dict[str, float]]]]]:
    """Return the error tables, each with a short name, a description, and rows of (place, errors by statistic)."""
    names = {
        "train": ("fit", "poses the model was fitted to"),
        "holdout": ("held out", "poses of parts of the take that were held out of the fit, one part at a time"),
        "trimmed": ("outliers", "poses excluded from the fit as outliers"),
    }
    tables = data.model.notes.get("errors", {})
    return [
        (*names[key], [(place, tables[key][place]) for place in _PLACES if place in tables[key]])
        for key in names
        if key in tables
    ]


def _frame_lists(data: ReportData) -> list[tuple[str, int, str]]:
    """Return (reason, count, frames as text) for frames that were lost, regularised, or excluded from the fit."""
    tracks, meta = data.tracks, data.model.notes
    lists = {"lost by the tracker": tracks.frames[np.any(tracks.status == LOST, axis=1)]}
    for arch, name in enumerate(("upper", "lower")):
        for reason in list(LostReason)[1:]:
            chosen = (tracks.status[:, arch] == LOST) & (tracks.lost_reason[:, arch] == reason)
            if chosen.any():
                lists[f"lost, {name} arch: {reason}"] = tracks.frames[chosen]
    lists["regularised by the model"] = tracks.frames[tracks.prior_aided]
    for why, frames in meta.get("excluded_frames", {}).items():
        lists[f"excluded from the fit: {why}"] = np.asarray(frames, dtype=np.int64)
    lists["excluded from the fit as outliers"] = np.asarray(meta.get("trimmed_frames", []), dtype=np.int64)
    return [(reason, len(frames), _spans(frames)) for reason, frames in lists.items() if len(frames)]


def _spans(frames: NDArray[np.int64]) -> str:
    """Return frame numbers as text with ranges, such as "3-7, 9"."""
    if not len(frames):
        return ""
    frames = np.unique(frames)
    parts = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    texts = [str(part[0]) if len(part) == 1 else f"{part[0]}\u2013{part[-1]}" for part in parts]
    more = "" if len(texts) <= _LISTED else f" and {len(texts) - _LISTED} more ranges"
    return ", ".join(texts[:_LISTED]) + more


def _findings(data: ReportData) -> list[str]:
    """Return the findings of the checks and of tracking, without duplicates."""
    tracked = [Finding.from_json(found) for found in data.tracks.meta.get("findings", [])]
    return list(dict.fromkeys(finding.line() for finding in (*data.findings, *tracked)))


def _start(data: ReportData) -> str:
    """Return a phrase that describes how tracking was initialised."""
    start = data.tracks.meta.get("start", {})
    if not start:
        return "not recorded"
    text = f"by {start.get('by')}, on frame {start.get('frame')}"
    left_out = [
        f"{arch}: {', '.join(map(str, numbers))}"
        for arch, numbers in cast(dict[str, list[int]], start.get("picks_left_out", {})).items()
        if numbers
    ]
    if left_out:
        text += f"; inconsistent picks were ignored ({'; '.join(left_out)})"
    return text


def _cameras(data: ReportData) -> list[dict[str, str]]:
    """Return a table row per camera: footage, masks, and corrections of the calibration."""
    meta, offsets = data.tracks.meta, data.sync.get("offsets", {})
    known = {camera.name: camera for camera in data.cameras}
    extrinsics = meta.get("extrinsics", {})
    rows = []
    tracked = data.tracks.camera_names
    for name in (*tracked, *(name for name in known if name not in tracked)):
        facts = known.get(name)
        masks = data.tracks.masks_used[:, :, tracked.index(name)] if name in tracked else np.zeros(1)
        turn = np.linalg.norm(extrinsics.get("turns_deg", {}).get(name, [np.nan]))
        move = np.linalg.norm(extrinsics.get("moves_mm", {}).get(name, [np.nan]))
        notes = []
        if np.isfinite(turn):
            notes.append(f"rotated {turn:.3f} deg and moved {move:.2f} mm" if extrinsics["corrected"] else "unchanged")
        if name in meta.get("calibration_rescaled_px", {}):
            was, now = meta["calibration_rescaled_px"][name]
            notes.append(f"calibrated at {was[0]} \u00d7 {was[1]} px, recorded at {now[0]} \u00d7 {now[1]} px: scaled")
        rows.append(
            {
                "name": name,
                "video": facts.video if facts else "",
                "size": f"{facts.size_px[0]} \u00d7 {facts.size_px[1]}" if facts else "",
                "offset": _signed(offsets.get(name), "d"),
                "delay": _signed(meta.get("delays_frames", {}).get(name), ".3f"),
                "masks": f"{100 * masks.mean():.1f} %" if masks.any() else "none",
                "drawn": _drawn(meta, name),
                "calibration": "; ".join(notes),
            }
        )
    return rows


def _drawn(meta: TracksMeta, camera: str) -> str:
    """Return a text with the offsets of a camera's mask outlines from the teeth, upper and lower arch."""
    edges, gum = meta.get("outline_bias_px", {}).get(camera), meta.get("gum_bias_px", {}).get(camera)
    if edges is None or gum is None:
        return ""
    return f"edges {edges[0]:+.2f} / {edges[1]:+.2f}, gum line {gum[0]:+.2f} / {gum[1]:+.2f}"


def _bite(data: ReportData) -> str:
    """Return sentences on the gum line of the masks and the occlusion, as estimated from the take."""
    meta, said = data.tracks.meta, []
    if "gum_line_mm" in meta:
        upper, lower = meta["gum_line_mm"]
        said.append(
            f"The gum line of the masks is offset towards the gum by {upper:+.2f} mm (upper), {lower:+.2f} mm (lower)."
        )
    if "registration" in meta:
        found = meta["registration"]
        shift, turn, sigma_mm, sigma_deg = registration_sizes(found)
        off = f"{shift:.2f} \u00b1 {sigma_mm:.2f} mm and {turn:.2f} \u00b1 {sigma_deg:.2f} degrees"
        frames = f"frames {found['frames'][0]} to {found['frames'][-1]}"
        what = "was moved to the closed bite by" if found["applied"] else "deviates from the closed bite by"
        said.append(f"Judged by {frames}, the lower scan {what} {off}.")
    return " ".join(said)


def _signed(value: float | None, digits: str) -> str:
    return "" if value is None else f"{value:+{digits}}"
