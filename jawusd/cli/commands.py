"""The commands by name, loaded when first used, and their common behaviour: help, vector options, and Ctrl+C."""

from __future__ import annotations

import contextlib
import functools
import importlib
import itertools
import re
import shlex
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from types import FrameType
from typing import NoReturn, Protocol, cast

import typer
from typer.core import TyperCommand, TyperGroup

from jawusd.base.errors import JawusdError
from jawusd.cli.output import RunLog, say

#: Example command lines by command; each has at most 76 characters.
EXAMPLES = {
    "doctor": ("jawusd doctor",),
    "demo": ("jawusd demo -o capture", "jawusd demo -o capture --seed 3 --frames 480"),
    "init": ("jawusd init footage --square-mm 8", "jawusd init --reference"),
    "check": ("jawusd check capture",),
    "calibrate": ("jawusd calibrate capture -o capture/calibration.toml",),
    "cameras": ("jawusd cameras metashape.xml -o cameras.usda --unit-mm 1000",),
    "sync": ("jawusd sync capture", "jawusd sync left.mp4 front.mp4 right.mp4 --plot sync.png"),
    "segment": ("jawusd segment capture -o masks", "jawusd segment capture -o masks --keys drawn --force"),
    "scans": ("jawusd scans capture",),
    "photos": ("jawusd photos front.png left.png --upper-teeth up.ply --lower-teeth low.ply",),
    "plates": ("jawusd plates capture out",),
    "build": ("jawusd build examples/capture -o out", "jawusd build capture -o out --dry-run"),
    "build-many": ("jawusd build-many list.txt -o actors --workers 4",),
    "track": ("jawusd track capture -o tracks.npz --overlay overlay.mp4",),
    "fit": (
        "jawusd fit tracks.npz --capture capture -o model.npz",
        "jawusd fit poses.csv --landmarks landmarks.json --length-unit m",
    ),
    "bake": ("jawusd bake model.npz --capture capture -o out",),
    "publish": ("jawusd publish out -o lib/hero --prefix hero", "jawusd publish shot.usda -o shot.usdz"),
    "library": ("jawusd library actors --add out --name hero", "jawusd library actors --plot figures"),
    "animate": (
        "jawusd animate out keys.json -o out/anim_take.usdc",
        "jawusd animate out --arkit face.csv -o take.glb",
    ),
    "retarget": (
        "jawusd retarget out/anim_take.usdc --from out --to other -o anim_other.usdc",
        "jawusd retarget --landmarks face.json --library people -o model.npz",
    ),
    "solve": (
        "jawusd solve out shot -o take.npz --overlay take.mp4 --report take.html",
        "jawusd solve out shot --skin skin.npz --face face.csv -o take.npz",
    ),
    "live": (
        "jawusd live out shot --source left=/dev/video0 --osc 127.0.0.1:9000 --view",
        "jawusd live out shot --source left=/dev/video0 --skin skin.npz --face face.csv",
    ),
    "rebake": ("jawusd rebake shot.usda -o jaws.usdc", "jawusd rebake out export.fbx -o anim_edited.usdc"),
    "arkit-fit": ("jawusd arkit-fit out face.csv take.npz -o arkit.npz",),
    "arkit-table": ("jawusd arkit-table out --mapping arkit.npz -o joint.csv",),
    "align": ("jawusd align out points.json -o T_skull_model.json",),
    "skin-fit": (
        "jawusd skin-fit out take.npz face.csv -o skin.npz --bite 1200-1260",
        "jawusd skin-fit out take.npz markers.c3d --rigid head=HL,HR,HF --rest-frame 0",
    ),
    "view": ("jawusd view capture --tracks out", "jawusd view out --page jaw.html"),
    "info": ("jawusd info out", "jawusd info out/tracks.npz --frame 120"),
    "report": ("jawusd report out", "jawusd report out --experiments"),
    "validate": ("jawusd validate out", "jawusd validate out --face jaw.npz --align T_skull_model.json"),
    "pose": ("jawusd pose out --d 20 2 1",),
    "encode": ("jawusd encode out poses.csv -o d.csv",),
    "ik": ("jawusd ik out --point 0,2,-3 --target 0,-18,-10",),
}


