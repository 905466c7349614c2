"""Arguments and options used by several commands."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, BadParameter, Context, Option

if TYPE_CHECKING:
    from jawusd.evaluator import JawRig
    from jawusd.formats.finding import Finding
    from jawusd.pipeline.fit import TrajectoryOptions
    from jawusd.pipeline.subject import Subject


Method = Literal["anchored", "additive", "paper", "pca"]
LengthUnit = Literal["mm", "cm", "m"]
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")

Json = Annotated[bool, Option("--json", help="Print the result as JSON.")]
Force = Annotated[bool, Option("--force", help="Overwrite an existing output.")]
Outside = Annotated[bool, Option("--allow-outside", help="Allow paths that point outside the capture's folder.")]
Jobs = Annotated[int, Option(min=1, max=64, help="Number of threads.")]
CaptureArg = Annotated[Path, Argument(help="capture.toml or its folder.")]


def _allow(folders: list[Path] | None) -> list[Path] | None:
    from jawusd.base.inputs import allow_folders

    allow_folders(folders or ())
    return folders


Allow = Annotated[
    list[Path] | None,
    Option(
        "--allow",
        metavar="FOLDER",
        callback=_allow,
        help="Folder from which a rig or shot may load files, such as a library; repeatable. "
        "Environment variable: JAWUSD_ALLOW.",
    ),
]
Prim = Annotated[str | None, Option("--prim", help="Path of the rig's prim, if a stage has several rigs.")]


def _prim_name(name: str | None) -> str | None:
    from jawusd.rig.layout import check_prim_name

    return None if name is None else check_prim_name(name)


PrimName = Annotated[
    str | None,
    Option(
        "--prim-name",
        callback=_prim_name,
        help="Name of the actor's prim and joints. Default: derived from the actor's name.",
    ),
]


def rig_of_folder(rig: Path | None) -> Path | None:
    """Return the rig's file if the path is the folder of a build, otherwise the path; callback of all rig arguments."""
    from jawusd.rig.layout import actor_in_folder

    return None if rig is None else actor_in_folder(rig)


_FOLDER = "jawusd.folder"  # key under which the path given for a rig is stored in the context


def _noted(context: Context, rig: Path | None) -> Path | None:
    context.meta[_FOLDER] = rig
    return rig_of_folder(rig)


def changed_in_folder(context: Context) -> list[Finding]:
    """Return findings on files modified since the build, if the rig was given as the folder of a build."""
    from jawusd.pipeline.state import changed_files

    folder = context.meta[_FOLDER]
    return changed_files(folder) if folder.is_dir() else []


RigArg = Annotated[
    Path, Argument(help="Folder of a rig, its actor.usda or another layer, or model.npz.", callback=_noted)
]
OptionalRigArg = Annotated[
    Path | None,
    Argument(help="Folder of a rig, its actor.usda or another layer, model.npz, or tracks.npz.", callback=_noted),
]


def load_named(rig: Path, prim: str | None, stage: Path | None = None) -> JawRig:
    """Load a rig; `--prim` is a path in the stage if one is given, otherwise in the rig's own file."""
    import jawusd

    beside = stage is not None and stage.suffix.lower() in USD_SUFFIXES and stage.resolve() != rig.resolve()
    return jawusd.load(rig, prim=None if beside or rig.suffix == ".npz" else prim)


# Options that describe the subject.
CaptureOption = Annotated[Path | None, Option(help="Capture with scans and landmarks.")]
UpperOption = Annotated[Path | None, Option(help="Scan of the upper teeth, instead of a capture.")]
LowerOption = Annotated[
    Path | None, Option(help="Scan of the lower teeth, in the same coordinate frame, in occlusion.")
]
MandibleOption = Annotated[Path | None, Option(help="Mesh of the mandible, in the same coordinate frame.")]
LandmarksOption = Annotated[Path | None, Option(help="Landmarks (JSON), instead of a capture or scans.")]

