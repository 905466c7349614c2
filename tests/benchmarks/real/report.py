"""Tables as Markdown, and plots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np


@dataclass(frozen=True)
class Origin:
    """Say what data the rows of tables are on, under which licence, and the section of the command that prints them."""

    data: str
    licence: str
    section: str


def title(text: str, origin: Origin) -> None:
    """Print the heading of a section."""
    print(f"\n## {text}\n\nData: {origin.data}; licence: {origin.licence}.\n", flush=True)


def table(header: Sequence[str], rows: Iterable[Sequence[object]], origin: Origin) -> None:
    """Print a Markdown table, a row as soon as it is there, each with its origin."""
    names = (origin.data, origin.licence, f"`--only {origin.section}`")
    header = (*header, "data", "licence", "command")
    print("| " + " | ".join(header) + " |")
    print("|" + "---|" * len(header), flush=True)
    for row in rows:
        print("| " + " | ".join(map(str, (*row, *names))) + " |", flush=True)
    print(flush=True)


def bars(path: Path, groups: dict[str, dict[str, float]], unit: str) -> None:
    """Draw bars of figures, a group of bars per name."""
    figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
    series = list(next(iter(groups.values())))
    for k, name in enumerate(series):
        heights = [group[name] for group in groups.values()]
        axes.bar(np.arange(len(groups)) + (k - (len(series) - 1) / 2) * 0.8 / len(series), heights, 0.8 / len(series))
    axes.set_xticks(range(len(groups)), groups, rotation=25, ha="right")
    axes.legend(series)
    axes.set_ylabel(unit)
    saved(figure, path)


def curves(path: Path, lines: dict[str, np.ndarray], unit: str) -> None:
    """Draw a value per frame for each name."""
    figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
    for name, values in lines.items():
        axes.plot(values, label=name, linewidth=0.8)
    axes.legend()
    axes.set_xlabel("frame")
    axes.set_ylabel(unit)
    saved(figure, path)


def saved(figure: plt.Figure, path: Path) -> None:
    """Write a figure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)
