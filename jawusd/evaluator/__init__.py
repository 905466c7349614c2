"""Evaluate a jaw rig with numpy alone: poses, Jacobians, encoding, bounds, verdicts, inverse kinematics."""

from jawusd.evaluator.files import load
from jawusd.evaluator.rig import JawRig
from jawusd.evaluator.speeds import Speeds
from jawusd.evaluator.verdicts import Reason, Verdicts

__all__ = ["JawRig", "Reason", "Speeds", "Verdicts", "load"]
