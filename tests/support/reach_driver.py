"""Run commands over hostile rigs under strace, and list what was opened or connected to outside the rigs' folders.

Under strace: python reach_driver.py FOLDER, which runs the commands over every folder below it in one process.
"""

import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from random import Random

from forked import in_copy

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
STRACE = shutil.which("strace")
GOLDEN = HERE.parent / "golden" / "rig_v2_anchored"
_BETWEEN = "between"
_MARK = "/reach-of/"  # opened, in vain, before each step: the log then tells the steps apart
# What the interpreter, its libraries and the system read of themselves.
_SYSTEM = ("/usr/", "/lib/", "/lib64/", "/proc/", "/sys/", "/dev/null", "/dev/urandom", "/dev/shm", "/etc/ld.so",
           "/etc/localtime", "/etc/ssl/", "/etc/host", "/etc/resolv.conf", "/etc/nsswitch.conf", "/etc/gai.conf",
           "/etc/services", "/etc/mime.types", "/etc/passwd")  # fmt: skip
_OPEN = re.compile(r'openat\((?:AT_FDCWD|\d+)<(?P<folder>[^>]*)>, "(?P<path>[^"]*)"')
_CONNECT = re.compile(r"connect\([^{]*\{(?P<to>[^}]*)\}")
_LOOPBACK = ('inet_addr("127.', "::1")


def write_rigs(folder, count, seed):
    """Write so many rigs, each with a layer made from the grammar of USD, or one that was damaged."""
    import numpy as np
    from example_rig import forget_checksums
    from fuzz_grammar import usd_text
    from fuzz_structures import damaged_layer

    base = shutil.copytree(GOLDEN, folder / "base")
    forget_checksums(base)
    (base / "clip.1.usda").write_text('#usda 1.0\nover "Actor" {}\n')
    (base / "keys.json").write_text(json.dumps({"fps": 24, "keys": [{"frame": f, "d": [f, 0, 0]} for f in (0, 8)]}))
    actor, damage = (base / "actor.usda").read_bytes(), damaged_layer(False)
    for number in range(seed, seed + count):
        rig = shutil.copytree(base, folder / f"{number:06d}")
        if number % 3:
            (rig / "shot.usda").write_bytes(usd_text(Random(number)).encode("utf-8", "surrogatepass"))
        else:
            (rig / "shot.usda").write_bytes(damage(np.random.default_rng(number), actor))
    shutil.rmtree(base)
    (folder / "outside.usda").write_text('#usda 1.0\ndef "Outside" {}\n')


def watch(folder):
    """Run the commands over all rigs of a folder; return (rig, step, call) of what reached out, and counts of steps."""
    log = folder.with_suffix(".strace")
    line = [STRACE, "-f", "-y", "-qq", "-s", "4096", "--seccomp-bpf", "-e", "trace=open,openat,openat2,connect",
            "-o", str(log), sys.executable, str(HERE / "reach_driver.py"), str(folder)]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(HERE)]), "OMP_NUM_THREADS": "1"}
    environment |= {"PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0"}  # as the program
    done = subprocess.run(line, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    return _reached_out(log, folder), done.stdout


def _reached_out(log, folder):
    packages = [part for part in (sys.prefix, sys.base_prefix, *sys.path, str(ROOT / "jawusd")) if len(part) > 1]
    allowed = (*_SYSTEM, *(path + os.sep for part in packages for path in (part, os.path.realpath(part))))
    found, step = [], None
    for line in log.read_text(errors="replace").splitlines():
        match = _OPEN.search(line)
        if match and match["path"].startswith(_MARK):
            step = match["path"].removeprefix(_MARK).split("/")
        elif step is None or step[1] == _BETWEEN:
            continue
        elif match:
            path = os.path.normpath(os.path.join(match["folder"], match["path"]))
            if not (path + os.sep).startswith((*allowed, str(folder / step[0]) + os.sep)):
                found.append((*step, line.strip()))
        elif (match := _CONNECT.search(line)) and not any(name in match["to"] for name in _LOOPBACK):
            found.append((*step, line.strip()))
    return found


def _mark(rig, step):
    with contextlib.suppress(OSError):
        os.close(os.open(f"{_MARK}{rig.name}/{step}", os.O_RDONLY))


def _view(shot):
    from jawusd.pipeline.view import open_viewer

    open_viewer(shot, "127.0.0.1", 0).stop()


def _command(*arguments):
    from jawusd.cli.main import app

    app([str(argument) for argument in arguments], standalone_mode=False)


_STEPS = {
    "info": lambda shot: _command("info", shot),
    "validate": lambda shot: _command("validate", shot),
    "animate": lambda shot: _command("animate", shot, shot.parent / "keys.json", "-o", shot.parent / "out.usda"),
    "view": _view,
}


def _ends_well(step, shot):
    import typer

    from jawusd.base.errors import JawusdError

    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(JawusdError, typer.Exit):
        step(shot)
        return True
    return False


def main(folder):
    """Run the commands, each in a copy of this process; print how many ended well."""
    rigs = sorted(path for path in folder.iterdir() if path.is_dir())
    counts = dict.fromkeys(_STEPS, 0)
    for name, step in _STEPS.items():
        for number, rig in enumerate([rigs[0], *rigs]):  # what is imported on first use is read before the first mark
            if number:
                _mark(rig, name)
            run = partial(_ends_well, step, rig / ("shot.usda" if number else "actor.usda"))
            if number:
                counts[name] += in_copy(run) is True
            else:
                run()
        _mark(rigs[0], _BETWEEN)
    print(f"{len(rigs)} rigs; ended well: " + ", ".join(f"{name} {count}" for name, count in counts.items()))


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
