"""Write the report of a solved performance as one self-contained HTML file."""

from __future__ import annotations

import base64
import os
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from jawusd.base.errors import FormatError
from jawusd.evaluator.verdicts import is_inside
from jawusd.formats.atomic import write_text_atomic
from jawusd.formats.finding import Finding
from jawusd.formats.performance import STATE_WORDS, SolveState
from jawusd.formats.report import SolveReportData
from jawusd.formats.solved import SolvedJaw
from jawusd.formats.tracks import LOST
from jawusd.report.document import own_file, page_environment
from jawusd.report.solve_figures import jaw_figure, seen_figure
from jawusd.report.style import inline_svg

_LISTED = 60  # runs named one by one


class Unseen(NamedTuple):
    """Describe a run of frames in which an arch was not found."""

    first: int
    last: int
    seconds: str
    cause: str
    arches: str
    sigma: str


def write_solve_page(path: str | os.PathLike[str], data: SolveReportData) -> None:
    """Write the report to an HTML file.

    Raises:
        FormatError: the tracks are not those of a solve.
        OutputError: the file cannot be written.
    """
    write_text_atomic(path, solve_page(data))


def solve_page(data: SolveReportData) -> str:
    """Return the report as HTML; all content of files is escaped.

    Raises:
        FormatError: the tracks are not those of a solve.
    """
    solved = data.tracks.solved
    if solved is None:
        raise FormatError("holds no solved performance.", hint="Name the .npz that `jawusd solve` wrote.")
    findings = list(dict.fromkeys(Finding.from_json(one).line() for one in data.tracks.meta.get("findings", [])))
    unseen = unseen_runs(data, solved)
    return (
        page_environment()
        .get_template("solve.html.j2")
        .render(
            data=data,
            style=own_file("report.css"),
            counts=_counts(solved),
            sentence=_sentence(solved, bool(findings)),
            jaw=_jaw_rows(solved),
            figures=_figures(data, solved),
            pictures=[(one, base64.b64encode(one.jpeg).decode("ascii")) for one in data.overlays],
            unseen=unseen[:_LISTED],
            more=max(len(unseen) - _LISTED, 0),
            cameras=_cameras(data),
            findings=findings,
        )
    )


def unseen_runs(data: SolveReportData, solved: SolvedJaw) -> list[Unseen]:
    """Return the runs of frames in which an arch was not found, of one state each."""
    frames, found = data.tracks.frames, []
    breaks = np.flatnonzero((np.diff(solved.state) != 0) | (np.diff(frames) != 1)) + 1
    for rows in np.split(np.arange(len(frames)), breaks):
        if not len(rows) or solved.state[rows[0]] == SolveState.SOLVED:
            continue
        state = SolveState(int(solved.state[rows[0]]))
        lost = (data.tracks.status[rows] == LOST).any(axis=0)
        arches = [name for name, is_lost in zip(("upper", "lower"), lost, strict=True) if is_lost]
        first, last = int(frames[rows[0]]), int(frames[rows[-1]])
        worst = ", ".join(f"{value:.2f}" for value in solved.sigma_mm[rows].max(axis=0))
        seconds = f"{first / data.fps:.2f} to {(last + 1) / data.fps:.2f}"
        found.append(Unseen(first, last, seconds, STATE_WORDS[state], " and ".join(arches), worst))
    return found


def _figures(data: SolveReportData, solved: SolvedJaw) -> dict[str, Markup]:
    if not len(data.tracks.frames):
        return {}
    return {
        "jaw": inline_svg(jaw_figure(data.tracks, solved, data.fps), "jaw", "d, sigma and margin of every frame."),
        "seen": inline_svg(seen_figure(data.tracks, solved, data.fps), "seen", "What was seen in every frame."),
    }


def _counts(solved: SolvedJaw) -> list[tuple[str, int, str, str]]:
    """Return (what, frames, share, what it means) per state and for poses outside."""
    rows = (
        ("solved", solved.state == SolveState.SOLVED, "both arches were found in the masks"),
        ("carried", solved.state == SolveState.CARRIED, "an arch was out of sight; the motion around carries it"),
        (
            "lost",
            solved.state == SolveState.LOST,
            "there are masks that fit nothing; the motion around carries the jaw",
        ),
        (
            "within tolerance",
            solved.valid & ~is_inside(solved.margin_mm),
            "the pose lies outside the rig's bound, but no farther than measured poses may",
        ),
        ("outside", ~solved.valid, "the rig does not allow the pose"),
    )
    total = max(len(solved.state), 1)
    return [(name, int(has.sum()), f"{100 * has.sum() / total:.1f} %", words) for name, has, words in rows]


def _sentence(solved: SolvedJaw, doubts: bool) -> str:
    """Say in words what a person should look at; no figure is judged by a limit of its own."""
    said = []
    if (solved.state == SolveState.LOST).any():
        said.append("frames are lost: look at their masks")
    if (solved.state == SolveState.CARRIED).any():
        said.append("frames are carried by the motion around: their sigma says how far they may be off")
    if not solved.valid.all():
        said.append(
            "poses lie outside the rig's bound: masks are wrong there, or the person went farther than captured"
        )
    if doubts:
        said.append("there are findings")
    if not said:
        return "Every frame was seen, and every pose is one that the rig allows."
    text = "; ".join(said)
    return f"{text[0].upper()}{text[1:]}."


def _jaw_rows(solved: SolvedJaw) -> list[tuple[str, str, str, str, str]]:
    """Return (parameter, smallest, largest, typical sigma, largest sigma) in mm; typical over solved frames."""
    names = ("d1 opening", "d2 laterotrusion (left is positive)", "d3 protrusion (forward is positive)")
    seen = solved.state == SolveState.SOLVED
    rows = []
    for name, value, sigma in zip(names, solved.d.T, solved.sigma_mm.T, strict=True):
        typical = f"{np.median(sigma[seen]):.3f}" if seen.any() else ""
        if len(value):
            rows.append((name, f"{value.min():.2f}", f"{value.max():.2f}", typical, f"{sigma.max():.2f}"))
    return rows


def _cameras(data: SolveReportData) -> list[dict[str, str]]:
    """Return a table row per camera: what it has, in how many frames its masks took part, and its focal length."""
    tracks, known = data.tracks, {camera.name: camera for camera in data.cameras}
    rows = []
    for name in (*tracks.camera_names, *(name for name in known if name not in tracks.camera_names)):
        facts = known.get(name)
        used = ""
        if name in tracks.camera_names:
            counts = tracks.masks_used[:, :, tracks.camera_names.index(name)].sum(axis=0)
            used = f"{counts[0]} / {counts[1]}"
        focal = tracks.meta.get("focal", {}).get(name)
        rows.append(
            {
                "name": name,
                "video": facts.video if facts else "",
                "masks": facts.masks if facts else "",
                "size": f"{facts.size_px[0]} \u00d7 {facts.size_px[1]}" if facts else "",
                "used": used or "not solved with",
                "focal": "" if focal is None else f"{focal[0]:.4f} \u00b1 {focal[1]:.4f}",
            }
        )
    return rows
