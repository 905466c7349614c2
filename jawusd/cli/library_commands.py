"""Commands on several actors: `library`, `publish`, and `retarget` to another rig or to a subject without a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, BadParameter, Option

from jawusd.cli import options
from jawusd.cli.motion import carried_over, emit_motion
from jawusd.cli.output import emit, progress
from jawusd.formats.atomic import refuse_existing
from jawusd.formats.landmarks import load_landmarks
from jawusd.formats.model import save_model
from jawusd.library.index import PARAMETERS, Entry, Library
from jawusd.library.personal import landmark_distance_mm

Use = Literal["average", "closest"]


def retarget(
    anim: Annotated[
        Path | None, Argument(help="Motion of --from: an animation layer, keys.json, or a CSV of d or poses.")
    ] = None,
    source: Annotated[
        Path | None, Option("--from", help="Rig for which the motion was made.", callback=options.rig_of_folder)
    ] = None,
    target: Annotated[Path | None, Option("--to", help="Target rig.", callback=options.rig_of_folder)] = None,
    landmarks: Annotated[
        Path | None, Option(help="Landmarks (JSON) of a subject without a capture, instead of a motion.")
    ] = None,
    library_folder: Annotated[
        Path | None, Option("--library", help="With --landmarks: folder of rigs to learn from.")
    ] = None,
    use: Annotated[Use, Option(help="With --landmarks: average the library, or use the closest subject.")] = "average",
    fps: Annotated[float | None, Option(min=0.001, help="Frames per second. Default: as in the motion.")] = None,
    out: Annotated[
        Path | None,
        Option("-o", "--out", help="Layer of the motion (retargeted.usdc) or model of the subject (model.npz)."),
    ] = None,
    force: options.Force = False,
    prim: options.Prim = None,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Retarget a motion to another rig, or make a rig for a subject from landmarks and a library."""
    if landmarks and library_folder and not any((anim, source, target, fps)):
        _personal(landmarks, library_folder, use, out or Path("model.npz"), force, as_json)
        return
    if not (anim and source and target) or landmarks or library_folder:
        raise BadParameter("give either ANIM with --from and --to, or --landmarks with --library.")
    from jawusd.pipeline.library import load_any_rig
    from jawusd.rig import write_animation
    from jawusd.rig.read import describe

    out = out or Path("retargeted.usdc")
    refuse_existing(out, force)
    for place, option in ((out, "--out"), (target, "--to")):
        if place.suffix not in (".usd", ".usda", ".usdc"):
            raise BadParameter("must be a USD layer: .usda, .usdc or .usd.", param_hint=option)
    taker = load_any_rig(target)
    motion, changes = carried_over(source, anim, taker, prim)
    rate = fps or motion.fps or describe(target)["fps"]
    write_animation(out, target, motion.frames, motion.d, rate, rig=taker)
    emit_motion(out, rate, motion, changes, as_json)


def _personal(landmarks: Path, folder: Path, use: Use, out: Path, force: bool, as_json: bool) -> None:
    from jawusd.pipeline.fit import fit_summary
    from jawusd.pipeline.library import open_library, personal_rig

    refuse_existing(out, force)
    opened = open_library(folder)
    with progress() as report:
        made = personal_rig(landmarks, opened, closest=use == "closest", name=landmarks.stem, progress=report)
    save_model(out, made.model)
    known, weights = fit_summary(made.model), made.motion.weights
    ranges, warnings, not_used = known["ranges_mm"], known["warnings"], [*made.left_out, *opened.skipped]
    lines = [str(out), *(f"  {name}: {low:.1f} .. {high:.1f} mm" for name, (low, high) in ranges.items())]
    lines += [f"  from {name}: {weight:.0%}" for name, weight in sorted(weights.items(), key=lambda item: -item[1])]
    lines += [f"  not used: {name}" for name in not_used]
    lines += [f"  {warning['code']}: {warning['message']}" for warning in warnings]
    rest = {"ranges_mm": ranges, "not_used": not_used, "warnings": warnings}
    emit({"file": str(out), "use": use, **made.header, **rest}, as_json, lines)


