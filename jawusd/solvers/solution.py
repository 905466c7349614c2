"""Shared by all modules of this package: full precision, and iterative searches as differentiable functions.

Points are hundreds of millimetres from the origin, where bfloat16 resolves only 1 mm, and TensorFloat-32 0.1 mm.

Autograd does not trace a search, which takes rows (n, ...) and returns tensors whose first axis is n; derivatives from
the implicit function theorem are attached to its results. While a graph is captured, a search takes a fixed number of
steps.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import nullcontext
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.autograd.function import FunctionCtx

Search = Callable[[Tensor], tuple[Tensor, ...]]


class _Search(torch.autograd.Function):
    """Run a search on plain tensors under any transforms of `torch.func`."""

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
    """Return the results of a search for rows (n, ...), detached from the graph."""
    if capturing():
        return search(rows.detach())
    found: tuple[Tensor, ...] = _Search.apply(search, rows.detach())
    return found


def capturing() -> bool:
    """Return whether torch is capturing a graph, which must not depend on values."""
    return torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export()


def finished(moving: Tensor) -> bool:
    """Return whether a search may stop: no row of ``moving`` (n,) is set, and no graph is being captured."""
    return not capturing() and not bool(moving.any())


def attached(value: Tensor, jacobian: Tensor, by: Tensor) -> Tensor:
    """Return a value (n, k) with a given derivative (n, k, m) with respect to its argument (n, m)."""
    return value + applied(jacobian, by - by.detach())


def inverse(A: Tensor) -> Tensor:
    """Return the inverses of matrices (n, 3, 3) by cofactors, finite where they are singular.

    `torch.linalg` raises for batches with singular matrices and cannot be exported to ONNX.
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


P = ParamSpec("P")
R = TypeVar("R")

_ALLOWED = (torch.float32, torch.float64)


def full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function of tensors to run without autocast and, outside captured graphs, without TensorFloat-32."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **named: P.kwargs) -> R:
        device = next(each for each in args if isinstance(each, Tensor)).device.type
        with torch.autocast(device, enabled=False) if torch.is_autocast_enabled(device) else nullcontext():
            products = "highest" if capturing() else torch.get_float32_matmul_precision()
            if products == "highest":
                return function(*args, **named)
            torch.set_float32_matmul_precision("highest")
            try:
                return function(*args, **named)
            finally:
                torch.set_float32_matmul_precision(products)

    return wrapped


def check_precision(name: str, found: torch.dtype, own: torch.dtype | None = None) -> None:
    """Raise TypeError if an argument's dtype differs from that of its layer, if any, or one is coarser than float32."""
    if own is not None and own not in _ALLOWED:
        raise TypeError(
            f"the layer was converted to {own}, which is too coarse for poses; it computes in float32 or float64. "
            "Convert it back with layer.float() after converting the module that contains it."
        )
    if found not in _ALLOWED:
        raise TypeError(f"{name} is {found}; it must be float32 or float64. Convert it: {name}.float().")
    if own is not None and found != own:
        raise TypeError(
            f"{name} is {found}; the layer computes in {own}. "
            f"Convert one of them: layer.to({found}) or {name}.to({own})."
        )
