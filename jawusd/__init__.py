"""jawusd: capture in, jaw rig out.

Importing this package loads nothing heavy; `load` brings in OpenUSD when it is called.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from os import PathLike

    from jawusd.evaluator import JawRig

__all__ = ["__version__", "load"]
__version__ = "0.1.0"


def load(path: str | PathLike[str], *, fast: bool = False) -> JawRig:
    """Load a rig for posing, validation and inverse kinematics.

    Args:
        path: `actor.usda` (or any layer or package that carries the rig), or a `model.npz`.
        fast: Compile the most used functions with numba: the same results to 1e-10, several times faster. Needs
            `pip install 'jawusd[fast]'`; the first use after an installation compiles for about a minute.

    Returns:
        The evaluator of the rig.

    Raises:
        FormatError: the file is not a rig, is incomplete, or was written by a newer version.
        RigError: the stage cannot be opened.
        MissingDependencyError: ``fast`` without numba.
    """
    if str(path).endswith(".npz"):
        from jawusd import evaluator

        rig = evaluator.load(path)
    else:
        from jawusd.rig import load_rig

        rig = load_rig(path)
    if not fast:
        return rig
    from jawusd.fast import accelerate

    return accelerate(rig)
