"""Commands on many actors: library, and retarget, from one rig to another or to somebody who has none."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jawusd.cli.output import emit, progress, refuse_existing

if TYPE_CHECKING:
    from jawusd.library.index import Entry, Library

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite an existing output.")]


class Use(StrEnum):
    """Name the ways to use a library."""

    average = "average"
    closest = "closest"


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("retarget")(retarget)
    app.command("library")(library)


def retarget(
    anim: Annotated[
        Path | None,
        typer.Argument(help="Motion of --from: an animation layer, keys.json, or a CSV of d or poses."),
    ] = None,
    source: Annotated[Path | None, typer.Option("--from", help="Rig the motion was made for.")] = None,
    target: Annotated[Path | None, typer.Option("--to", help="Rig that shall move.")] = None,
    landmarks: Annotated[
        Path | None, typer.Option(help="Instead of a motion: landmarks (JSON) of a person without a capture.")
    ] = None,
    library_folder: Annotated[
        Path | None, typer.Option("--library", help="With --landmarks: folder of rigs to learn from.")
    ] = None,
    use: Annotated[Use, typer.Option(help="With --landmarks: average the library, or take the closest.")] = Use.average,
    fps: Annotated[float | None, typer.Option(min=0.001, help="Frames per second; the motion's own else.")] = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="Layer of the motion (retargeted.usdc) or model of the person (model.npz)."),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Carry a motion to another rig, or make a rig for a person from landmarks and a library."""
    moving, person = (anim, source, target), (landmarks, library_folder)
    if all(moving) and not any(person):
        _retarget_motion(anim, source, target, fps, out or Path("retargeted.usdc"), force, as_json)
    elif all(person) and not any((*moving, fps)):
        _personal(landmarks, library_folder, use, out or Path("model.npz"), force, as_json)
    else:
        raise typer.BadParameter("give either ANIM, --from and --to, or --landmarks and --library.")


def _retarget_motion(
    anim: Path, source: Path, target: Path, fps: float | None, out: Path, force: bool, as_json: bool
) -> None:
    from jawusd.cli.motion import carried_over, carried_over_lines
    from jawusd.pipeline.library import load_any_rig
    from jawusd.rig import write_animation
    from jawusd.rig.read import describe

    refuse_existing(out, force)
    for place, option in ((out, "--out"), (target, "--to")):
        if place.suffix not in (".usd", ".usda", ".usdc"):
            raise typer.BadParameter("must be a USD layer: .usda, .usdc or .usd.", param_hint=option)
    taker = load_any_rig(target)
    motion, report = carried_over(source, anim, taker)
    rate = fps or motion.fps or describe(target)["fps"]
    write_animation(out, target, motion.frames, motion.d, rate, rig=taker)
    result = {"file": str(out), "fps": rate, **report}
    emit(result, as_json, lambda: carried_over_lines(result))


def _personal(landmarks: Path, folder: Path, use: Use, out: Path, force: bool, as_json: bool) -> None:
    from jawusd.formats.model import save_model
    from jawusd.pipeline.library import open_library, personal_rig

    refuse_existing(out, force)
    opened = open_library(folder)
    with progress() as report:
        made = personal_rig(landmarks, opened, closest=use is Use.closest, name=landmarks.stem, progress=report)
    save_model(out, made.model)
    meta = made.model.meta
    result = {
        "file": str(out),
        "use": use.value,
        **meta["personal"],
        "ranges_mm": meta["ranges_mm"],
        "not_used": [*made.left_out, *opened.skipped],
        "warnings": meta["warnings"],
    }
    emit(result, as_json, lambda: _personal_lines(result))


def _personal_lines(result: dict[str, Any]) -> list[str]:
    lines = [str(result["file"])]
    lines += [f"  {name}: {low:.1f} .. {high:.1f} mm" for name, (low, high) in result["ranges_mm"].items()]
    heaviest = sorted(result["weights"].items(), key=lambda item: -item[1])
    lines += [f"  from {name}: {weight:.0%}" for name, weight in heaviest]
    lines += [f"  not used: {name}" for name in result["not_used"]]
    return lines + [f"  {warning['code']}: {warning['message']}" for warning in result["warnings"]]