#: Groups of `jawusd --help`, with the module and the summary of each command.
_COMMANDS = {
    "Start": {
        "doctor": ("capture", "Check the installation."),
        "demo": ("build", "Render a synthetic capture with ground truth."),
    },
    "Capture": {
        "init": ("capture", "Draft a capture.toml from a folder of footage and scans."),
        "check": ("capture", "Check a capture in seconds."),
        "calibrate": ("capture", "Calibrate the cameras from clips of a board."),
        "cameras": ("capture", "Convert calibrated cameras between programs."),
        "sync": ("capture", "Estimate the frame offsets between cameras."),
        "segment": ("capture", "Make masks of the teeth from the videos."),
        "scans": ("capture", "Label crown and gum of the scans."),
        "photos": ("capture", "Register two scans in occlusion from photographs."),
        "plates": ("capture", "Write undistorted footage."),
    },
    "Rig": {
        "build": ("build", "Build a rig from a capture."),
        "build-many": ("build", "Build many captures, one process each."),
        "track": ("build", "Track the teeth of both jaws."),
        "fit": ("build", "Fit a jaw model to tracks or other poses."),
        "bake": ("build", "Write the OpenUSD rig of a model."),
        "publish": ("library", "Copy a rig under unique names, or pack a shot."),
        "library": ("library", "Manage many actors and compare their ranges."),
    },
    "Animate": {
        "animate": ("animate", "Write an animation of a rig from keys, poses or ARKit."),
        "retarget": ("library", "Retarget a motion to another subject's rig."),
        "solve": ("solve", "Track a performance of a subject with a rig."),
        "live": ("solve", "Track the jaw in live video."),
        "rebake": ("stage", "Make d and mandible of an edited stage agree."),
        "arkit-fit": ("face", "Learn d from a subject's ARKit jaw weights."),
        "arkit-table": ("animate", "Write the jaw joint's offset per ARKit shape."),
        "align": ("face", "Align a face model with a rig by a few points."),
        "skin-fit": ("face", "Learn the jaw from facial skin, for closed lips."),
    },
    "Inspect": {
        "view": ("report", "View a rig or a capture in the browser."),
        "info": ("rig", "Describe a rig file or tracks."),
        "report": ("report", "Write the report of a build or a solve again."),
        "validate": ("rig", "Check a rig, or poses against a rig."),
        "pose": ("rig", "Print the jaw pose at parameters d."),
        "encode": ("stage", "Convert poses to the nearest parameters d."),
        "ik": ("rig", "Find the d that move a point to a target."),
    },
}
GROUPS = {title: {name: words for name, (_, words) in rows.items()} for title, rows in _COMMANDS.items()}
_MODULES = {name: module for rows in _COMMANDS.values() for name, (module, _) in rows.items()}
SUMMARIES = {name: words for group in GROUPS.values() for name, words in group.items()}

EXIT_CODES = (
    "Exit codes: 0 done, 1 a negative result (invalid poses, something missing, a failed build of many), "
    "2 wrong usage, 3 a file is invalid, 4 a package is missing; an error 5 of the capture, 6 in tracking, "
    "7 in fitting, 8 of the rig, 9 of the model, 10 of the output, 11 of a cluster; 12 out of memory or a library "
    "crashed, 130 stopped with Ctrl+C."
)


#: Exit code of a command stopped with Ctrl+C, as reported by shells.
INTERRUPTED = 130
CONTEXT = {"help_option_names": ["-h", "--help"]}

_WORDS = "jawusd.words"  # key under which a command's arguments are stored in the context
_VECTOR = re.compile(r" *[-+]?[\d.eE+-]+((, *| +)[-+]?[\d.eE+-]+){2} *")
_VECTORS, _VECTOR_LENGTH = ("--d", "--point", "--target", "--start"), 3

# Messages that state which results an interrupted command keeps, and how to resume it. Commands not listed write their
# files at the end, complete.
_KEPT = {
    "build": "finished stages are kept; resume with the same command and --resume, start over with --fresh",
    "build-many": "finished captures and stages are kept; resume with the same command and --resume",
    "segment": "finished frames are kept; resume with the same command and --resume",
    "plates": "the images written so far are kept; start over with --force",
    "demo": "the files written so far are kept, but are incomplete without capture.toml; start over with --force",
    "bake": "the files written so far are kept, but the rig is incomplete; start over with --force",
}
_ELSE = "no incomplete file was written"


class _Parameter(Protocol):
    param_type_name: str

    def get_help_record(self, ctx: typer.Context) -> tuple[str, str] | None: ...


class _Formatter(Protocol):
    def section(self, name: str) -> AbstractContextManager[None]: ...
    def write(self, text: str) -> None: ...
    def write_dl(self, rows: Sequence[tuple[str, str]]) -> None: ...


# Names shown in help for typer's types. Options with several values have individual names.
_KINDS = {"path": "PATH", "str": "TEXT", "int": "N", "int range": "N", "float": "NUMBER", "float range": "NUMBER"}


def help_row(parameter: _Parameter, ctx: typer.Context) -> tuple[str, str] | None:
    """Return the names and the description of an argument or option, as shown in help; None if it is hidden."""
    row = parameter.get_help_record(ctx)
    if row is None:
        return None
    names, meaning = row
    if parameter.param_type_name == "argument":
        return re.sub(r" <[^<>]*>$", "", names), meaning
    return re.sub(r"<([^<>]*)>", lambda found: _KINDS.get(found[1], found[1]), names), meaning


