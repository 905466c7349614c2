"""Solutions of searches as differentiable functions: the search is opaque, its derivative is given.

A search takes rows (n, ...) and returns tensors whose first axis is n. It may stop early, depending on values, where
torch runs step by step; while a graph is captured it makes a fixed number of steps. Derivatives come from the implicit
function theorem, which is what `attached` is for; second derivatives of solutions are not carried.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

Search = Callable[[Tensor], tuple[Tensor, ...]]


class _Search(torch.autograd.Function):
    """Run a search on plain tensors whatever transforms of `torch.func` surround it."""

    @staticmethod
    def forward(search: Search, rows: Tensor) -> tuple[Tensor, ...]:
        return search(rows)

    @staticmethod
    def setup_context(ctx: FunctionCtx, inputs: tuple[object, ...], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output)

    @staticmethod
    def backward(ctx: FunctionCtx, *_: Tensor) -> tuple[None, None]:
        return None, None

    @staticmethod
    def vmap(
        info: object, in_dims: tuple[None, int], search: Search, rows: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        rows = rows.movedim(in_dims[1], 0)
        found = _Search.apply(search, rows.flatten(0, 1))
        return tuple(x.unflatten(0, rows.shape[:2]) for x in found), (0,) * len(found)


def solved(search: Search, rows: Tensor) -> tuple[Tensor, ...]:
    """Return what a search finds for rows (n, ...), as constants."""
    if capturing():
        return search(rows.detach())
    found: tuple[Tensor, ...] = _Search.apply(search, rows.detach())
    return found


def capturing() -> bool:
    """Tell whether torch captures a graph, in which nothing may depend on values."""
    return torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export()


def finished(moving: Tensor) -> bool:
    """Tell whether a search whose rows (n,) are moving or not may stop; never while a graph is captured."""
    return not capturing() and not bool(moving.any())


def attached(value: Tensor, jacobian: Tensor, by: Tensor) -> Tensor:
    """Return a value (n, k) with the derivative (n, k, m) by the argument (n, m) it was found for."""
    return value + applied(jacobian, by - by.detach())


def inverse(A: Tensor) -> Tensor:
    """Return the inverses of matrices (n, 3, 3) by cofactors, finite where they are singular.

    `torch.linalg` raises for batches with singular matrices, and has no form in ONNX.
    """
    x, y, z = A.unbind(dim=1)
    first = torch.linalg.cross(y, z)
    determinant = (x * first).sum(dim=1, keepdim=True)
    determinant = torch.where(determinant == 0, torch.ones_like(determinant), determinant)
    columns = torch.stack([first, torch.linalg.cross(z, x), torch.linalg.cross(x, y)], dim=2)
    return columns / determinant.unsqueeze(2)


def applied(A: Tensor, b: Tensor) -> Tensor:
    """Return the products (n, m) of matrices (n, m, k) and vectors (n, k)."""
    return torch.matmul(A, b.unsqueeze(2)).squeeze(2)
