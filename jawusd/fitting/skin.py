"""Learn one subject's jaw from facial skin, on frames with visible teeth.

As in Zoss et al. 2019 ("Accurate Markerless Jaw Tracking for Facial Performance Capture"), the jaw pose is regressed on
the skin in frames in which it is known. Here, a Gaussian process predicts the three parameters of the rig, with
covariances.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Indices
from jawusd.base.errors import AnyPath, FittingError
from jawusd.evaluator import JawRig
from jawusd.evaluator.skin import FAMILY, VERSION, Skin, components, skin_kernel
from jawusd.fitting import face
from jawusd.formats.atomic import write_described_npz

#: Default root mean square shift [mm] and rotation [rad] of the head that remain in later frames after stabilisation,
#: in addition to those in the training frames.
HEAD_ERROR = (0.3, 0.0026)
_COMPONENTS, _SMOOTH, _INSIDE = 120, 14, 30  # numbers of components: all, smooth part, familiarity test
# Initial parameters of the kernel, typical of fitted ones: length, smooth part, linear part, noise.
_START = (2.0, 3.0, 0.3, 0.001)
_LOW, _HIGH = np.log([0.2, 0.01, 0.001, 1e-5]), np.log([20.0, 100.0, 100.0, 3.0])
_STEPS, _MOST_TRIALS = np.log([3.0, 1.7]), 80
_FALSE_ALARMS = 0.01  # fraction of held-out frames that are flagged as unfamiliar
_TINY = 1e-9  # lower bound of the limit on the squared distance, needed for face data with a single column
_CLOCK_COMPONENTS = 12  # Number of principal components of the face data used to estimate its clock offset.
_LEAST_EXPLAINED = 0.5  # Minimum fraction of the variance of opening and laterotrusion that these must explain.


def fit_skin(
    rig: JawRig,
    X: ArrayLike,
    d: ArrayLike,
    seen: ArrayLike,
    sigma_d: ArrayLike = 0.15,
    *,
    head_error: tuple[float, float] = HEAD_ERROR,
    names: Sequence[str] = (),
) -> Skin:
    """Learn the jaw parameters d from facial skin.

    The take must contain exercises and speech with visible teeth, every expression that occurs later, and a few seconds
    with closed lips and the teeth in occlusion, where d is 0.

    Args:
        X: Columns in one unit, such as blendshape weights, shape (F, K); or points on the skin [mm], shape (F, N, 3),
            in any frame fixed to the head. Frames with a NaN are ignored.
        d: Jaw parameters [mm], shape (F, 3).
        seen: Frames in which d was measured, shape (F,).
        sigma_d: Standard deviation of d [mm], shape (), (3,) or (F, 3).
        head_error: For points, the additional error of head stabilisation in later frames, compared with the training
            frames: root mean square shift [mm] and rotation about the points' centre [rad].
        names: Names of the columns or points, stored in the file.

    Returns:
        The map. In its meta, "errors_mm" contains the mean held-out errors at the incisal point: that of the map
        ("skin") and those of simple baselines, "carried" (the last d before a held-out block), "mean" (the mean of all
        d) and, for points, "chin" (inverse kinematics of three points assumed to be rigid with the bone).

    Raises:
        ValueError: wrong shapes.
        FittingError: there are too few frames or too little motion, or the error exceeds 65 % of that of a baseline.
    """
    X, d = np.asarray(X, dtype=np.float64), np.asarray(d, dtype=np.float64)
    points = X.ndim == 3
    if X.shape[0] != len(d) or d.shape[1:] != (3,) or (X.shape[2:] != (3,) if points else X.ndim != 2):
        raise ValueError(f"X must have shape (F, K) or (F, N, 3) and d (F, 3), got {X.shape} and {d.shape}")
    sigma = np.broadcast_to(np.asarray(sigma_d, dtype=np.float64), d.shape)
    flat = X.reshape(len(X), -1)
    usable = np.asarray(seen, dtype=bool) & np.isfinite(np.column_stack([flat, d, sigma])).all(axis=1)
    rows = face.training_rows(usable)
    X, flat, d, sigma = X[rows], flat[rows], d[rows], sigma[rows]
    face.check_motion(flat, d, sigma)
    blocks = face.blocks_of(len(rows))
    arrays, held_out, variance = _process(flat, d, sigma, blocks)
    arrays["head_error"] = np.zeros((0, len(arrays["basis"])))
    if points:
        moved = face.head_motions(X.mean(axis=0), *head_error) / np.sqrt(3)
        arrays["head_error"] = np.asarray(moved @ arrays["basis"].T / arrays["scale"])
    errors = face.held_out_errors(rig, held_out, d, blocks, X)
    face.check_errors(errors)
    strange = np.column_stack([variance, _outside(flat, blocks, float(arrays["scale"]))])
    arrays["familiar_limit"] = np.maximum(np.quantile(strange, 1 - _FALSE_ALARMS / 2, axis=0), _TINY)
    flagged = (strange > arrays["familiar_limit"]).any(axis=1)
    meta = {
        "actor": rig.actor,
        "names": list(names),
        "frames": int(usable.sum()),
        "errors_mm": errors,
        "false_alarms": float(flagged.mean()),
    }
    return Skin(arrays, meta)


def clock_offset(face_s: Array, X: Array, times_s: Array, d: Array) -> float:
    """Return the offset [s], to be added to times of the face, at which it best explains opening and laterotrusion.

    Args:
        face_s: times of the face data [s], shape (F,).
        X: columns of the face data, NaN where hidden, shape (F, K).
        times_s: times of the jaw data [s], shape (N,).
        d: jaw parameters [mm], all known, shape (N, 3).

    Raises:
        FittingError: the takes are too short, or do not match at any offset.
    """
    known = X[np.isfinite(X).all(axis=1)]
    if not len(known):
        raise FittingError("no frame has values in all columns of the face data.")
    known = known[:: max(len(known) // face.MOST_FRAMES, 1)]
    mean = known.mean(axis=0)
    f = (X - mean) @ np.linalg.svd(known - mean, full_matrices=False)[2][:_CLOCK_COMPONENTS].T
    tried = face.offsets_between(face_s, times_s)
    every = max(int(face.COARSE_S / np.median(np.diff(times_s))), 1)
    explained = [_explained(face.columns_at(face_s + offset, f, times_s[::every]), d[::every, :2]) for offset in tried]
    best = int(np.argmax(explained))
    if explained[best] < _LEAST_EXPLAINED:
        raise FittingError(
            f"the face data do not follow the jaw at any clock offset: they explain {explained[best]:.0%} of opening "
            f"and laterotrusion at best; at least {_LEAST_EXPLAINED:.0%} is required.",
            hint="Use face and jaw data of the same performance, or set their offset with --offset.",
        )
    return face.refined_offset(float(tried[best]), face_s, f, times_s, d)


def _explained(f: Array, d: Array) -> float:
    """Return the smallest fraction of the variance of a column of d (N, n) that is linear in features (N, C)."""
    rows = np.isfinite(f).all(axis=1)
    if rows.sum() < face.LEAST_FRAMES:
        return 0.0
    return float((1 - face.unexplained(f[rows], d[rows]).var(axis=0) / d[rows].var(axis=0)).min())


def save_skin(path: AnyPath, skin: Skin) -> None:
    """Write a map of format jawusd-skin/1 atomically; raises OutputError if that fails."""
    write_described_npz(path, f"{FAMILY}/{VERSION}", skin.arrays, skin.meta)


def _process(flat: Array, d: Array, sigma: Array, blocks: list[Indices]) -> tuple[dict[str, Array], Array, Array]:
    """Return the arrays of the Gaussian process, and predictions (M, 3) and variances (M,) for held-out blocks.

    A coordinate search varies the logarithms of the kernel's parameters to maximise the likelihood of held-out blocks.
    """
    mean = flat.mean(axis=0)
    basis = np.linalg.svd(flat - mean, full_matrices=False)[2][:_COMPONENTS]
    scale = float(((flat - mean) @ basis[0]).std())
    f, left_out = components(flat, mean, basis, scale)
    size = d.std(axis=0)
    y, measured = (d - d.mean(axis=0)) / size, ((sigma / size) ** 2).mean(axis=1)
    smooth_count = min(_SMOOTH, len(basis))

    def held_out(log_kernel: Array) -> tuple[float, Array, Array]:
        kernel = np.exp(log_kernel)
        K = sum(skin_kernel(f, f, kernel, smooth_count)) + np.diag(kernel[2] * left_out + kernel[3] + measured)
        precision = np.linalg.inv(K)
        weights, residual, variance = precision @ y, np.empty_like(y), np.empty(len(y))
        for b in blocks:  # Rasmussen and Williams 2006, equations 5.10 to 5.12, for blocks
            block = np.linalg.inv(precision[np.ix_(b, b)])
            residual[b], variance[b] = block @ weights[b], np.diag(block)
        spread = (residual**2 / variance[:, None]).mean(axis=0)
        return float(np.log(spread * variance[:, None]).sum()), residual, variance

    best = np.log(_START)
    found, trials = held_out(best), 1
    for step in _STEPS:
        moved = True
        while moved and trials < _MOST_TRIALS:
            moved = False
            for change in step * np.concatenate([np.eye(4), -np.eye(4)]):
                tried = np.clip(best + change, _LOW, _HIGH)
                other, trials = held_out(tried), trials + 1
                if other[0] < found[0]:
                    best, found, moved = tried, other, True
    kernel, (_, residual, variance) = np.exp(best), found
    whitened = residual * size / np.sqrt(variance)[:, None]
    arrays = {
        "mean": mean,
        "basis": basis,
        "scale": np.array(scale),
        "features": f,
        "d": d,
        "noise": kernel[2] * left_out + (kernel[3] + measured),
        "kernel": kernel,
        "spread": whitened.T @ whitened / len(whitened),
        "smooth_count": np.array(smooth_count),
        "familiar_count": np.array(_inside(flat)),
    }
    return arrays, d - residual * size, variance - measured


def _inside(flat: Array) -> int:
    """Return the number of components in the familiarity test: at most half of the available components."""
    return max(min(_INSIDE, min(flat.shape) // 2), 1)


def _outside(flat: Array, blocks: list[Indices], scale: float) -> Array:
    """Return squared distances of held-out frames from the subspace of the others, relative to scale, shape (M,)."""
    found = np.empty(len(flat))
    for b in blocks:
        others = np.delete(flat, b, axis=0)
        mean = others.mean(axis=0)
        basis = np.linalg.svd(others - mean, full_matrices=False)[2][: _inside(flat)]
        found[b] = components(flat[b], mean, basis, scale)[1]
    return found
