"""A rig's performance-critical functions compiled with numba: the same results to within 1e-10, several times faster.

Poses, twists, margins, their derivatives, encoding and `validate` are compiled. Searches along the bound (`ik`,
`project`, `interpolate`, `encode(inside=True)`) run in numpy as in `jawusd.evaluator`. Imports only `base`, `geometry`
and `evaluator`.
"""

from jawusd.base.errors import MissingDependencyError

try:
    import numba  # noqa: F401
except ModuleNotFoundError as error:
    raise MissingDependencyError("jawusd.fast needs numba.", hint="pip install 'jawusd[fast]'") from error

from jawusd.evaluator import JawRig
from jawusd.fast.kernels import CompiledKernels

__all__ = ["accelerate"]


def accelerate(rig: JawRig) -> JawRig:
    """Return the rig with its performance-critical functions compiled; results agree to within 1e-10.

    Compilation takes some 20 seconds on first use after installation; the code is then cached on disk. Without a
    writable cache folder every process compiles again and issues a RuntimeWarning.
    """
    if isinstance(rig.kernels, CompiledKernels):
        return rig
    return JawRig(rig.arrays, rig.meta, kernels=CompiledKernels)
