"""The runtime rig: poses, Jacobians, encoding, bounds, verdicts and inverse kinematics, with numpy alone.

Imports only `base`, `geometry` and numpy, so that it can run inside other programs.
"""

from jawusd.evaluator.judging import VerdictStream
from jawusd.evaluator.rig import JawRig, load
from jawusd.evaluator.speeds import Speeds
from jawusd.evaluator.verdicts import Reason, Verdicts

__all__ = ["JawRig", "Reason", "Speeds", "VerdictStream", "Verdicts", "load"]
