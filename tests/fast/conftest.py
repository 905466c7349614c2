"""Never test stale machine code: numba's cache notices a change of the file that calls, not of the files it calls."""

import contextlib
from pathlib import Path

import jawusd

PACKAGE = Path(jawusd.__file__).parent
newest = max(path.stat().st_mtime for layer in ("fast", "evaluator") for path in (PACKAGE / layer).glob("*.py"))
for index in (PACKAGE / "fast" / "__pycache__").glob("*.nbi"):
    with contextlib.suppress(FileNotFoundError):  # another test process has deleted it
        if index.stat().st_mtime < newest:
            index.unlink()
