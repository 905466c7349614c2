"""``python -m jawusd.evaluator``: poses, encoding and verdicts of a model.npz, with numpy alone.

    python -m jawusd.evaluator info MODEL
    python -m jawusd.evaluator pose MODEL --d 20 0 3
    python -m jawusd.evaluator encode MODEL poses.csv
    python -m jawusd.evaluator validate MODEL poses.csv

Poses are CSV with the columns frame, m00 ... m33 (row-major T_skull_mandible [mm]). Results go to stdout as CSV, or
JSON with --json. Exit codes: 0 success, 1 invalid poses, 2 wrong usage, 3 and higher other errors (see
jawusd.base.errors).
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jawusd.base.arrays import Array
from jawusd.base.errors import FormatError, JawusdError, errors_name_file
from jawusd.base.tables import read_table
from jawusd.evaluator.rig import JawRig, load

_MAX_BYTES = 1 << 30
_MATRIX_COLUMNS = [f"m{row}{column}" for row in range(4) for column in range(4)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, given without the program's name (None: `sys.argv`), and return the exit code."""
    options = _parser().parse_args(arguments)
    try:
        return options.run(load(options.model), options)
    except JawusdError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        # the reading program (head, less) closed the pipe; prevent an error message at exit
        sys.stderr.close()
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m jawusd.evaluator", description="Evaluate a jaw model with numpy alone."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, run, text in (
        ("info", _info, "kind, ranges and limits of the model"),
        ("pose", _pose, "pose, twist, landmarks and margin of jaw parameters"),
        ("encode", _encode, "nearest jaw parameters and residual of each pose"),
        ("validate", _validate, "a verdict on each pose; exit code 1 if one is invalid"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("model", type=Path, help="model.npz")
        if name == "pose":
            command.add_argument("--d", type=float, nargs=3, required=True, metavar=("D1", "D2", "D3"), help="mm")
        elif name != "info":
            command.add_argument("poses", type=Path, help="CSV with the columns frame, m00 ... m33")
        if name == "encode":
            command.add_argument("--bounds", action="store_true", help="search only inside the bound")
        command.add_argument("--json", action="store_true", help="print JSON")
        command.set_defaults(run=run)
    return parser


def _info(rig: JawRig, options: argparse.Namespace) -> int:
    low, high = rig.d_range.T
    facts = {
        "actor": rig.meta.get("actor"),
        "kind": rig.kind,
        "method": rig.meta.get("method"),
        "d_min_mm": low.tolist(),
        "d_max_mm": high.tolist(),
        "residual_limit_mm": rig.limits.residual_mm,
        "tolerance_mm": rig.tolerance_mm,
        "captured_poses": len(rig.captured_d),
    }
    if options.json:
        print(json.dumps(facts))
    else:
        for name, value in facts.items():
            print(f"{name}: {value}")
    return 0


def _pose(rig: JawRig, options: argparse.Namespace) -> int:
    d = np.array(options.d)
    T = rig.pose(d)
    margin_mm = float(rig.margin(d))
    if options.json:
        landmarks = rig.landmarks @ T[:3, :3].T + T[:3, 3]
        facts = {
            "d": options.d,
            "T_skull_mandible": T.tolist(),
            "twist": rig.twist(d).tolist(),
            "landmarks_mm": landmarks.tolist(),
            "margin_mm": margin_mm,
            "inside": bool(rig.is_inside(d)),
        }
        print(json.dumps({name: _plain(value) for name, value in facts.items()}))
    else:
        _print_rows(["frame", *_MATRIX_COLUMNS, "margin_mm"], [[0, *T.ravel().tolist(), margin_mm]], as_json=False)
    return 0


def _encode(rig: JawRig, options: argparse.Namespace) -> int:
    frames, T = _read_poses(options.poses)
    d, residual_mm = rig.encode(T, inside=options.bounds)
    rows = [[frame, *x, r] for frame, x, r in zip(frames, d.tolist(), residual_mm.tolist())]
    _print_rows(["frame", "d1", "d2", "d3", "residual_mm"], rows, as_json=options.json)
    return 0


def _validate(rig: JawRig, options: argparse.Namespace) -> int:
    frames, T = _read_poses(options.poses)
    verdicts = rig.validate(T)
    columns = (verdicts.valid.tolist(), verdicts.words(), verdicts.residual_mm.tolist(), verdicts.margin_mm.tolist())
    rows = [[frame, *row] for frame, *row in zip(frames, *columns)]
    _print_rows(["frame", "valid", "reason", "residual_mm", "margin_mm"], rows, as_json=options.json)
    return 0 if verdicts.valid.all() else 1


def _print_rows(header: list[str], rows: Sequence[Sequence[object]], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps([{name: _plain(value) for name, value in zip(header, row)} for row in rows]))
        return
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)


def _plain(value: object) -> object:
    """Return the value with non-finite numbers replaced by None, since JSON has no NaN."""
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


@errors_name_file
def _read_poses(path: Path) -> tuple[list[int], Array]:
    """Return frame numbers and T_skull_mandible (F, 4, 4) of a CSV table; nan and inf are kept."""
    table = read_table(path, _MAX_BYTES)
    missing = [name for name in ("frame", *_MATRIX_COLUMNS) if name not in table.header]
    if missing:
        raise FormatError(f'has no "{missing[0]}" column; required columns: frame, m00 ... m33.', path=path)
    frames = table.numbers([table.header.index("frame")])[:, 0]
    uneven = np.flatnonzero((frames != np.round(frames)) | ~(np.abs(frames) <= 2**53))
    if uneven.size:
        raise FormatError(f"{table.places[uneven[0]]}: frame numbers must be whole numbers.", path=path)
    values = table.numbers([table.header.index(name) for name in _MATRIX_COLUMNS])
    return frames.astype(np.int64).tolist(), values.reshape(-1, 4, 4)


if __name__ == "__main__":
    sys.exit(main())
