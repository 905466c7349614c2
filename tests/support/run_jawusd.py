"""Run the program as a user runs it, and write what it takes."""

import contextlib
import io
import os
import signal
import subprocess
import sys
from unittest import mock

from jawusd.cli.main import main


def program(*arguments):
    """Run the program in this process, and return what it printed and its exit code as `subprocess.run` does.

    This is what the process does that `jawusd.base.guard` forks; one of its own would import all packages again. An
    error that the program does not handle is raised.
    """
    words = [*map(str, arguments)]
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    code = 0
    with (
        mock.patch.object(sys, "argv", ["jawusd", *words]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    return subprocess.CompletedProcess(words, code, *(stream.buffer.getvalue().decode() for stream in (out, err)))


def run(*arguments, code=0):
    """Run the program in this process and return its standard output, or its error message."""
    result = program(*arguments)
    assert result.returncode == code, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result.stdout if code in (0, 1) else result.stderr


def without_report(folder):
    """Return an environment in which builds write no report, which takes half the time of a short one.

    In `folder` is what hides a package that reports need.
    """
    folder.mkdir()
    (folder / "jinja2.py").write_text("raise ModuleNotFoundError(\"No module named 'jinja2'\", name='jinja2')\n")
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def heed_signals():
    """Restore, in a child process, the signals that tests may ignore: in the background of a shell, or under nohup."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def face_csv(path, weights, fps=30):
    """Write a face capture of rows (open, left, right, forward); None is a moment without a face."""
    rows = ["Timecode,BlendShapeCount,JawForward,JawRight,JawLeft,JawOpen"]
    for k, row in enumerate(weights):
        code = f"10:00:{k // fps:02d}:{k % fps:02d}.000"
        rows.append(f"{code},0" if row is None else f"{code},52,{row[3]},{row[2]},{row[1]},{row[0]}")
    path.write_text("\n".join(rows))
    return path
