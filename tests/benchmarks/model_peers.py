"""Outside methods for three-parameter models, on the same poses: PCA, kernel PCA, Gaussian processes, an autoencoder.

All see the twists in mandible-metric coordinates (Euclidean distance = rms displacement of the mandible [mm]) but the
second Gaussian process, which like the default model takes the incisal point for its parameters. What has to be chosen
is chosen on the training take alone, by leaving out its last fifth.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from jawusd.fitting.data import TrainingData
from jawusd.geometry import make_transform, se3_exp, se3_log, so3_exp, so3_log

try:
    from sklearn.decomposition import PCA, KernelPCA
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
except ModuleNotFoundError as error:
    raise SystemExit(f"{error}: the peers need scikit-learn, pip install -c constraints.txt '.[test]'") from error

Array = np.ndarray
Rebuild = Callable[[Array], Array]

CODES = 3
GAMMAS = 10.0 ** np.arange(-2.5, 0.6, 0.5)  # of kernel PCA, for data of unit size
RIDGES = 10.0 ** np.arange(-8.0, 0.0, 2.0)  # of its pre-image
AE_HIDDEN, AE_STARTS, AE_STEPS, AE_DECAY = 8, 2, 1500, 1e-6


@dataclass(frozen=True)
class Peer:
    """Hold a fitted peer: `rebuild` maps motions (N, 4, 4) to the model's nearest ones; `numbers` are stored."""

    rebuild: Rebuild
    numbers: int


def on_twists(data: TrainingData, fit: Callable[[Array], tuple[Rebuild, int]]) -> Peer:
    """Fit in metric coordinates (N, 6)."""
    root = data.metric.twist_root()
    rebuild, numbers = fit(se3_log(data.motion) @ root)
    return Peer(lambda M: se3_exp(np.linalg.solve(root.T, rebuild(se3_log(M) @ root).T).T), numbers)


def pca(points: Array) -> tuple[Rebuild, int]:
    """sklearn's PCA."""
    model = PCA(CODES).fit(points)
    return lambda x: model.inverse_transform(model.transform(x)), model.components_.size + points.shape[1]


def kernel_pca(points: Array) -> tuple[Rebuild, int]:
    """sklearn's KernelPCA with its learned pre-image."""
    centre, scale = points.mean(0), points.std(0).max()
    unit, cut = (points - centre) / scale, len(points) * 4 // 5

    def fitted(x: Array, gamma: float, ridge: float) -> KernelPCA:
        return KernelPCA(CODES, kernel="rbf", gamma=gamma, alpha=ridge, fit_inverse_transform=True).fit(x)

    def left_out(choice: tuple[float, float]) -> float:
        model = fitted(unit[:cut], *choice)
        return np.linalg.norm(model.inverse_transform(model.transform(unit[cut:])) - unit[cut:], axis=1).mean()

    best = min(((gamma, ridge) for gamma in GAMMAS for ridge in RIDGES), key=left_out)
    model = fitted(unit, *best)

    def rebuild(x: Array) -> Array:
        return model.inverse_transform(model.transform((x - centre) / scale)) * scale + centre

    return rebuild, len(points) * (2 * points.shape[1] + 2 * CODES)


def gaussian_process(inputs: Array, outputs: Array) -> Callable[[Array], Array]:
    """Fit sklearn's Gaussian process with a squared exponential kernel of one length per input, and noise."""
    kernel = ConstantKernel(1.0, (1e-2, 1e3)) * RBF(inputs.std(0), (1e-1, 1e3)) + WhiteKernel(1e-2, (1e-6, 1.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a length at its limit is a finding, not a failure
        return GaussianProcessRegressor(kernel, normalize_y=True, random_state=0).fit(inputs, outputs).predict


def gp_decoder(points: Array) -> tuple[Rebuild, int]:
    """A Gaussian process from the first three principal components to all coordinates."""
    codes = PCA(CODES).fit(points)
    predict = gaussian_process(codes.transform(points), points)
    return lambda x: predict(codes.transform(x)), len(points) * (CODES + points.shape[1])


def gp_incisor(data: TrainingData) -> Peer:
    """A Gaussian process from the displacement of the incisal point to the rotation."""
    p = data.incisor

    def displacement(M: Array) -> Array:
        return M[:, :3, :3] @ p + M[:, :3, 3] - p

    predict = gaussian_process(displacement(data.motion), so3_log(data.motion[:, :3, :3]))

    def rebuild(M: Array) -> Array:
        u = displacement(M)
        R = so3_exp(predict(u))
        return make_transform(R, u + p - R @ p)

    return Peer(rebuild, len(data) * 6)


def autoencoder(points: Array, codes: int = CODES, starts: int = AE_STARTS) -> tuple[Rebuild, int]:
    """A plain autoencoder 6-8-codes-8-6 with tanh units, trained by L-BFGS; the best of some starts."""
    torch.set_num_threads(1)
    centre, scale = points.mean(0), points.std(0).max()
    x = torch.from_numpy((points - centre) / scale)
    nets = [_trained(x, codes, seed) for seed in range(starts)]
    net = min(nets, key=lambda found: ((found(x) - x) ** 2).mean().item())

    def rebuild(new: Array) -> Array:
        with torch.no_grad():
            return net(torch.from_numpy((new - centre) / scale)).numpy() * scale + centre

    return rebuild, sum(weight.numel() for weight in net.parameters())


def _trained(x: torch.Tensor, codes: int, seed: int) -> torch.nn.Module:
    torch.manual_seed(seed)
    width = x.shape[1]
    layers = [(width, AE_HIDDEN), (AE_HIDDEN, codes), (codes, AE_HIDDEN), (AE_HIDDEN, width)]
    a, b, c, d = (torch.nn.Linear(*sizes, dtype=torch.float64) for sizes in layers)
    net = torch.nn.Sequential(a, torch.nn.Tanh(), b, c, torch.nn.Tanh(), d)
    weights = list(net.parameters())
    optimiser = torch.optim.LBFGS(weights, max_iter=AE_STEPS, history_size=20, line_search_fn="strong_wolfe")

    def cost() -> torch.Tensor:
        optimiser.zero_grad()
        value = ((net(x) - x) ** 2).mean() + AE_DECAY * sum((weight**2).sum() for weight in weights)
        value.backward()
        return value

    optimiser.step(cost)
    return net


PEERS: dict[str, Callable[[TrainingData], Peer]] = {
    "PCA (sklearn)": lambda data: on_twists(data, pca),
    "KernelPCA + pre-image (sklearn)": lambda data: on_twists(data, kernel_pca),
    "PCA codes + GP decoder (sklearn)": lambda data: on_twists(data, gp_decoder),
    "incisal point + GP (sklearn)": gp_incisor,
    "autoencoder 6-8-3-8-6 (torch)": lambda data: on_twists(data, autoencoder),
}
