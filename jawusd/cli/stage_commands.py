"""Commands on rigs among other files: stages edited elsewhere come back to d, rigs get names of their own."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from jawusd.base.errors import JawusdError
from jawusd.cli.options import USD_SUFFIXES, Allow, Force, Json, Prim, PrimName, RigArg, load_named
from jawusd.cli.output import emit
from jawusd.formats.atomic import refuse_existing

if TYPE_CHECKING:
    from jawusd.base.arrays import Array
    from jawusd.evaluator import JawRig
    from jawusd.rig.rebake import StageMotion


MandiblePrim = Annotated[
    str | None,
    typer.Option("--mandible", help="Of a stage: prim that holds the mandible's meshes, where names do not tell."),
]
SkullPrim = Annotated[str | None, typer.Option("--skull", help="The same of skull or upper teeth.")]


def encode(
    rig: RigArg,
    poses: Annotated[
        Path,
        typer.Argument(
            help="CSV or JSON of poses, tracks.npz, or a stage, .fbx or .glb with the actor's meshes.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="CSV of frame, d1, d2, d3, residual_mm, margin_mm.")] = Path(
        "d.csv"
    ),
    mandible: MandiblePrim = None,
    skull: SkullPrim = None,
    force: Force = False,
    prim: Prim = None,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Find the parameters d whose poses are nearest to given ones, and how far these are from the model.

    Of a stage, the mandible may be moved by transforms, bones or a point cache; `jawusd rebake` writes it back. FBX and
    glTF are read through Blender.
    """
    import numpy as np

    from jawusd.cli.motion import read_pose_table
    from jawusd.formats.poses import PARAMETER_COLUMNS, write_table

    refuse_existing(out, force)
    loaded = load_named(rig, prim, poses)
    if holds_stage(poses):
        motion = read_stage_motion(loaded, rig, poses, prim, mandible, skull, "mandible")
        frames, d, residual_mm = motion.frames.astype(int), motion.d, motion.residual_mm
    else:
        frames, T = read_pose_table(poses)
        d, residual_mm = loaded.encode(T)
    known = np.isfinite(d).all(1)
    margin_mm = loaded.margin(d)
    values = np.column_stack([d, residual_mm, margin_mm])
    write_table(out, ("frame", *PARAMETER_COLUMNS, "residual_mm", "margin_mm"), frames[known], values[known])
    residual = residual_mm[known]
    size = {
        "mean": float(residual.mean()) if residual.size else None,
        "max": float(residual.max()) if residual.size else None,
    }
    judged = judged_motion(loaded, frames, d, residual_mm)
    result = {**judged, "file": str(out), "poses": len(d), "encoded": int(known.sum()), "residual_mm": size}
    head = f"{out}: {result['encoded']} of {len(d)} poses, residual {size}"
    still = still_lines(judged["moved_mm"], len(d)) if holds_stage(poses) else []
    emit(result, as_json, lambda: [head, *judged_lines(judged)[1:], *still])


def publish(
    source: Annotated[
        Path,
        typer.Argument(help="Folder of a rig, with actor.usda, or a shot.", metavar="FOLDER|SHOT", show_default=False),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder to write to, or of a shot the .usdz.", show_default=False)
    ],
    prefix: Annotated[
        str | None, typer.Option(help="Start of every file's name; the actor's name if not given.", show_default=False)
    ] = None,
    prim_name: PrimName = None,
    force: Force = False,
    allow: Allow = None,
    as_json: Json = False,
) -> None:
    """Copy a rig under file names of its own, so that actors can be packed together; or pack a whole shot as .usdz."""
    from jawusd.rig.package import write_package
    from jawusd.rig.publish import publish_rig

    refuse_existing(out, force)
    if not source.is_dir():
        if out.suffix.lower() != ".usdz" or prefix is not None or prim_name is not None:
            raise typer.BadParameter("of a shot, name a .usdz, and neither prefix nor prim.", param_hint="--out")
        files = [str(write_package(out, source))]
    else:
        files = [str(path) for path in publish_rig(source, out, prefix, prim_name)]
    emit({"files": files}, as_json, lambda: files)


_STILL_MM = 0.01  # ten times what single precision does to a jaw that stays still


