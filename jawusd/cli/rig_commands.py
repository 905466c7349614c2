"""Commands on a finished rig: info, pose, validate, ik. They need only the base dependencies."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray
from typer import Argument, BadParameter, Context, Exit, Option

import jawusd
from jawusd.base.arrays import Array
from jawusd.base.plugin_path import VARIABLE, schema_folder
from jawusd.cli import face_commands, options
from jawusd.cli.motion import read_pose_table
from jawusd.cli.output import emit, refuse_any
from jawusd.cli.text_build import contact_words, frame_lines, joint_words, track_lines
from jawusd.evaluator import JawRig, Reason
from jawusd.evaluator.arrays import HeldOut
from jawusd.evaluator.verdicts import INSIDE, Verdicts
from jawusd.formats.finding import Finding as Changed
from jawusd.formats.poses import read_poses_or_parameters
from jawusd.formats.tracks import load_tracks
from jawusd.geometry import LANDMARKS, transform_point, transform_points

if TYPE_CHECKING:
    from jawusd.rig.read import Description

#: Exit code of a negative result, such as an invalid pose or a rig with errors.
NO = 1
Triple = tuple[float, float, float]


def info(
    context: Context,
    rig: options.OptionalRigArg = None,
    schema: Annotated[
        bool, Option("--schema", help="Print the path of the USD schema JawRigAPI, and how other programs find it.")
    ] = False,
    frame: Annotated[int | None, Option(help="For tracks.npz: describe the tracking of this frame.")] = None,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Describe a rig file or tracks."""
    if schema:
        folder = str(schema_folder() or "")
        lines = [
            f"JawRigAPI: {folder or 'not installed'}",
            f"other programs find it by {VARIABLE}={folder}",
            "`import jawusd` registers it, before the first stage of a process is opened",
        ]
        emit({"schema": "JawRigAPI", "folder": folder, "variable": VARIABLE}, as_json, lines)
        return
    if rig is None:
        raise BadParameter("give a rig file or tracks, or --schema.", param_hint="RIG")
    if rig.suffix == ".npz":
        from jawusd.pipeline.track import frame_summary, track_summary

        tracks = load_tracks(rig)
        if frame is None:
            take = track_summary(tracks)
            emit(take, as_json, track_lines(take))
        else:
            one = frame_summary(tracks, frame)
            emit(one, as_json, frame_lines(one))
        return
    if frame is not None:
        raise BadParameter("--frame applies only to tracks (.npz).")
    from jawusd.pipeline.state import recorded_verdict
    from jawusd.rig import describe

    found, changed, verdict = describe(rig, prim), options.changed_in_folder(context), recorded_verdict(rig.parent)
    whole = {**found, "verdict": verdict, "changed": [finding.as_json() for finding in changed]}
    first = [] if verdict is None else [verdict]
    emit(whole, as_json, [*first, *_info_lines(found), *(finding.line() for finding in changed)])


def _info_lines(found: Description) -> list[str]:
    lines = [
        f"actor {found['actor']}, format {found['format_version']}, prim {found['prim']}",
        f"model: {found['model']['kind']} ({found['model']['method']}), onnx: {', '.join(found['onnx']) or 'none'}",
    ]
    for name, (low, high) in found["ranges_mm"].items():
        lines.append(f"  {name}: {low:.2f} .. {high:.2f} mm")
    limits, table = found["thresholds_mm"], found["table"]
    lines.append(
        f"measured poses: at most {limits['residual']:.2f} mm from the model, "
        f"tolerance {limits['tolerance']:.2f} mm outside the bound"
    )
    if found["held_out"]:
        lines.append(f"  {HeldOut(**found['held_out']).words}")
    lines.append(f"table: {table['format']} {table['shape']}, worst error {table['max_error_mm']:.4f} mm")
    lines.append(f"teeth: {contact_words(found['contact'])}")
    lines.append(f"condyles: {joint_words(found['joints'])}")
    if found["speeds"]:
        speed, acceleration = (
            ", ".join(f"{x:.0f}" for x in found["speeds"][name]) for name in ("rms_mm_s", "rms_mm_s2")
        )
        lines.append(f"moves: d1, d2, d3 at {speed} mm/s and {acceleration} mm/s^2 (rms over the take)")
    for name, count in found["meshes"].items():
        mark = ", a placeholder, not anatomical" if name in found["placeholders"] else ""
        lines.append(f"mesh {name}: {count} points{mark}")
    condyles = found["estimated_condyles"]
    if condyles:
        error = "not known" if condyles["error_mm"] is None else f"{condyles['error_mm']:.1f} mm"
        lines.append(f"estimated head: condyles: {condyles['source']}; expected error: {error}")
    if found["animation"]:
        shown = found["animation"]
        lines.append(f"animation: {shown['samples']} samples, frames {shown['first']:g} .. {shown['last']:g}")
    return lines


