"""Fit a jaw model to captured poses: selection, model, bounds, error tables, warnings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from jawusd.errors import EvaluatorError, FittingError
from jawusd.evaluator import JawRig
from jawusd.fitting.additive import fit_additive
from jawusd.fitting.alpha_shape import alpha_shape
from jawusd.fitting.anatomy_gate import AnatomyWarning, check_anatomy
from jawusd.fitting.anchored import fit_anchored
from jawusd.fitting.config import FittingConfig
from jawusd.fitting.coverage import PARAMETERS, missing_movements, shown_parameters
from jawusd.fitting.data import Anatomy, Selection, TrainingData, select_poses, select_tracks
from jawusd.fitting.holdout import FittedForm, seen_errors, unseen_errors
from jawusd.fitting.pca import fit_pca
from jawusd.fitting.screening import screened
from jawusd.fitting.slice_hull import fit_slice_hull, valid_box
from jawusd.formats.model import JawModel
from jawusd.formats.tracks import Tracks
from jawusd.geometry.arrays import Array, Mask

#: Called with the steps done and the steps in all.
Progress = Callable[[int, int], None]

_LARGEST_CODES = 2000
# A measured pose is off the model beyond what nearly all trained poses and nearly all left-out ones keep: of the poses
# of the take itself 99.5 % have to pass this limit and the bound together.
_TRAINED_QUANTILE, _UNSEEN_QUANTILE = 99.8, 99.5
_SMALLEST_RESIDUAL_LIMIT_MM = 0.1  # noise-free poses must not make every measured pose "off the model"
_FEW_POSES = 100


def fit_model(
    source: Tracks | tuple[ArrayLike, ArrayLike],
    *,
    T_anatomical_skull: ArrayLike,
    landmarks: ArrayLike,
    mandible_vertices: ArrayLike | None = None,
    T_rest: ArrayLike | None = None,
    config: FittingConfig = FittingConfig(),  # noqa: B008 - frozen
    actor: str = "",
    progress: Progress | None = None,
) -> JawModel:
    """Fit a person's jaw model.

    Args:
        source: tracks (their raw poses are used), or frame numbers (F,) and poses T_skull_mandible (F, 4, 4) with NaN
            where there is none.
        T_anatomical_skull: skull (scan) frame to anatomical frame, shape (4, 4).
        landmarks: `geometry.LANDMARKS` in mandible coordinates [mm], shape (5, 3).
        mandible_vertices: points whose motion is measured, mandible coordinates [mm], shape (V, 3); None: the
            landmarks.
        T_rest: T_skull_mandible of the closed bite, shape (4, 4); None when the scans lie in occlusion.
        config: the method and its checks.
        actor: name written into the model.
        progress: told of the steps done.

    Returns:
        The model. `d` and `residual_mm` are those of the raw poses; `meta` holds the error tables [mm], the frames
        left out and trimmed, warnings, and what the poses do not show.

    Raises:
        FittingError: too few poses, no motion, poses that are not rigid, or parameters outside what a rig allows.
        ValueError: arrays of wrong shapes.
    """
    anatomy = Anatomy.of(T_anatomical_skull, landmarks, mandible_vertices, T_rest)
    steps = config.holdout_folds + 2
    tell = progress or (lambda done, total: None)
    tell(0, steps)
    if isinstance(source, Tracks):
        frames, T, selection = source.frames, source.raw_T_upper_lower, select_tracks(source, anatomy)
    else:
        frames, T = np.asarray(source[0], dtype=np.int64), np.asarray(source[1], dtype=np.float64)
        selection = select_poses(frames, T, anatomy)
    selection = screened(selection)
    data = selection.data
    warnings = check_anatomy(data, anatomy)
    shown, sentences = shown_parameters(data)
    if not shown.any():
        raise FittingError(
            "the poses show neither opening nor laterotrusion nor protrusion.",
            hint=" ".join(warning.message for warning in warnings) or "Capture all three movements, about 30 s in all.",
        )
    warnings += [AnatomyWarning("not_shown", sentence) for sentence in sentences]
    if len(data) < _FEW_POSES:
        warnings.append(AnatomyWarning("few_poses", f"Only {len(data)} poses: the model interpolates coarsely."))
    form = fit_form(data, shown, config)
    errors, uncertainty, unseen_mm = seen_errors(data, form), {}, np.zeros(0)
    if config.holdout_folds:
        # The networks of "paper" start in the folds where the best of the full fit started, once.
        again = replace(config, starts=1, seed=form.notes().get("seed", config.seed))
        unseen, uncertainty, unseen_mm = unseen_errors(
            data,
            form.kept,
            config.holdout_folds,
            lambda part: fit_form(part, shown, again),
            lambda fold: tell(fold + 1, steps),
        )
        errors |= unseen
    arrays, tolerance_mm = _arrays(data, form, anatomy, config)
    warnings += [AnatomyWarning("take_lacks", sentence) for sentence in missing_movements(arrays["codes"], shown)]
    model = _finish(arrays, tolerance_mm, unseen_mm, form, selection, frames, T, errors, warnings, config)
    model.meta |= {"actor": actor, "uncertainty": uncertainty}
    tell(steps, steps)
    return model


def fit_form(data: TrainingData, shown: Mask, config: FittingConfig) -> FittedForm:
    """Fit the decoder of `config.method` alone, without bounds, checks and hold-out.

    Args:
        data: the training data.
        shown: which parameters the data show, shape (3,).
        config: the method.

    Raises:
        FittingError: the method cannot be fitted to these data.
    """
    if config.method == "anchored":
        return fit_anchored(data, shown, config.trim_mad)
    if config.method == "additive":
        return fit_additive(data, shown, config.trim_mad)
    if config.method == "pca":
        return fit_pca(data, shown)
    from jawusd.fitting.paper import fit_paper  # torch: two seconds that the other methods need not wait

    return fit_paper(data, shown, config.literal, config.starts, config.seed)


def _arrays(
    data: TrainingData, form: FittedForm, anatomy: Anatomy, config: FittingConfig
) -> tuple[dict[str, Array], float]:
    """Return all arrays but the limits of the verdicts, and how far out of bounds measured poses may lie [mm]."""
    d, _ = data.metric.nearest(form.model, data.motion[form.kept])
    if not np.isfinite(d).all():
        raise FittingError("the parameters of some training poses cannot be found.", hint="Check the poses' units.")
    hull, tolerance_mm = fit_slice_hull(d)
    lateral, lateral_counts = alpha_shape(d[:, [0, 1]], config.alpha)
    protrusion, protrusion_counts = alpha_shape(d[:, [0, 2]], config.alpha)
    step = -(-len(d) // _LARGEST_CODES)
    arrays = {
        **form.arrays(),
        **hull,
        "T_anatomical_skull": anatomy.T_anatomical_skull,
        "T_rest": anatomy.T_rest,
        "incisor": data.incisor,
        "landmarks": np.asarray(anatomy.landmarks, dtype=np.float64),
        "d_range": valid_box(hull),
        "polygon_d1d2": lateral,
        "polygon_d1d2_counts": lateral_counts,
        "polygon_d1d3": protrusion,
        "polygon_d1d3_counts": protrusion_counts,
        "codes": d[::step],
    }
    return arrays, tolerance_mm


def _finish(
    arrays: dict[str, Array],
    tolerance_mm: float,
    unseen_mm: Array,
    form: FittedForm,
    selection: Selection,
    frames: NDArray[np.int64],
    T: Array,
    errors: dict,
    warnings: list[AnatomyWarning],
    config: FittingConfig,
) -> JawModel:
    """Encode every captured pose with the evaluator and set the limits of the verdicts from the trained ones."""
    limits = {"residual_limit_mm": np.array(1.0), "margin_limit_mm": np.array(0.0)}
    meta = {
        "kind": form.kind,
        "method": config.method,
        "config": asdict(config),
        "versions": {"numpy": np.__version__, "scipy": scipy.__version__},
        "errors": errors,
        "fit": form.notes(),
        "warnings": [asdict(warning) for warning in warnings],
        "excluded_frames": selection.excluded,
        "trimmed_frames": selection.data.frames[~form.kept].tolist(),
    }
    try:
        rig = JawRig({**arrays, **limits}, meta)
    except EvaluatorError as error:
        advice = " ".join(warning.message for warning in warnings)
        raise FittingError(f"the poses give no usable model: {error}", hint=advice or None) from error
    d, residual_mm = rig.encode(T)
    trained = np.zeros(len(frames), dtype=bool)
    trained[np.flatnonzero(selection.used)[form.kept]] = True
    limit = max(float(np.percentile(residual_mm[trained], _TRAINED_QUANTILE)), _SMALLEST_RESIDUAL_LIMIT_MM)
    if len(unseen_mm):
        limit = max(limit, float(np.percentile(unseen_mm, _UNSEEN_QUANTILE)))
    reached = d[trained]
    meta["ranges_mm"] = {
        name: [float(reached[:, i].min()), float(reached[:, i].max())] for i, name in enumerate(PARAMETERS)
    }
    arrays = {**arrays, "residual_limit_mm": np.array(limit), "margin_limit_mm": np.array(-tolerance_mm)}
    return JawModel(arrays, frames, d, residual_mm, trained, meta)