# Options for the conventions of a file of poses.
ColumnsOption = Annotated[
    str | None, Option(help="Column names of a table: frame=Frame,tx=X,ty=Y,tz=Z,qw=W,... or m00=...,m01=...")
]
UnitOption = Annotated[LengthUnit, Option(help="Length unit, if the file does not state it.")]
InvertOption = Annotated[bool, Option("--invert", help="Invert the poses: those of the file map skull to mandible.")]
RestOption = Annotated[int | None, Option(help="Frame with the teeth in occlusion; poses are made relative to it.")]
GroupOption = Annotated[str | None, Option(help="Trajectory of an HDF5 file.")]
RigidOption = Annotated[
    list[str] | None,
    Option(
        metavar="BODY=MARKERS",
        help="For a file of markers: those fixed to the jaw and, unless the head is still, those fixed to the head. "
        "Give numbers or names, such as jaw=5,6,7,8 or jaw=JL,JR,JF (with --rest-frame), or a marker description, "
        "such as jaw=jaw.rig. Formats: C3D, TRC, QTM (TSV), Vicon CSV, plain tables of numbers, and ArtiSynth probes "
        "(marker%d.txt). Repeatable.",
    ),
]


def trajectory_options(
    columns: str | None,
    length_unit: LengthUnit,
    invert: bool,
    rest_frame: int | None,
    group: str | None,
    rigid: list[str] | None,
) -> TrajectoryOptions:
    """Return the conventions of a file of poses or markers, as given by the options."""
    from jawusd.pipeline.fit import TrajectoryOptions

    return TrajectoryOptions(_column_map(columns), length_unit, invert, rest_frame, group, rigid_bodies(rigid))


def rigid_bodies(given: list[str] | None) -> dict[str, str]:
    """Return the markers, or the description, of each rigid body by name, from texts BODY=MARKERS."""
    form = "jaw=MARKERS or head=MARKERS"
    found = named_values(given, form, "--rigid")
    for name, markers in found.items():
        if name not in ("head", "jaw"):
            raise BadParameter(f'"{name}={markers}" is not of the form {form}.', param_hint="--rigid")
    return found


def refuse_conflicts(*conflicts: tuple[object, str | None, str]) -> None:
    """Raise typer.BadParameter for a conflict of options; each is whether it is there, an option, and a message."""
    for found, option, message in conflicts:
        if found:
            raise BadParameter(message, param_hint=option)


def named_values(given: Iterable[str] | None, form: str, option: str) -> dict[str, str]:
    """Return the values by name of texts of the form NAME=VALUE, each with another name."""
    found: dict[str, str] = {}
    for text in given or ():
        name, _, value = (piece.strip() for piece in text.partition("="))
        if not name or not value:
            raise BadParameter(f'"{text}" is not of the form {form}.', param_hint=option)
        if name in found:
            raise BadParameter(f'"{name}" is given twice.', param_hint=option)
        found[name] = value
    return found


def _column_map(text: str | None) -> dict[str, str]:
    from jawusd.formats.poses import MATRIX_COLUMNS, QUATERNION_COLUMNS

    found = named_values(text.split(",") if text else None, "name=column", "--columns")
    for name in found:
        if name not in ("frame", *QUATERNION_COLUMNS, *MATRIX_COLUMNS):
            raise BadParameter(
                f'"{name}" is not a column of poses; it must be one of frame, '
                f"{', '.join(QUATERNION_COLUMNS)}, m00 ... m33.",
                param_hint="--columns",
            )
    return found


def subject_given(
    name: str,
    capture: Path | None,
    upper_teeth: Path | None,
    lower_teeth: Path | None,
    mandible: Path | None,
    landmarks: Path | None,
    allow_outside: bool,
) -> Subject:
    """Return the subject of a capture, which has its own name, of both scans, or of landmarks."""
    from jawusd.pipeline.subject import subject_of_capture, subject_of_landmarks, subject_of_scans
    from jawusd.pipeline.workspace import open_capture

    files = {"upper_teeth": upper_teeth, "lower_teeth": lower_teeth, "mandible": mandible}
    scans = {key: path for key, path in files.items() if path is not None}
    if sum((capture is not None, bool(scans), landmarks is not None)) != 1:
        raise BadParameter("give either --capture, or --upper-teeth and --lower-teeth, or --landmarks.")
    if capture is not None:
        return subject_of_capture(open_capture(capture, allow_outside=allow_outside))
    if landmarks is not None:
        return subject_of_landmarks(landmarks, name)
    if not {"upper_teeth", "lower_teeth"} <= set(scans):
        raise BadParameter("give both --upper-teeth and --lower-teeth; --mandible is optional.")
    return subject_of_scans(scans, name)
