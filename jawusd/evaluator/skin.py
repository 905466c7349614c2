"""The jaw from facial skin: `skin.npz`, format jawusd-skin/1, and its evaluation with numpy alone.

A Gaussian process (Rasmussen and Williams 2006, equations 2.25 and 2.26) maps columns of a face tracker to d. With f
the principal components of the columns over `scale`, its covariance function is

    k(f, g) = smooth exp(-|f_s - g_s|^2 / (2 length^2)) + linear f . g

where the first part uses the first `smooth_count` components, and the second part also the components that were left
out. Beyond the limit of a familiar face, the variance is multiplied by the squared distance from the components over
that limit. The arrays of the file, for M training frames, K columns, C components:

    mean (K,), basis (C, K)      mean of the columns, and orthonormal principal directions
    scale ()                     standard deviation of the first component, unit of the columns
    features (M, C), d (M, 3)    training frames: components over scale, and d [mm]
    noise (M,)                   variance of each training frame, relative to that of d
    kernel (4,)                  length, smooth, linear, and the variance of a new frame that skin does not explain
    spread (3, 3)                covariance of d per unit of variance of the Gaussian process [mm^2]
    head_error (R, C)            change of the features by one sigma of each shift and rotation of the head
    smooth_count (), familiar_count ()    number of components in the smooth part, and in the test of familiarity
    familiar_limit (2,)          largest variance, and largest squared distance from the components, of a familiar face
    meta                         JSON: actor, names of the columns, frames, held-out errors, false-alarm rate
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jawusd.base.arrays import Array, Mask
from jawusd.base.errors import AnyPath, EvaluatorError, FormatError
from jawusd.base.npz import read_npz, take
from jawusd.evaluator.batching import as_floats, as_rows, in_chunks

FAMILY, VERSION = "jawusd-skin", 1
_SHAPES: dict[str, tuple[int | str, ...]] = {
    "mean": ("K",),
    "basis": ("C", "K"),
    "scale": (),
    "features": ("M", "C"),
    "d": ("M", 3),
    "noise": ("M",),
    "kernel": (4,),
    "spread": (3, 3),
    "head_error": ("R", "C"),
    "smooth_count": (),
    "familiar_count": (),
    "familiar_limit": (2,),
}
MOST_FRAMES = 2000  # maximum number M of training frames; a matrix (M, M) is inverted when a file is read
_LARGEST = 1e12  # maximum magnitude of the values in a file


class SkinJaw(NamedTuple):
    """Jaw parameters of faces, from `Skin`."""

    d: Array  # jaw parameters [mm], shape (..., 3), not projected to the rig's bound; NaN where a column is not finite
    covariance: Array  # covariance of d [mm^2], shape (..., 3, 3); it grows with the distance from the training frames
    #: whether the face resembles the training frames, shape (...); if not, the covariance is a rough guess
    familiar: Mask


def skin_kernel(f: Array, g: Array, kernel: Array, smooth_count: int) -> tuple[Array, Array]:
    """Return the smooth and the linear part of the covariance of features f (n, C) and g (m, C), shape (n, m) each."""
    length, smooth, linear, _ = kernel
    a, b = f[:, :smooth_count], g[:, :smooth_count]
    apart = np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * a @ b.T, 0.0)
    return smooth * np.exp(-apart / (2 * length**2)), linear * (f @ g.T)


class Skin:
    """A map from columns of a face tracker to one subject's d, with covariance.

    Attributes:
        arrays: Arrays of format jawusd-skin/1, read-only.
        meta: Header of the file.
        columns: Number of columns K.
        points: Whether the columns are the coordinates x, y, z of points [mm].
    """

    def __init__(self, arrays: Mapping[str, Array], meta: Mapping[str, object]) -> None:
        """Build the map.

        Raises:
            EvaluatorError: an array has a wrong shape, is not finite, or is out of range.
        """
        self.arrays = _checked(arrays)
        self.meta = dict(meta)
        self.columns = self.arrays["mean"].size
        self.points = len(self.arrays["head_error"]) > 0
        self._smooth, self._inside = (int(self.arrays[name]) for name in ("smooth_count", "familiar_count"))
        features, kernel = self.arrays["features"], self.arrays["kernel"]
        K = sum(skin_kernel(features, features, kernel, self._smooth)) + np.diag(self.arrays["noise"])
        self._d_mean = self.arrays["d"].mean(axis=0)
        self._precision = np.linalg.inv(K)
        self._weights = self._precision @ (self.arrays["d"] - self._d_mean)

    def __call__(self, X: ArrayLike) -> SkinJaw:
        """Return the jaw parameters of faces, given as the learned columns (..., K) or as points (..., N, 3) [mm].

        Raises:
            ValueError: the number of columns is not K.
        """
        X = as_floats(X, "X")
        if self.points and X.ndim > 1 and X.shape[-2:] == (self.columns // 3, 3):
            X = X.reshape(*X.shape[:-2], self.columns)
        rows, batch = as_rows(X, (self.columns,), "X")
        found = in_chunks(self._predicted, rows)
        known = np.isfinite(found).all(axis=1)
        familiar = known & (found[:, 12:] <= self.arrays["familiar_limit"]).all(axis=1)
        return SkinJaw(found[:, :3].reshape(*batch, 3), found[:, 3:12].reshape(*batch, 3, 3), familiar.reshape(batch))

    @property
    def errors_mm(self) -> dict[str, float]:
        """Mean held-out errors at the incisal point [mm] of "skin" and of baselines; see `fitting.skin.fit_skin`."""
        found = self.meta.get("errors_mm")
        named = found.items() if isinstance(found, Mapping) else ()
        return {str(name): float(value) for name, value in named if isinstance(value, int | float)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns or points; empty if unknown."""
        found = self.meta.get("names")
        return tuple(map(str, found)) if isinstance(found, list | tuple) else ()

    @property
    def actor(self) -> str:
        """The subject's name, empty if unknown."""
        return str(self.meta.get("actor") or "")

    def _predicted(self, X: Array) -> Array:
        """Return d, its covariance, the variance of the process, and the squared distance from the components' span."""
        features, kernel = self.arrays["features"], self.arrays["kernel"]
        f, left_out = components(X, self.arrays["mean"], self.arrays["basis"], float(self.arrays["scale"]))
        smooth, linear = skin_kernel(f, features, kernel, self._smooth)
        k = smooth + linear
        d = self._d_mean + k @ self._weights
        prior = kernel[1] + kernel[2] * ((f * f).sum(axis=1) + left_out) + kernel[3]
        variance = np.maximum(prior - ((k @ self._precision) * k).sum(axis=1), kernel[3])
        # change of d [mm] per standard deviation of each head error, shape (n, 3, R)
        moved = self._gradient(f, smooth) @ self.arrays["head_error"].T
        outside = left_out + (f[:, self._inside :] ** 2).sum(axis=1)
        wider = np.maximum(outside / self.arrays["familiar_limit"][1], 1.0)
        covariance = (wider * variance)[:, None, None] * self.arrays["spread"] + moved @ np.swapaxes(moved, 1, 2)
        return np.column_stack([d, covariance.reshape(-1, 9), variance, outside])

    def _gradient(self, f: Array, smooth: Array) -> Array:
        """Return the derivative of d with respect to features f (n, C), shape (n, 3, C)."""
        features, (length, _, linear, _) = self.arrays["features"], self.arrays["kernel"]
        gradient = np.repeat((linear * self._weights.T @ features)[None], len(f), axis=0)
        for j in range(3):
            weighted = smooth * self._weights[:, j]
            towards = weighted @ features[:, : self._smooth] - weighted.sum(1)[:, None] * f[:, : self._smooth]
            gradient[:, j, : self._smooth] += towards / length**2
        return gradient


