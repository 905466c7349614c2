"""The exact jaw model as ONNX operators."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.arrays import flat_arrays
from jawusd.evaluator.formula import BoundFormula, RigidMotion
from jawusd.evaluator.kinds import MODELS
from jawusd.evaluator.operations import triple
from jawusd.geometry.rodrigues import apply_series, dot
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.rig.onnx_chart import stored
from jawusd.rig.onnx_graph import Graph, Value


def decode_motion(g: Graph, rig: JawRig, d: Value) -> RigidMotion[Value]:
    """Add the model to a graph and return the motion in the anatomical frame of parameters d (n, 3) [mm]."""
    formula = MODELS[rig.kind](flat_arrays(rig.arrays))
    return formula.motion(triple(g.parts(d, 3)), stored(formula.tables), g)


def add_margin(g: Graph, rig: JawRig, d: Value) -> Value:
    """Add the signed distance (n, 1) to the bound [mm] to a graph."""
    formula = BoundFormula(flat_arrays(rig.arrays))
    return formula.margin(triple(g.parts(d, 3)), stored(formula.tables), g)


def add_twist(g: Graph, rig: JawRig, motion: RigidMotion[Value], name: str) -> None:
    """Add the twists (omega [rad], v [mm]) of motions in the skull frame as an output, shape (n, 6)."""
    x = dot(motion.omega, motion.omega)
    a, b, _ = g.angle_coefficients(x)
    v = apply_series(motion.omega, motion.t, -0.5, g.inverse_coefficient(x, a, b))
    to_skull = se3_adjoint(se3_inverse(rig.T_anatomical_skull))
    g.op("MatMul", g.concat([*motion.omega, *v]), g.constant(to_skull.T), name=name)


def images(g: Graph, rig: JawRig, motion: RigidMotion[Value], vectors: Array) -> Value:
    """Return homogeneous vectors (4, m) of the mandible frame transformed to the skull frame, shape (n, 3 m).

    The result is a displacement from the closed teeth, so that d = 0 is exact in any precision.
    """
    to_skull = se3_inverse(rig.T_anatomical_skull)[:3, :3]
    at_rest = rig.T_anatomical_skull @ rig.T_rest @ vectors
    # entry (i, j) of [turn | t] moves vector k by to_skull[:, i] at_rest[j, k]
    matrix = np.einsum("ci,jk->ijkc", to_skull, at_rest).reshape(12, -1)
    entries = g.concat([x for row, shift in zip(motion.turn, motion.t) for x in (*row, shift)])
    return entries @ matrix + g.constant((rig.T_rest @ vectors)[:3].T.reshape(1, -1))
