"""Never test stale machine code: numba's cache notices a change of the file that calls, not of the files it calls."""

from pathlib import Path

import jawusd

PACKAGE = Path(jawusd.__file__).parent
newest = max(path.stat().st_mtime for layer in ("fast", "evaluator") for path in (PACKAGE / layer).glob("*.py"))
for index in (PACKAGE / "fast" / "__pycache__").glob("*.nbi"):
    if index.stat().st_mtime < newest:
        index.unlink()
