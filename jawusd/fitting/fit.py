"""Fit a jaw model to captured poses: select poses, fit model and bounds, compute error tables and warnings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import EvaluatorError, FittingError
from jawusd.evaluator import JawRig
from jawusd.evaluator.authoring import error_growth_at
from jawusd.evaluator.models import JawModelForm
from jawusd.evaluator.speeds import Speeds
from jawusd.fitting.additive import fit_additive, fit_pca
from jawusd.fitting.anchored import fit_anchored
from jawusd.fitting.bounds import fit_bounds
from jawusd.fitting.checks import AnatomyWarning, check_anatomy, missing_movements, shown_parameters
from jawusd.fitting.data import (
    FittedForm,
    Selection,
    Source,
    SubjectAnatomy,
    TrainingData,
    ranges_of,
    screened,
    select,
)
from jawusd.formats.model import JawModel, error_table
from jawusd.formats.notes import ErrorTable
from jawusd.geometry import LANDMARKS, transform_point

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

#: Function that is called with the number of steps done and the total number of steps.
Progress = Callable[[int, int], None]
#: Fitter of one method; the mask (3,) selects the parameters that the data excite.
FormFitter = Callable[[TrainingData, Mask, "FittingConfig"], FittedForm]

_MOST_CAPTURED = 2000  # maximum number of captured poses whose parameters a model stores
# Percentiles of the training and of the hold-out residuals. The larger value is the limit beyond which a measured pose
# counts as off the model; 99.5 % of the take's own poses are within both this limit and the bound.
_TRAINED_QUANTILE, _UNSEEN_QUANTILE = 99.8, 99.5
_SMALLEST_RESIDUAL_LIMIT_MM = 0.1  # minimum residual limit [mm], for noise-free training poses
_FEW_POSES = 100

#: Fitters by method; `jawusd.paper.model.FORMS` adds the fitter of the paper, which needs torch.
FORMS: Mapping[str, FormFitter] = {
    "anchored": lambda data, shown, config: fit_anchored(data, shown, config.trim_mad),
    "additive": lambda data, shown, config: fit_additive(data, shown, config.trim_mad),
    "pca": lambda data, shown, config: fit_pca(data, shown),
}
_FASTEST_MM_S2 = 3e4  # maximum plausible acceleration, three times gravity; larger accelerations are jumps of the poses
# Fraction of held-out errors, weighted by reach, that are below their quantile at the expected growth; and this
# quantile relative to the rms error for three normally distributed coordinates.
_BELOW, _LARGEST_RMS = 0.9, 1.443
_USUAL_GROWTH = 1.0  # growth of errors per mm of reach, relative to the rms error of training frames [1/mm]
_OWN = 0.75  # weight of the growth that a take shows itself, on a logarithmic scale
_SLOWEST_GROWTH = 0.01  # minimum growth of errors with reach [mm/mm]
_SMALLEST_MM = 1e-6  # a smaller reach is treated as this one


@dataclass(frozen=True)
class FittingConfig:
    """Choice of model, and settings of its fit and validation."""

    method: str = "anchored"  # a key of `FORMS`, or "paper"
    literal: bool = False  # for method "paper": whether to keep the paper's fixed grouping of components
    #: number of contiguous parts of the take that are held out in turn to measure the error on unseen poses; 0 to skip
    holdout_folds: int = 5
    #: normalised median absolute deviations beyond the median residual at which frames are discarded as failures
    trim_mad: float = 4.5
    alpha: float = 0.23  # maximum triangle circumradius in the paper's alpha shapes [range-normalised units]
    starts: int = 4  # number of random initialisations of the networks of method "paper"; the best result is kept
    seed: int = 0  # random seed of the first initialisation

    def __post_init__(self) -> None:
        if self.method not in (methods := [*FORMS, "paper"]):
            raise ValueError(f"method must be one of {', '.join(methods)}, got {self.method!r}")
        if self.holdout_folds == 1 or self.holdout_folds < 0:
            raise ValueError(f"holdout_folds must be 0 or at least 2, got {self.holdout_folds}")
        if min(self.trim_mad, self.alpha) <= 0:
            raise ValueError(f"trim_mad and alpha must be positive, got {self.trim_mad} and {self.alpha}")
        if self.starts < 1:
            raise ValueError(f"starts must be at least 1, got {self.starts}")


def one_blas_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Limit BLAS (OpenBLAS, MKL or BLIS) to one thread while a function runs.

    The matrices of a fit are too small to benefit from threads; threaded sums differ in the last digits, which changes
    a fit by micrometres.
    """

    @wraps(function)
    def limited(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@one_blas_thread
def fit_model(
    source: Source,
    *,
    T_anatomical_skull: ArrayLike,
    landmarks: ArrayLike,
    mandible_vertices: ArrayLike | None = None,
    T_rest: ArrayLike | None = None,
    config: FittingConfig = FittingConfig(),
    actor: str = "",
    forms: Mapping[str, FormFitter] = FORMS,
    progress: Progress | None = None,
) -> JawModel:
    """Fit a subject's jaw model.

    Args:
        source: tracks, of which the raw poses are used, or frame numbers and poses.
        T_anatomical_skull: skull (scan) frame to anatomical frame, shape (4, 4).
        landmarks: `geometry.LANDMARKS` in mandible coordinates [mm], shape (5, 3).
        mandible_vertices: points whose motion is measured, mandible coordinates [mm], shape (V, 3); default: the
            landmarks.
        T_rest: T_skull_mandible of the closed bite, shape (4, 4); default: the scans are in occlusion.
        forms: the fitter for each method.

    Returns:
        The model. Its `d` and `residual_mm` are those of the raw poses; its `meta` contains the error tables [mm], the
        excluded and trimmed frames, warnings, and the parameters that the poses do not excite.

    Raises:
        FittingError: there are too few poses, there is no motion, poses are not rigid, or parameters exceed what a rig
            allows.
        ValueError: an array has a wrong shape.
    """
    anatomy = SubjectAnatomy.of(T_anatomical_skull, landmarks, mandible_vertices, T_rest)
    steps = config.holdout_folds + 2
    notify = progress or (lambda done, total: None)
    notify(0, steps)
    selection = screened(select(source, anatomy))
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
    form = forms[config.method](data, shown, config)
    errors, uncertainty, unseen_mm = _errors(data, shown, form, config, forms, lambda fold: notify(fold + 1, steps))
    d, _ = data.metric.nearest(form.model, data.motion[form.kept])
    if not np.isfinite(d).all():
        raise FittingError("some training poses cannot be encoded.", hint="Check the units of the poses.")
    captured_d = d[:: -(-len(d) // _MOST_CAPTURED)]
    warnings += [AnatomyWarning("take_lacks", sentence) for sentence in missing_movements(captured_d, shown)]
    arrays = {
        **form.model.arrays(),
        **fit_bounds(d, config.alpha),
        "T_anatomical_skull": anatomy.T_anatomical_skull,
        "T_rest": anatomy.T_rest,
        "incisor": data.incisor,
        "landmarks": anatomy.landmarks,
        "codes": captured_d,
    }
    meta: dict[str, object] = {
        "actor": actor,
        "method": config.method,
        "config": asdict(config),
        "versions": {"numpy": np.__version__, "scipy": scipy.__version__},
        "errors": errors,
        "uncertainty": uncertainty,
    }
    model = _model(selection, form, arrays, meta, warnings, unseen_mm)
    notify(steps, steps)
    return model


def _errors(
    data: TrainingData,
    shown: Mask,
    form: FittedForm,
    config: FittingConfig,
    forms: Mapping[str, FormFitter],
    notify: Callable[[int], None],
) -> tuple[dict[str, ErrorTable], dict[str, dict[str, float]], Array]:
    """Return the error tables of a fit by name, and the other results of `unseen_errors` (empty without hold-out)."""
    parts = {"train": form.kept, "trimmed": ~form.kept}
    tables = {name: error_table(_form_errors(data.select(rows), form)) for name, rows in parts.items() if rows.any()}
    if not config.holdout_folds:
        return tables, {}, np.zeros(0)
    # In the folds, method "paper" trains only one network, with the seed of the best network in the full fit.
    seed = form.notes.get("seed")
    again = replace(config, starts=1, seed=seed if isinstance(seed, int) else config.seed)
    tables["holdout"], uncertainty, rms_mm = unseen_errors(
        data, form, config.holdout_folds, lambda part: forms[config.method](part, shown, again), notify
    )
    return tables, uncertainty, rms_mm


def pose_errors(data: TrainingData, model: Array) -> dict[str, Array]:
    """Return distances (N,) [mm] between model (N, 4, 4) and data by landmark; "mandible" is its farthest vertex."""
    errors = {"mandible": data.metric.largest(model, data.motion)}
    for name, point in zip(LANDMARKS, data.landmarks, strict=True):
        errors[name] = np.linalg.norm(transform_point(model, point) - transform_point(data.motion, point), axis=-1)
    return errors


def unseen_errors(
    data: TrainingData,
    form: FittedForm,
    folds: int,
    refit: Callable[[TrainingData], FittedForm],
    notify: Callable[[int], None],
) -> tuple[ErrorTable, dict[str, dict[str, float]], Array]:
    """Cross-validate: hold out contiguous parts of a take in turn, refit, and measure the error on the held-out parts.

    Only frames that the fit to all frames did not trim count; `notify` gets the index of each part before its turn.

    Returns:
        The error table; the growth of the errors away from the training poses, for each landmark and the mandible, as
        coefficients base_mm and per_mm of `jawusd.evaluator.authoring.error_growth_at`; and the rms landmark error of
        every held-out frame [mm], shape (n,).
    """
    fold = np.arange(len(data)) * folds // len(data)
    errors, growths = [], []
    for k in range(folds):
        notify(k)
        seen, unseen = data.select(fold != k), data.select((fold == k) & form.kept)
        if not len(unseen):
            continue
        part = refit(seen)
        errors.append(_form_errors(unseen, part))
        growths.append(_growth_at(part.model, seen.select(part.kept), unseen))
    pooled = {name: np.concatenate([part[name] for part in errors]) for name in errors[0]}
    factor, reach = np.concatenate(growths, axis=1)
    trained = _form_errors(data.select(form.kept), form)
    within = factor == 1.0  # a wider opening has a growth of its own
    growth = {name: _growth(reach[within], values[within], trained[name]) for name, values in pooled.items()}
    rms = np.sqrt(np.mean([pooled[name] ** 2 for name in LANDMARKS], axis=0))
    return error_table(pooled), growth, rms


def _form_errors(data: TrainingData, form: FittedForm) -> dict[str, Array]:
    return pose_errors(data, data.metric.nearest(form.model, data.motion)[1])


def _growth_at(model: JawModelForm, seen: TrainingData, unseen: TrainingData) -> Array:
    """Return factor and reach [mm] of each held-out frame from the training frames (`error_growth_at`), (2, N)."""
    captured, wanted = (part.metric.nearest(model, part.motion)[0] for part in (seen, unseen))
    captured, wanted = captured[np.isfinite(captured).all(1)], np.nan_to_num(wanted)
    return np.stack(error_growth_at(captured, wanted, cKDTree(captured).query(wanted)[0]))


def _growth(reach: Array, errors: Array, seen: Array) -> dict[str, float]:
    """Return the rms error of training frames, and the growth with reach [mm] that bounds most held-out errors.

    With few frames the growth is uncertain, so it is averaged on a logarithmic scale with a multiple of the rms error.
    """
    base = float(np.sqrt(np.mean(seen**2)))
    usual = found = _USUAL_GROWTH * base
    if len(reach):
        weights = np.maximum(reach, _SMALLEST_MM)
        slopes = np.maximum(errors / _LARGEST_RMS - base, 0.0) / weights
        found = max(float(np.quantile(slopes, _BELOW, weights=weights, method="inverted_cdf")), 0.0)
    return {"base_mm": base, "per_mm": max(found**_OWN * usual ** (1.0 - _OWN), _SLOWEST_GROWTH)}


def _model(
    selection: Selection,
    form: FittedForm,
    arrays: dict[str, Array],
    meta: dict[str, object],
    warnings: list[AnatomyWarning],
    unseen_mm: Array,
) -> JawModel:
    """Encode every captured pose with the evaluator and set the residual limit from the training poses."""
    meta |= {
        "kind": form.model.kind,
        "fit": form.notes,
        "warnings": [asdict(warning) for warning in warnings],
        "excluded_frames": selection.excluded,
        "trimmed_frames": selection.data.frames[~form.kept].tolist(),
    }
    try:
        rig = JawRig({**arrays, "residual_limit_mm": np.array(1.0)}, meta)
    except EvaluatorError as error:
        advice = " ".join(warning.message for warning in warnings)
        raise FittingError(f"no usable model fits the poses: {error}", hint=advice or None) from error
    d, residual_mm = rig.encode(selection.T_skull_mandible)
    trained = np.zeros(len(d), dtype=bool)
    trained[np.flatnonzero(selection.used)[form.kept]] = True
    limit = max(float(np.percentile(residual_mm[trained], _TRAINED_QUANTILE)), _SMALLEST_RESIDUAL_LIMIT_MM)
    if len(unseen_mm):
        limit = max(limit, float(np.percentile(unseen_mm, _UNSEEN_QUANTILE)))
    meta["ranges_mm"] = ranges_of(d[trained])
    arrays = {**arrays, "residual_limit_mm": np.array(limit)}
    return JawModel(arrays, selection.frames, d, residual_mm, trained, meta)


def with_speeds(model: JawModel, fps: float) -> JawModel:
    """Return the model with the speeds of its training frames, recorded at `fps` frames per second.

    It is returned unchanged if too few of them are consecutive, or if the accelerations are implausible.
    """
    d = np.where(model.trained[:, None], model.d, np.nan)
    gaps = np.flatnonzero(np.diff(model.frames) != 1) + 1
    try:
        speeds = Speeds.of_take(np.insert(d, gaps, np.nan, axis=0), fps)
    except ValueError:
        return model
    if speeds.rms_mm_s2.max() > _FASTEST_MM_S2:
        return model
    return replace(model, arrays={**model.arrays, **speeds.arrays()})
