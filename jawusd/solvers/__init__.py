"""Jaw rigs in differentiable solvers: a torch module with poses, bounds and priors on jaw poses."""

from jawusd.base.errors import MissingDependencyError

try:
    import torch  # noqa: F401
except ModuleNotFoundError as error:
    raise MissingDependencyError("jawusd.solvers needs torch.", hint="pip install 'jawusd[build]'") from error

from jawusd.solvers.layer import JawLayer, TemporalPrior
from jawusd.solvers.motion import jaw_pose_from_axis_angle

__all__ = ["JawLayer", "TemporalPrior", "jaw_pose_from_axis_angle"]