def read_stage_motion(
    loaded: JawRig,
    rig: Path,
    stage: Path,
    prim: str | None,
    mandible: str | None,
    skull: str | None,
    origin: Literal["d", "mandible"] | None,
) -> StageMotion:
    """Read the motion of a jaw from any stage: of the rig it carries, or else of the rig's meshes fitted to it.

    Args:
        loaded, rig: The rig and its file.
        stage: A stage, or a file that Blender makes one of.
        prim: Which rig, where the stage has several, or the rig's file if the stage comes from Blender.
        mandible, skull: Prims to look below for the meshes.
        origin: What counts, see `motion_of_stage`.

    Raises:
        JawusdError: no such motion.
    """
    from jawusd.plugins.conversion import SUFFIXES, converted
    from jawusd.rig import describe
    from jawusd.rig.rebake import motion_of_stage
    from jawusd.rig.stage_poses import carries_rig

    if stage.suffix.lower() in SUFFIXES:
        _refuse_model(rig)
        rate = float(describe(rig, prim)["fps"])
        with tempfile.TemporaryDirectory() as folder:
            try:
                return _fitted(loaded, rig, converted(stage, folder, rate), mandible, skull, prim)
            except JawusdError as error:
                error.path = str(stage)
                raise
    if mandible is None and skull is None and carries_rig(stage, prim):
        return motion_of_stage(stage, loaded, prim, origin)
    return _fitted(loaded, rig, stage, mandible or prim, skull or prim, None)


def holds_stage(path: Path) -> bool:
    """Tell whether a file is a stage, or one that Blender makes a stage of."""
    from jawusd.plugins.conversion import SUFFIXES

    return path.suffix.lower() in (*USD_SUFFIXES, *SUFFIXES)


def _fitted(
    loaded: JawRig, rig: Path, stage: Path, mandible: str | None, skull: str | None, prim: str | None
) -> StageMotion:
    from jawusd.rig.rebake import StageMotion
    from jawusd.rig.stage_poses import fit_poses_of_stage

    _refuse_model(rig)
    if rig.resolve() == stage.resolve():
        message = f"meshes of {stage} deform, and are fitted to those of the rig: name the rig before it."
        raise typer.BadParameter(message, param_hint="RIG")
    found = fit_poses_of_stage(stage, rig, mandible, skull, prim)
    d, residual_mm = loaded.encode(found.T)
    return StageMotion(found.frames.astype(float), d, found.fps, "mandible", residual_mm, fitted=True)


def _refuse_model(rig: Path) -> None:
    if rig.suffix.lower() not in USD_SUFFIXES:
        raise typer.BadParameter("must be the rig's USD file here: its meshes are fitted.", param_hint="RIG")


def judged_motion(rig: JawRig, frames: Array, d: Array, residual_mm: Array) -> dict[str, float]:
    """Return how far a motion is from the model and from the bound."""
    import numpy as np

    known = np.isfinite(d).all(axis=1)
    margin = np.where(known, rig.margin(d), np.inf)
    outside = known & ~rig.is_inside(d)
    worst = int(np.argmin(margin))
    return {
        "frames": len(frames),
        "moved_mm": moved_mm(rig, d),
        "largest_residual_mm": float(np.nanmax(residual_mm, initial=0.0)),
        "off_model": int((residual_mm > rig.limits.residual_mm).sum()),
        "outside": int(outside.sum()),
        "beyond_tolerance": int((margin < -rig.tolerance_mm).sum()),
        "worst_frame": float(frames[worst]),
        "worst_margin_mm": float(margin[worst]),
    }


def moved_mm(rig: JawRig, d: Array) -> float:
    """Return how far a landmark of the mandible comes from where it is in the first pose of a motion d (F, 3) [mm]."""
    import numpy as np

    from jawusd.geometry import transform_points

    places = transform_points(rig.pose(d[np.isfinite(d).all(axis=1)]), rig.landmarks)
    return float(np.linalg.norm(places - places[:1], axis=-1).max(initial=0.0))


def still_lines(largest_mm: float, frames: int) -> list[str]:
    """Return what is said of a stage whose mandible stays where it is, as it does where only drivers or d moved it."""
    if largest_mm > _STILL_MM:
        return []
    return [f"the mandible does not move, in {frames} frames: exported without baking? Bake it to keys first"]


def judged_lines(judged: dict[str, float]) -> list[str]:
    """Return the same in words."""
    lines = [f"at most {judged['largest_residual_mm']:.3f} mm from the model"]
    if judged["off_model"]:
        lines.append(f"{judged['off_model']} of {judged['frames']} poses are farther from the model than measured ones")
    if judged["outside"]:
        where = f"worst at frame {judged['worst_frame']:g}, margin {judged['worst_margin_mm']:.2f} mm"
        lines.append(f"{judged['outside']} of {judged['frames']} samples lay outside the bound; {where}")
    return lines
