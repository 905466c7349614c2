"""Text output of the build commands: summaries of builds, plans, tracks and models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from jawusd.cli.output import shortened
from jawusd.cli.text_capture import calibration_lines
from jawusd.evaluator.contact import AUTHORED_MM, NEAR_MM
from jawusd.formats.finding import Finding
from jawusd.formats.notes import registration_sizes
from jawusd.formats.report import verdict_sentence

if TYPE_CHECKING:
    from jawusd.pipeline.build import BuildSummary, PlannedStage
    from jawusd.pipeline.fit import FitSummary
    from jawusd.pipeline.many import Outcome
    from jawusd.pipeline.state import ReportSummary
    from jawusd.pipeline.track import FrameTrackSummary, TrackSummary


_CALIBRATED = "the capture names no calibration: one was made from its boards"
_MOST_FURTHER = 3  # maximum number of further recommendations that a build prints; the report lists all


def build_lines(summary: BuildSummary, verbose: bool = False) -> list[str]:
    """Return the summary of a build as text: the verdict, the key figures, and the files; or, verbose, all results."""
    report, folder = summary["report"], summary["folder"]
    shown = f"{folder}/{report['file']}" if "file" in report else f"none: {report['missing']}"
    return [
        *_verdict_lines(report, verbose),
        *(_stage_lines(summary) if verbose else _key_lines(summary)),
        f"rig: {folder}/actor.usda",
        f"report: {shown}",
        f"next: jawusd view {folder}",
    ]


def _verdict_lines(report: ReportSummary, verbose: bool) -> list[str]:
    """Return the verdict of the report, what else should be done and, if verbose, the reasons."""
    if "verdict" not in report:
        return ["No verdict, because there is no report."]
    verdict = report["verdict"]
    also = verdict.get("todo", [])[1:]
    listed = also if verbose else also[:_MOST_FURTHER]
    more = [f"  and {len(also) - len(listed)} more in the report"] if len(also) > len(listed) else []
    reasons = [f"  because {one}" for one in verdict["because"]] if verbose else []
    return [verdict_sentence(verdict), *(f"  also: {one}" for one in listed), *more, *reasons]


def _sync_line(summary: BuildSummary) -> str:
    offsets = ", ".join(f"{name} {offset:+d}" for name, offset in summary["sync"]["offsets"].items())
    return f"sync ({summary['sync']['method']}): {offsets} frames"


def _findings(summary: BuildSummary) -> tuple[list[str], list[str]]:
    """Return the findings of the check and of tracking as lines; findings of both are listed under tracking."""
    tracked = [Finding.from_json(found).line() for found in summary["track"].get("findings", [])]
    checked = [Finding.from_json(found).line() for found in summary.get("findings", [])]
    return [line for line in checked if line not in tracked], tracked


def _key_lines(summary: BuildSummary) -> list[str]:
    track, fit = summary["track"], summary["fit"]
    sigma_mm = {name: value for name, value in track["sigma_mm"].items() if value is not None}
    lines = [_CALIBRATED] if summary["calibrate"] else []
    lines += [_sync_line(summary), f"tracked {track['tracked']} of {track['frames']} frames"]
    if "incisor" in sigma_mm:
        lines[-1] += f", expected error at the incisor {sigma_mm['incisor']:.2f} mm"
    tables = fit.get("errors", {})
    for table, words in (("holdout", "held-out"), ("train", "fitted")):
        if "mandible" in tables.get(table, {}):
            errors = tables[table]["mandible"]
            lines.append(
                f"model: {fit.get('method')}, {errors['mean']:.2f} mm from {words} poses on average, "
                f"{errors['max']:.2f} mm at most"
            )
            break
    told = (line for lines in _findings(summary) for line in lines)
    warned = sum(line.startswith("warning") for line in told) + len(fit.get("warnings", []))
    if warned:
        lines.append(f"{warned} warning{'s' if warned > 1 else ''}: see the report, or add -v")
    ran = [value for name, value in summary["seconds"].items() if name not in summary["reused"]]
    return [*lines, f"time: {rounded_duration(sum(ran))}" if ran else "time: all stages were kept"]


def _stage_lines(summary: BuildSummary) -> list[str]:
    lines = _findings(summary)[0]
    if summary["calibrate"]:
        lines += [_CALIBRATED, *calibration_lines(summary["calibrate"])]
    lines += [_sync_line(summary), *(f"  note: {note}" for note in summary["sync"].get("notes", []))]
    lines += [*track_lines(summary["track"]), *fit_lines(summary["fit"])]
    seconds = ", ".join(
        f"{name} {'kept' if name in summary['reused'] else f'{value:.1f} s'}"
        for name, value in summary["seconds"].items()
    )
    return [*lines, f"time: {seconds}"]


def plan_lines(stages: list[PlannedStage]) -> list[str]:
    """Return a plan as text."""
    ends = ["kept" if stage.keeps else f"runs, about {rounded_duration(stage.seconds)}" for stage in stages]
    lines = [f"  {stage.name:10} {end}" for stage, end in zip(stages, ends, strict=True)]
    total = sum(stage.seconds for stage in stages if not stage.keeps)
    whole = f"about {rounded_duration(total)} in all on one core; nothing was written" if total else "nothing to do"
    return [*lines, whole]


def rounded_duration(seconds: float) -> str:
    """Return a rounded duration in words."""
    if seconds < 90:
        return f"{max(5, round(seconds / 5) * 5)} seconds"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} minutes"
    return f"{seconds / 3600:.1f} hours"


def outcome_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the outcomes of many builds as a text table."""
    width = max(len("capture"), *(len(o.name) for o in outcomes))
    lines = [f"{'capture':<{width}}  status   frames  tracked  model mm  holdout mm  incisor mm  seconds"]
    for o in outcomes:
        figures = [(o.frames, 6, "d"), (o.tracked, 7, "d"), (o.model_mm, 8, ".3f"), (o.holdout_mm, 10, ".3f")]
        figures += [(o.sigma_incisor_mm, 10, ".3f"), (o.seconds, 7, ".1f")]
        cells = "  ".join(f"{'-' if value is None else format(value, form):>{w}}" for value, w, form in figures)
        lines.append(f"{o.name:<{width}}  {o.status:<7}  {cells}")
    return lines + [line for o in outcomes if o.error for line in f"{o.name}: {o.error}".split("\n")]