def library(
    folder: Annotated[Path, typer.Argument(help="Folder with a subfolder per person.", show_default=False)],
    search: Annotated[str | None, typer.Option(help="List only names and paths with this in them.")] = None,
    like: Annotated[Path | None, typer.Option(help="Sort by likeness to these landmarks (JSON).")] = None,
    compare: Annotated[tuple[str, str] | None, typer.Option(help="Two persons, side by side.")] = None,
    add: Annotated[Path | None, typer.Option(help="Copy this rig (actor.usda or model.npz) in first.")] = None,
    name: Annotated[str | None, typer.Option(help="With --add: name of the person; else as the rig says.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Folder for ranges.png and ranges.svg: those listed, side by side.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Keep many actors: bring the index library.json up to date, list, search, compare and plot."""
    from jawusd.pipeline.library import add_rig, open_library, plot_ranges

    if compare is not None and (search, like, plot) != (None, None, None):
        raise typer.BadParameter("--compare stands alone; --search, --like and --plot go together.")
    if name is not None and add is None:
        raise typer.BadParameter("belongs to --add.", param_hint="--name")
    if add is not None:
        add_rig(folder, add, name, force)
    opened = open_library(folder)
    if compare is not None:
        first, second = (opened.find(who) for who in compare)
        compared = _compared(first, second)
        emit(compared, as_json, lambda: _compare_lines(compared))
        return
    listed = _listed(opened, search, like)
    listed["plots"] = [] if plot is None else [str(path) for path in plot_ranges(listed["rigs"], plot, force)]
    emit(listed, as_json, lambda: _library_lines(listed))


def _listed(opened: Library, search: str | None, like: Path | None) -> dict[str, Any]:
    from dataclasses import asdict

    rigs = [asdict(entry) for entry in (opened.entries if search is None else opened.search(search))]
    if like is not None:
        from jawusd.formats.landmarks import load_landmarks
        from jawusd.library.transport import landmark_distance_mm

        wanted, marks = load_landmarks(like).landmarks, {entry.path: entry.landmarks() for entry in opened.entries}
        for rig in rigs:
            rig["landmark_distance_mm"] = landmark_distance_mm(marks[rig["path"]], wanted)
        rigs.sort(key=lambda rig: rig["landmark_distance_mm"])
    return {"folder": str(opened.folder), "reread": opened.reread, "rigs": rigs, "skipped": opened.skipped}


def _library_lines(listed: dict[str, Any]) -> list[str]:
    from jawusd.library.index import PARAMETERS

    lines = [f"{'actor':<20}{'opening':>9}{'right':>8}{'left':>7}{'back':>7}{'forward':>9}{'condyles':>10}  file [mm]"]
    for rig in listed["rigs"]:
        (_, opening), (right, left), (back, forward) = (rig["ranges_mm"][name] for name in PARAMETERS)
        row = f"{rig['actor'][:19]:<20}{opening:9.1f}{right:8.1f}{left:7.1f}{back:7.1f}{forward:9.1f}"
        alike = f"  unlike by {rig['landmark_distance_mm']:.1f} mm" if "landmark_distance_mm" in rig else ""
        partial = "  lacks a movement" if rig["not_shown"] else ""
        lines.append(f"{row}{rig['condylar_distance_mm']:10.1f}  {rig['path']}{alike}{partial}")
    lines.append(f"{len(listed['rigs'])} rigs, {listed['reread']} of the folder's new or changed")
    lines += [f"skipped {path}: {why}" for path, why in listed["skipped"].items()]
    return lines + listed["plots"]


def _compared(first: Entry, second: Entry) -> dict[str, Any]:
    from jawusd.library.index import PARAMETERS
    from jawusd.library.transport import landmark_distance_mm

    def numbers(entry: Entry) -> dict[str, float]:
        ends = {f"{key}_{end}": entry.ranges_mm[key][i] for key in PARAMETERS for i, end in enumerate(("min", "max"))}
        return {
            **ends,
            "condylar_distance": entry.condylar_distance_mm,
            "condyle_incisor": entry.condyle_incisor_mm,
        }

    a, b = numbers(first), numbers(second)
    rows = {key: {"first": a[key], "second": b[key], "difference": b[key] - a[key]} for key in a}
    return {
        "first": first.path,
        "second": second.path,
        "actors": [first.actor, second.actor],
        "landmark_distance_mm": landmark_distance_mm(first.landmarks(), second.landmarks()),
        "measures_mm": rows,
    }


def _compare_lines(compared: dict[str, Any]) -> list[str]:
    first, second = compared["actors"]
    lines = [f"{'[mm]':<22}{first[:15]:>16}{second[:15]:>16}{'difference':>12}"]
    for name, row in compared["measures_mm"].items():
        lines.append(f"{name:<22}{row['first']:16.2f}{row['second']:16.2f}{row['difference']:+12.2f}")
    return [*lines, f"landmarks differ by {compared['landmark_distance_mm']:.2f} mm rms after the best rigid fit"]
