"""Compiled code without a folder to keep it in."""

import os
import subprocess
import sys
from pathlib import Path

import jawusd

MODULE = Path(jawusd.__file__).parent / "fast" / "rigid.py"
CODE = """
import runpy, sys
compiled = runpy.run_path(sys.argv[1])["compiled"]  # the package around it would compile for long

@compiled("f8(f8)")
def twice(x):
    return 2.0 * x

@compiled("f8(f8)")
def thrice(x):
    return 3.0 * x

print(twice(1.5), thrice(1.5))
"""


def run(tmp_path, **environment):
    script = tmp_path / "script.py"
    script.write_text(CODE)
    return subprocess.run(
        [sys.executable, script, MODULE], capture_output=True, text=True, env=os.environ | environment
    )


def test_code_that_cannot_be_kept_works_in_memory_with_one_warning(tmp_path):
    nowhere = tmp_path / "file"
    nowhere.write_text("no folder can be made below a file")
    done = run(tmp_path, NUMBA_CACHE_DIR=str(nowhere), NUMBA_CACHE_LOCATOR_CLASSES="UserProvidedCacheLocator")
    assert done.stdout.split() == ["3.0", "4.5"], done.stderr
    assert done.stderr.count("RuntimeWarning") == 1 and "NUMBA_CACHE_DIR" in done.stderr
    assert "Traceback" not in done.stderr


def test_code_that_can_be_kept_is(tmp_path):
    done = run(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "kept"))
    assert done.stdout.split() == ["3.0", "4.5"] and "Warning" not in done.stderr, done.stderr
    assert len(list((tmp_path / "kept").rglob("*.nbc"))) == 2