def library(
    folder: Annotated[Path, Argument(help="Folder with a subfolder per subject.")],
    search: Annotated[str | None, Option(help="List only names and paths that contain this text.")] = None,
    like: Annotated[Path | None, Option(help="Sort by similarity to these landmarks (JSON).")] = None,
    compare: Annotated[
        tuple[str, str] | None, Option(metavar="NAME NAME", help="Compare two subjects side by side.")
    ] = None,
    add: Annotated[
        Path | None,
        Option(
            help="First copy this rig (its folder, actor.usda or model.npz) into the library.",
            callback=options.rig_of_folder,
        ),
    ] = None,
    name: Annotated[str | None, Option(help="With --add: name of the subject. Default: the name in the rig.")] = None,
    plot: Annotated[Path | None, Option(help="Folder for ranges.png and ranges.svg of the listed subjects.")] = None,
    force: options.Force = False,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Manage many actors: update the index library.json, list, search, compare and plot."""
    from jawusd.pipeline.library import add_rig, open_library, plot_ranges

    if compare is not None and (search, like, plot) != (None, None, None):
        raise BadParameter("--compare cannot be combined with --search, --like or --plot.")
    if name is not None and add is None:
        raise BadParameter("needs --add.", param_hint="--name")
    if add is not None:
        add_rig(folder, add, name, force)
    opened = open_library(folder)
    if compare is not None:
        first, second = (opened.find(who) for who in compare)
        _compare(first, second, as_json)
        return
    entries = opened.entries if search is None else opened.search(search)
    apart_mm: dict[str, float] = {}
    if like is not None:
        wanted = load_landmarks(like).landmarks
        apart_mm = {entry.path: landmark_distance_mm(entry.landmarks(), wanted) for entry in entries}
        entries = tuple(sorted(entries, key=lambda entry: apart_mm[entry.path]))
    plots = [] if plot is None else [str(path) for path in plot_ranges(entries, plot, force)]
    rigs = [asdict(entry) | ({"landmark_distance_mm": apart_mm[entry.path]} if apart_mm else {}) for entry in entries]
    listed = {"folder": str(opened.folder), "reread": opened.reread, "rigs": rigs, "skipped": opened.skipped}
    emit({**listed, "plots": plots}, as_json, [*_library_lines(opened, entries, apart_mm), *plots])


def _library_lines(opened: Library, entries: Sequence[Entry], apart_mm: Mapping[str, float]) -> list[str]:
    lines = [f"{'actor':<20}{'opening':>9}{'right':>8}{'left':>7}{'back':>7}{'forward':>9}{'condyles':>10}  file [mm]"]
    for entry in entries:
        (_, opening), (right, left), (back, forward) = (entry.ranges_mm[name] for name in PARAMETERS)
        row = f"{entry.actor[:19]:<20}{opening:9.1f}{right:8.1f}{left:7.1f}{back:7.1f}{forward:9.1f}"
        alike = f"  differs by {apart_mm[entry.path]:.1f} mm" if apart_mm else ""
        partial = "  lacks a movement" if entry.not_shown else ""
        lines.append(f"{row}{entry.condylar_distance_mm:10.1f}  {entry.path}{alike}{partial}")
    lines.append(f"{len(entries)} rigs; {opened.reread} of the folder are new or changed")
    return lines + [f"skipped {path}: {why}" for path, why in opened.skipped.items()]


def _compare(first: Entry, second: Entry, as_json: bool) -> None:
    a, b = _measures(first), _measures(second)
    apart_mm = landmark_distance_mm(first.landmarks(), second.landmarks())
    lines = [f"{'[mm]':<22}{first.actor[:15]:>16}{second.actor[:15]:>16}{'difference':>12}"]
    lines += [f"{key:<22}{a[key]:16.2f}{b[key]:16.2f}{b[key] - a[key]:+12.2f}" for key in a]
    lines.append(f"landmarks differ by {apart_mm:.2f} mm rms after the best rigid fit")
    compared = {
        "first": first.path,
        "second": second.path,
        "actors": [first.actor, second.actor],
        "landmark_distance_mm": apart_mm,
        "measures_mm": {key: {"first": a[key], "second": b[key], "difference": b[key] - a[key]} for key in a},
    }
    emit(compared, as_json, lines)


def _measures(entry: Entry) -> dict[str, float]:
    ends = {f"{key}_{end}": entry.ranges_mm[key][i] for key in PARAMETERS for i, end in enumerate(("min", "max"))}
    return {**ends, "condylar_distance": entry.condylar_distance_mm, "condyle_incisor": entry.condyle_incisor_mm}


def publish(
    source: Annotated[Path, Argument(help="Folder of a rig (with actor.usda), or a shot.", metavar="FOLDER|SHOT")],
    out: Annotated[Path, Option("-o", "--out", help="Folder to write, or the .usdz of a shot.")],
    prefix: Annotated[str | None, Option(help="Prefix of all file names. Default: the actor's name.")] = None,
    prim_name: options.PrimName = None,
    force: options.Force = False,
    allow: options.Allow = None,
    as_json: options.Json = False,
) -> None:
    """Copy a rig under unique file names, so that several actors can be packed together; or pack a shot as .usdz."""
    from jawusd.rig.publish import publish_rig, write_package

    refuse_existing(out, force)
    if not source.is_dir():
        if out.suffix.lower() != ".usdz" or prefix is not None or prim_name is not None:
            raise BadParameter(
                "a shot is packed as .usdz; give such a file, and neither --prefix nor --prim-name.", param_hint="--out"
            )
        files = [str(write_package(out, source))]
    else:
        files = [str(path) for path in publish_rig(source, out, prefix, prim_name)]
    emit({"files": files}, as_json, files)