class Command(TyperCommand):
    """A command of jawusd."""

    # typer passes its public Context to all methods; the base class declares that of its private copy of click.

    def format_options(self, ctx: typer.Context, formatter: _Formatter) -> None:  # type: ignore[override]  # as above
        """Write the help of arguments and options, without names of Python types."""
        for title, kind in (("Arguments", "argument"), ("Options", "option")):
            shown = [help_row(one, ctx) for one in self.get_params(ctx) if one.param_type_name == kind]
            rows = [row for row in shown if row is not None]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def format_epilog(self, ctx: typer.Context, formatter: _Formatter) -> None:  # type: ignore[override]  # as above
        """Write the example command lines, one per line."""
        lines = (self.epilog or "").splitlines()
        with formatter.section("Examples" if len(lines) > 1 else "Example"):
            for line in lines:
                formatter.write(f"  {line}\n")

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]  # click has its own Context
        """Split vectors such as `--d 20,2,1`, and store the arguments for `command_line`."""
        ctx.meta[_WORDS] = list(args)
        words = with_vectors_split(args)
        for at, option in enumerate(words):
            if option in _VECTORS:
                values = itertools.takewhile(lambda word: not word.startswith("--"), words[at + 1 :])
                _check_vector(option, list(itertools.islice(values, _VECTOR_LENGTH)))
        return super().parse_args(ctx, words)

    def invoke(self, ctx: typer.Context) -> object:  # type: ignore[override]  # as above
        """Run the command; on Ctrl+C, print which results are kept."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as stop:
            interrupted(self.name or "", stop.exit_code if isinstance(stop, _StoppedError) else INTERRUPTED)
        except (JawusdError, OSError, RuntimeError) as error:
            if isinstance(ctx.obj, RunLog) and not isinstance(error, typer.Exit):
                ctx.obj.error(error)
            raise


def command_line(ctx: typer.Context) -> str:
    """Return the command line of the running command, quoted for a shell."""
    return shlex.join(["jawusd", str(ctx.info_name), *ctx.meta[_WORDS]])


def with_vectors_split(args: list[str]) -> list[str]:
    """Split the values of vector options, such as 20,2,1 or "20 2 1", into three arguments each."""
    out: list[str] = []
    for word in args:
        option, sign, value = word.partition("=")
        if sign and option in _VECTORS and _VECTOR.fullmatch(value):
            out += [option, *value.replace(",", " ").split()]
        elif out and out[-1] in _VECTORS and _VECTOR.fullmatch(word):
            out += word.replace(",", " ").split()
        else:
            out.append(word)
    return out


def _check_vector(option: str, values: Sequence[str]) -> None:
    """Raise typer.BadParameter unless the words after a vector option are three numbers."""
    try:
        count = len([float(word) for word in values])
    except ValueError:
        count = 0
    if count != _VECTOR_LENGTH:
        said = f'needs three numbers, such as 20,2,1; found "{" ".join(values)}".'
        raise typer.BadParameter(said, param_hint=option)


class _StoppedError(KeyboardInterrupt):
    """A signal that ends a command in the same way as Ctrl+C."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.exit_code = 128 + number  # the exit code that shells report for a signal


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP end the context as Ctrl+C does, so that cleanup runs."""

    def stop(number: int, _: FrameType | None) -> NoReturn:
        for other in taken:  # ignore further signals during the cleanup
            signal.signal(other, signal.SIG_IGN)
        raise _StoppedError(number)

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    taken = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]  # nohup ignores SIGHUP
    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def interrupted(command: str, exit_code: int = INTERRUPTED) -> NoReturn:
    """Print that a command was stopped, and which results are kept; exit with the signal's code."""
    say(f"jawusd {command}: stopped; {_KEPT.get(command, _ELSE)}.", err=True)
    raise typer.Exit(exit_code)


class Commands(TyperGroup):
    """The group of all commands; listing them does not load their modules."""

    # Contexts are objects here: typer passes its public Context, the base class declares that of its copy of click.

    def __init__(self, **settings: object) -> None:
        super().__init__(**settings)  # type: ignore[arg-type]  # passed on unchanged
        self.commands = _Loaded()  # type: ignore[assignment]  # a mapping that loads on demand

    def list_commands(self, ctx: object) -> list[str]:
        """Return the command names in the order of `jawusd --help`."""
        return list(SUMMARIES)

    def format_commands(self, ctx: object, formatter: _Formatter) -> None:
        """Write the commands with their summaries, by group."""
        wide = max(map(len, SUMMARIES))
        for title, group in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(wide), words) for name, words in group.items()])


class _Loaded(Mapping[str, TyperCommand]):
    """The commands by name; looking one up loads its module."""

    def __getitem__(self, name: str) -> TyperCommand:
        return _load(name, _MODULES[name])

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


@functools.cache
def _load(name: str, module: str) -> TyperCommand:
    function = getattr(importlib.import_module(f"jawusd.cli.{module}_commands"), name.replace("-", "_"))
    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    examples = "\n".join(EXAMPLES[name])
    alone.command(name, cls=Command, context_settings=CONTEXT, short_help=SUMMARIES[name], epilog=examples)(function)
    return cast(TyperCommand, typer.main.get_command(alone))
