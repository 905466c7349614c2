"""The summary of a build as text."""

from __future__ import annotations

from jawusd.formats.finding import Finding
from jawusd.pipeline.build import BuildSummary
from jawusd.pipeline.calibrate import calibration_lines
from jawusd.pipeline.fit import fit_lines
from jawusd.pipeline.report import ReportSummary
from jawusd.pipeline.track import track_lines


def build_lines(summary: BuildSummary) -> list[str]:
    """Return the summary of a build as text."""
    offsets = ", ".join(f"{name} {offset:+d}" for name, offset in summary["sync"]["offsets"].items())
    # What the tracks say of the scans is said with them.
    known = [Finding.from_json(found).line() for found in summary["track"].get("findings", [])]
    lines = [Finding.from_json(found).line() for found in summary.get("findings", [])]
    lines = [line for line in lines if line not in known]
    if summary["calibrate"]:
        lines += [
            "the capture names no calibration: made one from its boards",
            *calibration_lines(summary["calibrate"]),
        ]
    lines += [f"sync ({summary['sync']['method']}): {offsets} frames"]
    lines += [f"  note: {note}" for note in summary["sync"].get("notes", [])]
    lines += track_lines(summary["track"])
    lines += fit_lines(summary["fit"])
    seconds = ", ".join(
        f"{name} {'kept' if name in summary['reused'] else f'{value:.1f} s'}"
        for name, value in summary["seconds"].items()
    )
    report = summary["report"]
    shown = f"{summary['folder']}/{report['file']}" if "file" in report else f"none: {report['missing']}"
    ends = [f"time: {seconds}", f"rig: {summary['folder']}/actor.usda", f"report: {shown}"]
    return [*lines, *ends, *_verdict_lines(report)]


_MOST_REASONS = 4


def _verdict_lines(report: ReportSummary) -> list[str]:
    """Return the verdict on the build: what the report says, with the figures that make it so."""
    if "verdict" not in report:
        return ["verdict: none, there is no report that judges it"]
    grade, because = report["verdict"]["grade"], report["verdict"]["because"]
    words = {
        "good": "good",
        "look": "usable; look at this in the report first:",
        "bad": "not usable as it is, because of:",
        "open": "none, there is nothing to judge it by",
    }
    more = [f"and {len(because) - _MOST_REASONS} more"] if len(because) > _MOST_REASONS else []
    return [f"verdict: {words.get(grade, grade)}", *(f"  {one}" for one in (*because[:_MOST_REASONS], *more))]