_LISTED_FRAMES = 20


def track_lines(summary: TrackSummary) -> list[str]:
    """Return `track_summary` as text."""
    lost = summary["lost"]
    lines = [f"tracked {summary['tracked']} of {summary['frames']} frames"]
    if lost:
        lines.append(f"  lost: {shortened(lost, _LISTED_FRAMES)}")
    for name, counts in summary.get("lost_reasons", {}).items():
        lines.append(f"  {name} arch lost by: " + ", ".join(f"{reason} {count}" for reason, count in counts.items()))
    lines.append(f"  recovered {summary['recovered']}, without one of the cameras {summary['without_a_camera']}")
    for name, (was, now) in summary["calibration_rescaled_px"].items():
        lines.append(
            f"  {name} is calibrated at {was[0]} x {was[1]} px and recorded at {now[0]} x {now[1]}: assumed to be "
            "scaled, not cropped"
        )
    if summary["prior_aided"]:
        lines.append(f"  {summary['prior_aided']} uncertain frames tracked again with the fitted model as a prior")
    if "prior_spread_mm" in summary:
        lines.append(f"  final poses combined with the fitted model, {summary['prior_spread_mm']:.2f} mm from it (rms)")
    known = {name: value for name, value in summary["sigma_mm"].items() if value is not None}
    sigma = ", ".join(f"{name} {value}" for name, value in known.items()) or "not known"
    lines.append(f"  expected error (1 sigma, median) [mm]: {sigma}")
    uncovered = summary["coverage_error_percent"]
    if uncovered is not None:
        lines.append(f"  uncovered fraction of the masks: {uncovered} %")
    if "frames_used" in summary:
        used = ", ".join(f"{name} {count}" for name, count in summary["frames_used"].items())
        lines.append(f"  frames used per camera: {used}")
    lines += _take_lines(summary)
    return [*lines, *(f"  {Finding.from_json(found).line()}" for found in summary.get("findings", []))]


