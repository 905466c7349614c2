"""The exact jaw model as ONNX operators."""

from __future__ import annotations

import numpy as np

from jawusd.base.arrays import Array
from jawusd.evaluator import JawRig
from jawusd.evaluator.arrays import flat_arrays
from jawusd.evaluator.formula import MODELS, BoundFormula, RigidMotion
from jawusd.evaluator.operations import Rows, triple
from jawusd.geometry.rodrigues import apply_series, dot
from jawusd.geometry.se3 import se3_adjoint, se3_inverse
from jawusd.rig.onnx_graph import Graph, Value


def decode_motion(g: Graph, rig: JawRig, d: Value) -> RigidMotion[Value]:
    """Add the model to a graph: parameters d (n, 3) [mm] to a motion in the anatomical frame."""
    formula = MODELS[rig.kind](flat_arrays(rig.arrays))
    return formula.motion(triple(g.parts(d, 3)), _stored(formula.tables), g)


def add_margin(g: Graph, rig: JawRig, d: Value) -> Value:
    """Add the signed distance (n, 1) to the bound [mm] to a graph."""
    formula = BoundFormula(flat_arrays(rig.arrays))
    return formula.margin(triple(g.parts(d, 3)), _stored(formula.tables), g)


def add_twist(g: Graph, rig: JawRig, motion: RigidMotion[Value], name: str) -> None:
    """Add an output: the twists (omega [rad], v [mm]) of motions, skull frame, shape (n, 6)."""
    x = dot(motion.omega, motion.omega)
    a, b, _ = g.angle_coefficients(x)
    v = apply_series(motion.omega, motion.t, -0.5, g.inverse_coefficient(x, a, b))
    to_skull = se3_adjoint(se3_inverse(rig.T_anatomical_skull))
    g.op("MatMul", g.concat([*motion.omega, *v]), g.constant(to_skull.T), name=name)


def images(g: Graph, rig: JawRig, motion: RigidMotion[Value], vectors: Array) -> Value:
    """Return the images (n, 3 m) of homogeneous vectors (4, m), mandible frame, in the skull frame, one after another.

    Moved by what the motion adds to the closed bite, so that the closed bite itself is exact in any precision.
    """
    to_skull = se3_inverse(rig.T_anatomical_skull)[:3, :3]
    at_rest = rig.T_anatomical_skull @ rig.T_rest @ vectors
    # entry (i, j) of [turn | t] moves vector k by to_skull[:, i] at_rest[j, k]
    matrix = np.einsum("ci,jk->ijkc", to_skull, at_rest).reshape(12, -1)
    entries = g.concat([x for row, shift in zip(motion.turn, motion.t) for x in (*row, shift)])
    return entries @ matrix + g.constant((rig.T_rest @ vectors)[:3].T.reshape(1, -1))


def _stored(tables: dict[str, Rows]) -> dict[str, Array]:
    return {name: np.array(table) for name, table in tables.items()}