def components(X: Array, mean: Array, basis: Array, scale: float) -> tuple[Array, Array]:
    """Return features (n, C) of columns X (n, K), and the squared length (n,) of the residual over scale."""
    centred = (X - mean) / scale
    f = centred @ basis.T
    return f, np.maximum((centred * centred).sum(axis=1) - (f * f).sum(axis=1), 0.0)


def load_skin(path: AnyPath) -> Skin:
    """Read a map from skin to d, written by `jawusd skin-fit`.

    Raises:
        FormatError: another kind of file, a corrupt file, or arrays missing, of a wrong shape or out of range.
        VersionError: written by a newer version of jawusd.
        UnitsError: other units or twist order.
    """
    arrays, meta = read_npz(path, FAMILY, VERSION)
    for name, shape in _SHAPES.items():
        take(arrays, name, tuple(size if isinstance(size, int) else None for size in shape), path)
    try:
        return Skin(arrays, meta)
    except EvaluatorError as error:
        raise FormatError(error.message, path=path, hint="Fit the skin again with `jawusd skin-fit`.") from error


def _checked(arrays: Mapping[str, Array]) -> dict[str, Array]:
    sizes: dict[str, int] = {}
    found: dict[str, Array] = {}
    for name, shape in _SHAPES.items():
        value = np.array(arrays[name], dtype=np.float64)
        sizes.update((axis, n) for axis, n in zip(shape, value.shape) if isinstance(axis, str) and axis not in sizes)
        wanted = tuple(axis if isinstance(axis, int) else sizes.get(axis, -1) for axis in shape)
        if value.shape != wanted or (not value.size and name != "head_error"):
            raise EvaluatorError(f'"{name}" has shape {value.shape}; expected {shape} with at least one value.')
        if not (np.abs(value) <= _LARGEST).all():
            raise EvaluatorError(f'"{name}" has values that are not finite or are larger than {_LARGEST:g}.')
        value.flags.writeable = False
        found[name] = value
    for name in ("scale", "noise", "kernel", "familiar_limit"):
        if not (found[name] > 0).all():
            raise EvaluatorError(f'"{name}" must be positive; found {found[name].min():g}.')
    if sizes["M"] > MOST_FRAMES:
        raise EvaluatorError(f'"features" has {sizes["M"]} frames; at most {MOST_FRAMES} are allowed.')
    most = len(found["basis"])
    for name in ("smooth_count", "familiar_count"):
        if not (1 <= found[name] <= most and found[name] % 1 == 0):
            raise EvaluatorError(f'"{name}" is {found[name]:g}; it must be a whole number from 1 to {most}.')
    spread = found["spread"]
    if not np.allclose(spread, spread.T) or np.linalg.eigvalsh(spread)[0] <= 0:
        raise EvaluatorError('"spread" must be symmetric and positive definite.')
    return found
