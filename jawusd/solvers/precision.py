"""Precision of the torch functions: float32 or float64, regardless of autocast and matrix multiplication settings.

Points are hundreds of millimetres from the origin, where bfloat16 resolves only 1 mm, and TensorFloat-32 0.1 mm.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import nullcontext
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from jawusd.solvers.solution import capturing

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
    """Check the dtype of an argument, and that of the layer it is passed to, if any.

    Raises:
        TypeError: they differ, or are coarser than float32.
    """
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