def _take_lines(summary: TrackSummary) -> list[str]:
    """Return the estimates from the whole take as text: offsets of outlines, and the registration of the scans."""
    lines = []
    reaches = (("tooth edges", summary.get("outline_bias_px")), ("gum line", summary.get("gum_bias_px")))
    for what, found in reaches:
        if found is not None:
            reach = ", ".join(f"{name} {upper:+.2f} {lower:+.2f}" for name, (upper, lower) in found.items())
            lines.append(f"  outlines reach beyond the {what}, upper and lower arch [px]: {reach}")
    if "gum_line_mm" in summary:
        upper, lower = summary["gum_line_mm"]
        lines.append(
            f"  gum line drawn towards the gum, along the surface [mm]: upper {upper:+.2f}, lower {lower:+.2f}"
        )
    if "registration" in summary:
        bite = summary["registration"]
        shift, turn, *sigmas = registration_sizes(bite)
        what = "moved to" if bite["applied"] else "deviates from"
        size = f"{shift:.2f} +- {sigmas[0]:.2f} mm, {turn:.2f} +- {sigmas[1]:.2f} degrees"
        lines.append(f"  lower scan {what} the closed bite by {size}")
    return lines


def frame_lines(summary: FrameTrackSummary) -> list[str]:
    """Return `frame_summary` as text."""
    lines = []
    for name, arch in summary["arches"].items():
        line = f"frame {summary['frame']}, {name} arch: {arch['status']}"
        if "explanation" in arch:
            start = ": " if arch["status"] == "lost" else "; the masks alone: "
            line += start + arch["explanation"]
        if arch["masks_left_out"]:
            line += f"; mask not used: {', '.join(arch['masks_left_out'])}"
        lines.append(line)
    if summary["prior_aided"]:
        lines.append("the jaw model was used as a prior for these poses")
    return lines


def fit_lines(summary: FitSummary) -> list[str]:
    """Return `fit_summary` as text."""
    lines = [f"model: {summary.get('method')}; largest distance per pose [mm]:  mean  median     p95     max"]
    for table, places in summary.get("errors", {}).items():
        for place, figures in places.items():
            values = "".join(f"{figures[key]:8.3f}" for key in ("mean", "median", "p95", "max"))
            lines.append(f"  {table:<8} {place:<28}{values}")
    if contact := summary.get("contact"):
        lines.append(f"  teeth: {contact_words(contact)}")
    if joints := summary.get("joints"):
        lines.append(f"  condyles: {joint_words(joints)}")
    if frames := summary.get("trimmed_frames"):
        lines.append(f"  outlier frames excluded: {', '.join(map(str, frames))}")
    return lines + [f"  warning: {warning['message']}" for warning in summary.get("warnings", [])]


def contact_words(contact: object) -> str:
    """Return a `ContactSummary` as text; values of any type are accepted, because other programs may write the file."""
    found = contact if isinstance(contact, dict) else {}
    closed, error = found.get("closed_mm"), found.get("error_mm")
    if not isinstance(closed, float) or not isinstance(error, float):
        return f"clearance of the teeth is unknown: {found.get('missing', 'contact was not measured')}"
    meet = f"scans penetrate by {closed:.2f} mm" if closed > 0 else f"scans are {-closed:.2f} mm apart"
    return f"{meet} in occlusion; clearances are accurate to {error:.2f} mm"


_FARTHEST_MM = 1.5  # maximum distance that `meshes.collision` measures


def joint_words(joints: object) -> str:
    """Return the `ContactSummary` of the condyles as text."""
    found = joints if isinstance(joints, dict) else {}
    closed, error, limit = (found.get(name) for name in ("closed_mm", "error_mm", "limit_mm"))
    if not isinstance(closed, float) or not isinstance(error, float) or not isinstance(limit, float):
        return f"clearance from the skull is unknown: {found.get('missing', 'not measured')}"
    where = f"{closed:.2f} mm inside" if closed > 0 else f"{-closed:.2f} mm from"
    if closed <= -_FARTHEST_MM:
        where = f"more than {_FARTHEST_MM:g} mm from"
    where += " the bone of the skull"
    if error == 0.0:  # no surface of the skull is near enough to be measured
        return f"{where} in occlusion, and not within {NEAR_MM:g} mm of it anywhere inside the bound"
    deeper = f"up to {-limit:.2f} mm into it in captured poses; " if limit < -AUTHORED_MM else ""
    return f"{where} in occlusion; {deeper}clearances are accurate to {error:.2f} mm, and are not used to reject poses"
