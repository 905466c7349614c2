"""The spline from displacements to rotations, for any number type.

This file imports only the standard library and `jawusd.geometry.rodrigues`: it is copied into the single-file reader.
"""

from __future__ import annotations

from collections.abc import Sequence

from jawusd.evaluator.operations import Operations, Rows, Table, triple
from jawusd.geometry.rodrigues import N, Triple, dot

_VANISHING = 1e-12  # sums below this fraction of the sum of all weights count as zero


def spline(
    q: Triple[N],
    centres: Table,
    weights: Table,
    linear: Sequence[Sequence[float]],
    spread: Sequence[float] | None,
    ops: Operations[N, Table],
) -> Triple[N]:
    """Return ``sum_i W_i |q - c_i|^3 + q L``: a polyharmonic spline with a linear tail (Duchon 1977).

    Far from the centres the cubes of distances nearly cancel. If ``sum_i W_i = 0`` and ``sum_i W_i c_i = 0``, the cubes
    are replaced by what remains after cancellation, so that single precision suffices. With ``r = |q - c|``, ``p^2 =
    |q|^2 + 1`` and ``e = c (2 q - c) + 1 = p^2 - r^2``, this is ``r^3 = p^3 - 3/2 p e + (e / (r + p))^2 (r + p / 2)``,
    in which the sums of ``p^3 W_i`` and of ``p q c_i W_i`` vanish.

    Args:
        q: The argument; see `spline_input`.
        centres: The centres c_i, one per row.
        weights: The kernel weights W_i, one per row.
        linear: The linear terms, 3 inputs times 3 outputs.
        spread: See `spread_of`.
        ops: Operations of the number type.
    """
    kernels = []
    reference = None if spread is None else ops.sqrt(dot(q, q) + 1.0)
    for x, y, z in zip(*ops.columns(centres)):
        away = (q[0] - x, q[1] - y, q[2] - z)
        squared = dot(away, away)
        r = ops.sqrt(squared)
        if reference is None:
            kernels.append(squared * r)
        else:
            e = x * (q[0] + away[0]) + y * (q[1] + away[1]) + z * (q[2] + away[2]) + 1.0
            share = e / (r + reference)
            kernels.append(share * share * (r + 0.5 * reference))
    total = ops.weighted_sum(kernels, weights)
    if spread is not None and reference is not None:
        total = triple([x + reference * (1.5 * y) for x, y in zip(total, spread)])
    return triple([total[k] + q[0] * linear[0][k] + q[1] * linear[1][k] + q[2] * linear[2][k] for k in range(3)])


def spread_of(centres: Rows, weights: Rows) -> Triple[float] | None:
    """Return ``sum_i W_i |c_i|^2`` of a spline whose sums of ``W_i`` and ``W_i c_i`` vanish; None for any other."""
    size = sum(abs(w) for row in weights for w in row)
    moments = [sum(w[k] * x for x, w in zip(column, weights)) for column in zip(*centres) for k in range(3)]
    moments += [sum(column) for column in zip(*weights)]
    if max(map(abs, moments)) > _VANISHING * size:
        return None
    squares = [x * x + y * y + z * z for x, y, z in centres]
    return triple([sum(w[k] * square for square, w in zip(squares, weights)) for k in range(3)])
