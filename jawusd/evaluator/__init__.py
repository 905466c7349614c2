"""Evaluate a jaw rig with numpy alone: poses, Jacobians, encoding, bounds, verdicts."""

from jawusd.evaluator.rig import JawRig

__all__ = ["JawRig"]
