"""Draw the figures of the paper's experiments, and the coverage plot."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from jawusd.base.arrays import Array
from jawusd.formats.experiments import CondylePath, Coverage, Distances, Experiments
from jawusd.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    SKY,
    VERMILION,
    inline_svg,
    new_figure,
    save_figure,
)

FIGURES = ("fig5_condyle_path", "fig12_reconstruction", "fig13_synthesis", "coverage")

_HEADS = (PALE, SKY, BLUE, BLACK)  # colours of the condyle outlines, from closed to wide open
_BINS = 40
_SCALE_QUANTILE = 0.8  # quantile of the models' 95 % quantiles at which the shared axis of the histograms ends
_BONES_MM, _CLOSE_MM = 12.0, 1.5  # margins [mm] around the paths in the row with bones and in the enlarged row
_ADVICE_LETTERS = 140  # maximum number of characters per line of advice above the coverage plot
_FEW_MM = 1.0  # minimum range [mm] of the shared axis of the histograms
_MANY = 2500  # maximum number of points drawn as vectors; more are rasterised to limit the file size
_MOVES = ("opening d1", "laterotrusion d2", "protrusion d3")


def draw_experiments(found: Experiments, folder: Path) -> list[Path]:
    """Draw all `FIGURES` into a folder, as PNG and SVG, or raises OutputError; return the files."""
    drawn = (
        condyle_figure(found),
        reconstruction_figure(found),
        synthesis_figure(found),
        coverage_figure(found.coverage, found.actor),
    )
    return [file for name, figure in zip(FIGURES, drawn, strict=True) for file in save_figure(figure, folder, name)]


def inline_figures(found: Experiments) -> dict[str, Markup]:
    """Return the plots of the experiments as SVG, keyed by their placeholders in the report page."""
    figures = {
        "coverage": (coverage_figure(found.coverage, found.actor), "Captured poses, the bounds and the gaps."),
        "reconstruction": (reconstruction_figure(found), "Histograms of the reconstruction error of each model."),
        "synthesis": (synthesis_figure(found), "Histograms of the distance of random poses to captured ones."),
        "condyle": (condyle_figure(found), "Path of the left condyle when the jaw opens."),
        "parameters": (parameter_figure(found), "Path of the left condyle for each parameter."),
    }
    return {key: inline_svg(figure, key, words) for key, (figure, words) in figures.items()}


def condyle_figure(found: Experiments) -> Figure:
    """Draw paper Fig. 5: the left condyle in the sagittal plane while the jaw opens, one column per model.

    The upper row shows the bones, the lower row the path enlarged.
    """
    paths = found.condyle_paths
    if not paths:
        return _nothing_to_draw(f"{found.actor}: no model opens the jaw")
    figure, axes = new_figure(3.7 * len(paths), 7.4, 2, len(paths))
    for column, path in enumerate(paths):
        bones, close = axes[column], axes[len(paths) + column]
        bones.add_collection(LineCollection(list(found.skull), colors=ORANGE, linewidths=1.5, label="skull, cut"))
        for color, head in zip(_HEADS, path.heads, strict=False):
            bones.add_collection(LineCollection(list(head), colors=color, linewidths=1.0))
        for axis in (bones, close):
            _draw_path(axis, path, found.captured_condyles[0])
        _frame(bones, found, _BONES_MM)
        _frame(close, found, _CLOSE_MM)
        bones.set_title(f"{path.model}\nincisal opening up to {path.opening_mm.max():.0f} mm")
        close.set_xlabel("forward [mm]")
    for row in (0, 1):
        axes[row * len(paths)].set_ylabel("up [mm]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"{found.actor}: path of the left condyle when the jaw opens\nsagittal plane, front on the right")
    return figure


def _draw_path(axis: Axes, path: CondylePath, captured: Array) -> None:
    _draw_points(axis, captured[:, [2, 1]], GREY, "captured condyle centres")
    axis.plot(path.points[0, :, 2], path.points[0, :, 1], color=VERMILION, lw=2, label="opening of the model")
    marks = np.linspace(0, len(path.opening_mm) - 1, len(_HEADS)).round().astype(int)
    for color, k in zip(_HEADS, marks, strict=True):
        axis.plot(*path.points[0, k, [2, 1]], "o", ms=6, mfc=color, mec=VERMILION)


def _frame(axis: Axes, found: Experiments, around_mm: float) -> None:
    """Set the same square limits in every panel; they contain the captured condyles and all paths, with a margin."""
    drawn = [found.captured_condyles[0], *(path.points[0] for path in found.condyle_paths)]
    points = np.concatenate(drawn)[:, [2, 1]]
    middle = 0.5 * (points.min(0) + points.max(0))
    half = 0.5 * np.ptp(points, axis=0).max() + around_mm
    axis.set_xlim(middle[0] - half, middle[0] + half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    axis.set_box_aspect(1)
    axis.locator_params(nbins=6)


def parameter_figure(found: Experiments) -> Figure:
    """Draw the path of the left condyle as each parameter varies alone, for the linear and the default model.

    The figure follows paper Figs. 5 and 6: upper row from the side, lower row from above, one column per parameter.
    """
    if not found.parameter_paths:
        return _nothing_to_draw(f"{found.actor}: no model moves by single parameters")
    figure, axes = new_figure(11.0, 7.6, 2, 3)
    captured = found.captured_condyles[0]
    # (horizontal, vertical) coordinate of each row, and the names of the axes
    views = (((2, 1), "forward [mm]", "up [mm]"), ((0, 2), "to the left [mm]", "forward [mm]"))
    for row, ((h, v), across, along) in enumerate(views):
        for column in range(3):
            axis = axes[3 * row + column]
            _draw_points(axis, captured[:, [h, v]], GREY, "captured condyle centres")
            for path in found.parameter_paths:
                if path.parameter != column:
                    continue
                linear = path.model == "pca"
                label = "linear model (PCA)" if linear else f"{path.model} model"
                color, style = (BLUE, "--") if linear else (VERMILION, "-")
                axis.plot(path.points[:, h], path.points[:, v], style, color=color, lw=2, label=label)
                axis.plot(path.points[-1, h], path.points[-1, v], "o", ms=5, color=color)
            axis.set_aspect("equal", adjustable="datalim")
            axis.set_xlabel(across)
        axes[3 * row].set_ylabel(along)
    for column, name in enumerate(_MOVES):
        swept = [path.values_mm for path in found.parameter_paths if path.parameter == column]
        reach = f", {swept[0].min():.0f} to {swept[0].max():.0f} mm" if swept else ""
        axes[column].set_title(f"{name}{reach}")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle("left condyle while one parameter moves alone; above: from the side, below: from above")
    return figure


def _draw_points(axis: Axes, points: Array, color: str, label: str) -> None:
    axis.plot(*points.T, ".", ms=3, color=color, alpha=0.5, label=label, rasterized=len(points) > _MANY)


def reconstruction_figure(found: Experiments) -> Figure:
    """Draw paper Fig. 12: histograms of the reconstruction errors."""
    title = f"{found.actor}: error of the {found.frames} captured poses, rebuilt by each model"
    samples = found.of("reconstruction")
    return _histograms(samples, title, [one.model for one in samples], 4, None)


def synthesis_figure(found: Experiments) -> Figure:
    """Draw paper Fig. 13: histograms of the distances of random poses to the nearest captured one."""
    samples = found.of("synthesis")
    reference = samples.pop(0) if samples else None
    outline = f" (outline: {reference.model})" if reference else ""
    title = f"{found.actor}: distance of random poses to the nearest captured pose{outline}"
    labels = [f"{one.model}\n{one.quantity}" for one in samples]
    return _histograms(samples, title, labels, 3, reference)


def _histograms(
    samples: list[Distances], title: str, labels: list[str], columns: int, reference: Distances | None
) -> Figure:
    drawn = [(one, label) for one, label in zip(samples, labels, strict=True) if len(one.values_mm)]
    if not drawn:
        return _nothing_to_draw(f"{title}: no poses")
    samples, labels = [one for one, _ in drawn], [label for _, label in drawn]
    columns = min(columns, len(samples))
    rows = -(-len(samples) // columns)
    figure, axes = new_figure(11.0, 1.9 * rows + 0.6, rows, columns, sharex=True, sharey=True)
    # The long tail of one model must not dominate the shared scale; a label states how many values lie beyond its end.
    end = max(_FEW_MM, float(np.quantile([np.percentile(one.values_mm, 95) for one in samples], _SCALE_QUANTILE)))
    bins = np.linspace(0.0, end, _BINS + 1).tolist()
    for axis, one, label in zip(axes, samples, labels, strict=False):
        values = one.values_mm
        mean = float(values.mean())
        axis.hist(values, bins=bins, weights=_shares(values), color=BLUE)
        if reference is not None and len(reference.values_mm):
            known = reference.values_mm
            axis.hist(known, bins=bins, weights=_shares(known), histtype="step", color=BLACK, lw=0.9)
        if mean < end:
            axis.axvline(mean, color=VERMILION, lw=1.5)
        axis.set_title(label)
        figures = (("mean", mean), ("p95", np.percentile(values, 95)), ("max", values.max()))
        lines = [f"{name} {value:.2f} mm" for name, value in figures]
        lines.append(f"{int((values > end).sum())} of {len(values)} beyond the axis")
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
        axis.text(0.98, 0.96, "\n".join(lines), transform=axis.transAxes, ha="right", va="top", fontsize=8, bbox=box)
    axes[0].set_xlim(0.0, end)
    for axis in axes[len(samples) :]:
        axis.set_axis_off()
    figure.supxlabel("largest distance of a mandible vertex [mm]   (line: mean)")
    figure.supylabel("share of poses [%]")
    figure.suptitle(title)
    return figure


def _nothing_to_draw(why: str) -> Figure:
    """Return a placeholder figure that only states why there is nothing to plot."""
    figure, (axis,) = new_figure(11.0, 1.0, 1, 1)
    axis.set_axis_off()
    axis.text(0.5, 0.5, why, ha="center", va="center")
    return figure


def _shares(values: Array) -> Array:
    return np.full(len(values), 100.0 / len(values))


def coverage_figure(coverage: Coverage, actor: str) -> Figure:
    """Draw the captured openings, laterotrusions and protrusions, the bounds, and the gaps."""
    figure, axes = new_figure(10.0, 5.0, 1, 2)
    names = ("laterotrusion d2 [mm], + to the left", "protrusion d3 [mm], + forward")
    for index, axis in enumerate(axes):
        _draw_points(axis, coverage.d[:, [0, index + 1]], BLUE, "captured")
        for number, ring in enumerate(coverage.outlines[index]):
            closed = np.concatenate([ring, ring[:1]])
            axis.plot(*closed.T, color=GREEN, lw=1.2, ls="--", label="alpha shape" if number == 0 else None)
        edges = coverage.slices[index]
        axis.plot(coverage.slices_d1, edges[:, 0], color=BLACK, lw=1.2, label="slice hull, on the habitual path")
        axis.plot(coverage.slices_d1, edges[:, 1], color=BLACK, lw=1.2)
        gaps = coverage.gaps[index]
        axis.plot(gaps[:, 0], gaps[:, 1], "x", ms=3, color=VERMILION, label="inside the bound, no captured pose nearby")
        axis.set_xlabel("opening d1 [mm]")
        axis.set_ylabel(names[index])
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    advice = "\n".join(textwrap.fill(one, _ADVICE_LETTERS) for one in coverage.sentences) or "No exercise is missing."
    figure.suptitle(f"{actor}: captured part of the envelope\n{advice}", fontsize=9)
    return figure
