"""The paper's experiments on a take: read it, compute, draw, and write the table."""

from __future__ import annotations

from pathlib import Path

from jawusd.errors import explain_missing_packages
from jawusd.formats.experiments import Experiments, save_table
from jawusd.pipeline.stages import Motion
from jawusd.pipeline.state import Progress
from jawusd.pipeline.subject import Subject

TABLE_FILE = "experiments.csv"


@explain_missing_packages()
def report_experiments(subject: Subject, motion: Motion, folder: Path, starts: int, progress: Progress) -> dict:
    """Do the paper's experiments and write figures and table.

    Args:
        subject: whose jaw.
        motion: tracks or poses.
        folder: where the files go; made if missing.
        starts: random starts of the paper's networks.
        progress: told of the work.

    Returns:
        `actor`, `frames`, `table` (rows), `coverage` (sentences), `notes` and `files`.

    Raises:
        FittingError: the poses cannot carry a model.
        MissingDependencyError: matplotlib is not installed.
        OutputError: a file cannot be written.
    """
    import jawusd.report.figures  # noqa: F401 before minutes of computing: it may not be installed

    return draw_experiments(do_experiments(subject, motion, starts, progress), folder)


@explain_missing_packages()
def do_experiments(
    subject: Subject, motion: Motion, starts: int, progress: Progress, *, quick: bool = False
) -> Experiments:
    """Do the paper's experiments.

    Args:
        subject: whose jaw.
        motion: tracks or poses.
        starts: random starts of the paper's networks.
        progress: told of the work.
        quick: leave out what takes minutes: the networks and the paper's model.

    Raises:
        FittingError: the poses cannot carry a model.
    """
    from jawusd.fitting import FittingConfig
    from jawusd.fitting.data import SubjectAnatomy
    from jawusd.fitting.experiments import run_experiments

    points = subject.measured_points()
    anatomy = SubjectAnatomy.of(subject.T_anatomical_skull, subject.landmarks, points, subject.T_rest)
    return run_experiments(
        motion,
        anatomy,
        bones=subject.bones,
        config=FittingConfig(starts=starts),
        actor=subject.name,
        quick=quick,
        progress=lambda done, total: progress("experiments", done, total),
    )


@explain_missing_packages()
def draw_experiments(found: Experiments, folder: Path) -> dict:
    """Write the figures and the table of the experiments; returns what `report_experiments` does.

    Args:
        found: the results.
        folder: where the files go; made if missing.

    Raises:
        OutputError: a file cannot be written.
    """
    from jawusd.report import figures

    files = figures.draw_experiments(found, folder)
    table = found.table()
    save_table(folder / TABLE_FILE, table)
    return {
        "actor": found.actor,
        "frames": found.frames,
        "table": table,
        "coverage": list(found.coverage.sentences),
        "notes": list(found.notes),
        "files": [*files, folder / TABLE_FILE],
    }


@explain_missing_packages()
def experiment_files(folder: Path) -> list[Path]:
    """Return the files that `report_experiments` writes into a folder."""
    from jawusd.report.figures import FIGURES

    return [folder / f"{name}.{suffix}" for name in FIGURES for suffix in ("png", "svg")] + [folder / TABLE_FILE]


def experiment_lines(summary: dict) -> list[str]:
    """Return the result of `report_experiments` as text.

    Args:
        summary: what it returned.
    """
    heads = ("mean", "median", "p95", "max")
    lines = [f"{summary['actor']}: {summary['frames']} captured poses; distances [mm]"]
    lines.append(f"{'experiment':<16}{'model':<30}{'quantity':<32}{'count':>6}" + "".join(f"{h:>9}" for h in heads))
    for row in summary["table"]:
        figures = "".join(f"{row[f'{head}_mm']:9.3f}" for head in heads)
        lines.append(f"{row['experiment']:<16}{row['model']:<30}{row['quantity']:<32}{row['count']:>6}{figures}")
    lines += [f"note: {note}" for note in summary["notes"]]
    lines += [f"coverage: {sentence}" for sentence in summary["coverage"] or ["no exercise is missing."]]
    return lines + [str(path) for path in summary["files"]]
