"""Compile functions for given argument types, and keep the machine code on disk where a folder can be written."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import TypeVar, cast

import numba

F = TypeVar("F")

_in_memory = partial(numba.njit, nogil=True, error_model="numpy")
_kept: list[bool] = []  # whether code is kept, known once a function was compiled


def compiled(signature: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for the argument types of a signature.

    Where no cache can be written the code stays in memory, and one RuntimeWarning says so.
    """

    def compile_function(function: F) -> F:
        if not _kept or _kept[0]:
            try:
                made = cast("F", _in_memory(signature, cache=True)(function))
            except (OSError, RuntimeError) as error:  # no folder to write, or the disk is full
                if not _kept or _kept[0]:
                    _warn(error)
            else:
                _kept[:] = [True]
                return made
        return cast("F", _in_memory(signature)(function))

    return compile_function


def _warn(error: Exception) -> None:
    _kept[:] = [False]
    warnings.warn(
        f"jawusd.fast cannot keep its compiled code on disk ({error}), and compiles for some 20 seconds in every "
        "process. Set NUMBA_CACHE_DIR to a folder that can be written.",
        RuntimeWarning,
        stacklevel=3,
    )