def pose(
    rig: options.RigArg,
    d: Annotated[
        Triple, Option("--d", metavar="D1 D2 D3", help="Opening, laterotrusion (+ left), protrusion (+ forward) [mm].")
    ],
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Print the jaw pose at parameters d: 4x4 matrix, twist, landmarks, tooth clearance, and margin to the bound."""
    loaded = jawusd.load(rig, prim=prim)
    _check_finite(d, "--d")
    T = loaded.pose(d)
    twist, verdict = loaded.twist(d), loaded.validate_parameters(d)
    margin, inside, valid = float(verdict.margin_mm), bool(verdict.inside()), bool(verdict.valid)
    clearance = None if loaded.contact is None else float(loaded.clearance(d).clearance_mm)
    joints = None if loaded.joints is None else float(loaded.clearance(d, of="condyles").clearance_mm)
    landmarks = dict(zip(LANDMARKS, transform_points(T, loaded.landmarks), strict=True))
    lines = ["T_skull_mandible [mm]", *("  " + " ".join(f"{value:12.6f}" for value in row) for row in T)]
    lines.append("twist (omega rad, v mm): " + " ".join(f"{value:.6f}" for value in twist))
    lines += [f"  {name}: " + " ".join(f"{value:.3f}" for value in place) + " mm" for name, place in landmarks.items()]
    if clearance is not None:
        collide = Reason.TEETH_COLLIDE in Reason(int(verdict.reason))
        lines.append(f"clearance {clearance:.3f} mm: teeth {'COLLIDE' if collide else 'do not collide'}")
    if joints is not None:
        lines.append(f"clearance of the condyles {joints:.3f} mm")
    lines.append(f"margin {margin:.3f} mm: {'inside' if inside else 'OUTSIDE'} the bound")
    result = {"T_skull_mandible": T, "twist": twist, "landmarks_mm": landmarks, "margin_mm": margin, "valid": valid}
    emit({"d": list(d), **result, "clearance_mm": clearance, "condyle_clearance_mm": joints}, as_json, lines)


def _check_finite(values: Triple, option: str) -> None:
    if not all(math.isfinite(value) for value in values):
        raise BadParameter("values must be finite", param_hint=option)


def validate(
    context: Context,
    rig: options.RigArg,
    poses: Annotated[
        Path | None, Argument(help="CSV or JSON of poses or of d, tracks.npz, or an animated USD stage.")
    ] = None,
    residual_mm: Annotated[
        float | None, Option(help="Maximum distance from the model [mm]. Default: the rig's limit.")
    ] = None,
    tolerance_mm: Annotated[
        float | None,
        Option(min=0.0, help="Allowed distance outside the bound [mm]; 0 for authored poses. Default: set by the rig."),
    ] = None,
    face: face_commands.FaceOption = None,
    align: face_commands.AlignOption = None,
    mapping: face_commands.MappingOption = None,
    csv: face_commands.CsvOption = None,
    strip: face_commands.StripOption = None,
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Check a rig, or poses or a face track against a rig; exit code 1 if something is invalid.

    A pose is inside the bound, within the tolerance of measured poses, or outside. With --align, the thresholds are
    widened by two standard deviations of the error that the alignment causes.
    """
    if face is not None:
        if poses is not None:
            raise BadParameter("give either poses or --face.", param_hint="--face")
        refuse_any(force, csv, strip)
        judged = face_commands.judge_face(jawusd.load(rig, prim=prim), face, align, mapping, residual_mm, tolerance_mm)
        if csv is not None:
            from jawusd.fitting.face_judging import save_verdicts

            save_verdicts(csv, judged)
        if strip is not None:
            from jawusd.report.figures import save_strip

            save_strip(strip, judged.frames, judged.verdicts)
        own_mm, widened_mm = judged.verdicts.tolerance_mm, judged.widened_mm
        limits = f"tolerance {own_mm:.2f} mm, of which {widened_mm:.2f} mm for the alignment"
        _emit_verdicts("frames", judged.frames, judged.verdicts, limits, {"widened_mm": widened_mm}, as_json)
        return
    if align or mapping or csv or strip:
        raise BadParameter("is needed for --align, --mapping, --csv and --strip.", param_hint="--face")
    if poses is None:
        _validate_rig(rig, options.changed_in_folder(context), as_json)
        return

    loaded = options.load_named(rig, prim, poses)
    more, stale = _unbaked(loaded, poses, prim)
    frames, T = _poses_or_parameters(loaded, poses, prim)
    verdicts = loaded.validate(T, residual_limit_mm=residual_mm, tolerance_mm=tolerance_mm)
    limits = f"tolerance of measured poses {verdicts.tolerance_mm:.2f} mm"
    _emit_verdicts("poses", frames, verdicts, limits, more, as_json, stale)


def _emit_verdicts(
    noun: str,
    frames: Array | NDArray[np.int64],
    verdicts: Verdicts,
    limits: str,
    more: Mapping[str, object],
    as_json: bool,
    warnings: Sequence[str] = (),
) -> None:
    """Print verdicts on frames (F,), and their counts; exit code 1 if a pose is invalid, or if there are warnings.

    `limits` are the limits in words, `more` are further values for JSON.
    """
    figures = (frames, verdicts.valid, verdicts.words(), verdicts.residual_mm, verdicts.margin_mm)
    rows: list[dict[str, object]] = [
        {"frame": int(frame), "valid": bool(ok), "reason": words, "residual_mm": float(res), "margin_mm": float(margin)}
        for frame, ok, words, res, margin in zip(*figures, strict=True)
    ]
    inside, valid = int((verdicts.valid & verdicts.inside()).sum()), int(verdicts.valid.sum())
    within, invalid = valid - inside, len(rows) - valid
    counts = {"inside": inside, "within_tolerance": within, "invalid": invalid, "tolerance_mm": verdicts.tolerance_mm}
    shown = "frame {frame}: {reason} (residual {residual_mm:.2f} mm, margin {margin_mm:.2f} mm)"
    lines = [shown.format(**row) for row in rows if row["reason"] != INSIDE]
    summary = f"{len(rows)} {noun}: {inside} inside, {within} within tolerance, {invalid} invalid ({limits})"
    emit({noun: len(rows), **counts, **more, "verdicts": rows}, as_json, [*lines, *warnings, summary])
    if invalid or warnings:
        raise Exit(NO)


def _unbaked(rig: JawRig, path: Path, prim: str | None) -> tuple[dict[str, object], list[str]]:
    """Return figures and a warning if the mandible's transform in a stage deviates from its d; empty if both agree."""
    from jawusd.rig.rebake import deviation

    away = deviation(path, rig, prim) if path.suffix.lower() in options.USD_SUFFIXES else None
    if away is None or not away.frames:
        return {}, []
    message = f"the mandible deviates from d in {away.frames} of {away.of} frames and keys, by up to "
    return {"unbaked": away._asdict()}, [f"{message}{away.largest_mm:.2f} mm: run `jawusd rebake`"]


def _poses_or_parameters(rig: JawRig, path: Path, prim: str | None) -> tuple[NDArray[np.int64], Array]:
    if path.suffix.lower() in options.USD_SUFFIXES:
        from jawusd.rig.motion_read import read_poses_of_stage

        return read_poses_of_stage(path, prim)
    if path.suffix == ".npz":
        return read_pose_table(path)
    frames, found = read_poses_or_parameters(path)
    return frames, rig.pose(found) if found.ndim == 2 else found


def _validate_rig(path: Path, changed: list[Changed], as_json: bool) -> None:
    from jawusd.rig import Finding, find_nvidia_validator, nvidia_findings, validate_stage
    from jawusd.rig.layout import rig_prims
    from jawusd.rig.read import open_stage

    findings = [Finding(one.severity, one.kind, one.path or "", one.message) for one in changed]
    findings += validate_stage(path)
    if not rig_prims(open_stage(path)):
        words = "has no active rig (no prim with JawRigAPI); the rules for rigs were not applied."
        findings.append(Finding("info", "Rig", "/", words))
    nvidia = find_nvidia_validator()
    if nvidia is not None:
        findings += nvidia_findings(path, nvidia)
    errors = [finding for finding in findings if finding.severity == "error"]
    result = {"file": str(path), "errors": len(errors), "findings": [asdict(finding) for finding in findings]}
    lines = [f"{finding.severity}: {finding.rule}: {finding.path}: {finding.message}" for finding in findings]
    emit(result, as_json, [*lines, f"{path}: {len(errors)} errors, {len(findings) - len(errors)} other findings"])
    if errors:
        raise Exit(NO)


def ik(
    rig: options.RigArg,
    point: Annotated[Triple, Option(metavar="X Y Z", help="Point on the mandible at rest [mm].")],
    target: Annotated[Triple, Option(metavar="X Y Z", help="Target of the point, skull frame [mm].")],
    start: Annotated[Triple | None, Option(metavar="D1 D2 D3", help="Initial parameters [mm].")] = None,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Find the valid parameters that move a point of the mandible closest to a target."""
    for values, option in ((point, "--point"), (target, "--target"), (start or point, "--start")):
        _check_finite(values, option)
    loaded = jawusd.load(rig, prim=prim)
    d, distance = loaded.ik(point, target, start=start)
    distance_mm = float(distance)
    reached = transform_point(loaded.pose(d), point)
    result = {"d": d, "reached": reached, "distance_mm": distance_mm, "margin_mm": float(loaded.margin(d))}
    emit(result, as_json, [f"d {d[0]:.3f} {d[1]:.3f} {d[2]:.3f} mm, {distance_mm:.3f} mm from the target"])
