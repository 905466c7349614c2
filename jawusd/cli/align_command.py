"""The command `align`, which aligns a face model with a rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jawusd.cli.options import Allow, Force, Json, Prim, RigArg
from jawusd.cli.output import emit
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.formats.alignment import Alignment


def align(
    rig: RigArg,
    correspondences: Annotated[
        Path, typer.Argument(help="Points of the face model and of the rig (JSON).", show_default=False)
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="Alignment to write (JSON).")] = Path("T_skull_model.json"),
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Align a face model (FLAME, SMPL-X, ICT-FaceKit, any) with the skull frame of a rig, by a few named points.

    The rig provides the lower incisal point, first molars and condyles; other points, such as the chin, need their
    position in the skull frame. The command prints the expected error at the teeth and the condyles.
    """
    import jawusd
    from jawusd.base.errors import naming_file
    from jawusd.formats.alignment import load_correspondences, save_alignment

    refuse_existing(out, force)
    loaded, given = jawusd.load(rig, prim=prim), load_correspondences(correspondences)
    points = given.points
    with naming_file(correspondences):
        found = jawusd.align(
            loaded,
            {name: point.model for name, point in points.items()},
            {name: point.rig for name, point in points.items() if point.rig is not None},
            sigma_mm={name: point.sigma_mm for name, point in points.items()},
            unit_mm=given.unit_mm,
            scale=given.scale,
            joint=given.joint,
        )
    save_alignment(out, found)
    emit({"file": str(out), **found.model_dump(mode="json")}, as_json, lambda: _lines(out, found, given.scale))


def _lines(out: Path, found: Alignment, scale: bool) -> list[str]:
    unit = f"; a model unit is {found.unit_mm:.4g} mm" if scale else ""
    return [
        f"{out}: from {len(found.off_mm)} points{unit}",
        f"expected error {found.teeth_mm:.2f} mm at the teeth, {found.condyles_mm:.2f} mm at the condyles",
        "distances after the fit [mm]: " + ", ".join(f"{name} {off:.1f}" for name, off in found.off_mm.items()),
    ]
