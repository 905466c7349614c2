"""Compile functions for given argument types, and cache the machine code on disk where that is possible."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import TypeVar, cast

import numba

F = TypeVar("F")

_in_memory = partial(numba.njit, nogil=True, error_model="numpy")
_cacheable: list[bool] = []  # whether machine code can be cached on disk; empty until the first function is compiled


def compiled(signature: str) -> Callable[[F], F]:
    """Return a decorator that compiles a function for the argument types of a signature.

    Without a writable cache folder the code is kept in memory only, and one RuntimeWarning is issued.
    """

    def compile_function(function: F) -> F:
        if not _cacheable or _cacheable[0]:
            try:
                made = cast("F", _in_memory(signature, cache=True)(function))
            except (OSError, RuntimeError) as error:  # no cache folder is writable, or the disk is full
                _cacheable[:] = [False]
                _warn(error)
            else:
                _cacheable[:] = [True]
                return made
        return cast("F", _in_memory(signature)(function))

    return compile_function


def _warn(error: Exception) -> None:
    warnings.warn(
        f"jawusd.fast cannot cache its compiled code on disk ({error}): every process compiles for some 20 seconds. "
        "Set NUMBA_CACHE_DIR to a writable folder.",
        RuntimeWarning,
        stacklevel=4,
    )
