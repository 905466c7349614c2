"""Run the program as a user runs it, and write what it takes."""

import signal
import subprocess
import sys


def run(*arguments, code=0):
    """Run the program in a process of its own and return its standard output."""
    command = [sys.executable, "-m", "jawusd", *map(str, arguments)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == code, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result.stdout if code in (0, 1) else result.stderr


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
