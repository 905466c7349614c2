"""Damage files and read them, in a process of its own: python fuzz_worker.py FOLDER < requests > answers (JSON lines).

Request {"reader", "seed"}: damage one of the reader's files as the seed says and read it. Answer {"outcome", "error",
"peak_mb", "seconds"}; outcome is accepted, refused, ended (a copy that read it, by a signal), traceback or escape.
Seconds are the process's own.
"""

import json
import os
import resource
import shutil
import sys
import time
import traceback
import warnings
from pathlib import Path

from forked import in_copy

MEMORY = 2 << 30
OF_OPENUSD = ("usda", "usdc", "usdz", "USD grammar")  # read in copies of this process
CANARY = "not to be read"


def main():
    """Answer requests until the input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    folder = Path(sys.argv[1]).resolve()
    shutil.rmtree(folder, ignore_errors=True)
    from fuzz_readers import make_targets

    warnings.simplefilter("ignore")
    targets = make_targets(folder / "valid")
    for reader in targets.values():  # what is imported and compiled on first use is no reader's memory
        for target in {t.file: t for t in reader}.values():
            place = prepare(target, folder)
            target.read(place, place / target.file)
    sys.addaudithook(Guard(folder))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.dup2(1, 2)  # libraries print what they think of damaged files
    answers.write(json.dumps({"ready": True, "virtual_mb": status_mb("VmSize")}) + "\n")
    for line in sys.stdin:
        answers.write(json.dumps(answer(json.loads(line), targets, folder)) + "\n")


class Guard:
    """Note what Python is asked to write, start or connect to outside a folder."""

    watching = False
    found = None
    allowed = ()
    _WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    _PATHS = ("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.chmod", "os.truncate")
    _NEVER = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect", "pickle.find_class")

    def __init__(self, folder):
        Guard.allowed = (str(folder), "/dev/null", "/proc/self/")

    def __call__(self, event, args):
        if not self.watching:
            return
        if event == "open":
            path, mode, flags = args
            if isinstance(path, str | bytes) and ((flags or 0) & self._WRITING or set(mode or "") & set("wax+")):
                self.look(event, path)
        elif event in self._PATHS:
            self.look(event, args[0])
        elif event in self._NEVER:
            Guard.found = f"{event} {args!r:.100}"

    @staticmethod
    def look(event, path):
        if isinstance(path, str | bytes) and not os.path.realpath(os.fsdecode(path)).startswith(Guard.allowed):
            Guard.found = f"{event} {os.fsdecode(path)}"


def prepare(target, folder):
    """Return the folder that a reader is given: the target's valid files, with what it must not reach beside them."""
    place = folder / f"in{target.number}"
    if not place.exists():
        place.mkdir(parents=True)
        (place / "secret.txt").write_text(CANARY)
        (place / "outside.usda").write_text('#usda 1.0\ndef "Outside" {}\n')
    work = place / "work"
    if not work.exists() or names(work) != names(target.folder) | {"link_out"}:
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(target.folder, work)
        os.symlink("..", work / "link_out")
    return work


def names(folder):
    """Return the names of all files below a folder."""
    return {str(Path(where, name).relative_to(folder)) for where, a, b in os.walk(folder) for name in a + b}


def answer(request, targets, folder):
    """Do one request."""
    import numpy as np

    options = targets[request["reader"]]
    rng = np.random.default_rng([request["seed"], sum(request["reader"].encode())])
    target = options[rng.integers(len(options))]
    with np.errstate(all="ignore"):
        data = damaged(target, rng)
    os.chdir(folder)
    place = prepare(target, folder)
    path = place / target.file
    path.write_bytes(data)
    os.chdir(place)
    before = outside(place.parent)
    with open("/proc/self/clear_refs", "w") as handle:
        handle.write("5")  # forget the peak so far
    forked = request["reader"] in OF_OPENUSD
    found = in_copy(lambda: outcome(target, place, path)) if forked else outcome(target, place, path)
    if isinstance(found, str):
        found = {"outcome": "ended", "error": found}
    if outside(place.parent) != before:
        found |= {"outcome": "escape", "error": f"{before} became {outside(place.parent)}"}
    if path.exists():
        shutil.copyfile(target.folder / target.file, path)
    return found | {"file": target.file}


def outcome(target, place, path):
    """Read a damaged file and return how that went."""
    from jawusd.base.errors import JawusdError

    Guard.found, Guard.watching = None, True
    start = time.process_time()
    outcome, error = "accepted", None
    try:
        target.read(place, path)
    except JawusdError as refusal:
        outcome, error = "refused", str(refusal)[:300]
    except MemoryError:  # which commands say in one line
        outcome, error = "refused", "memory"
    except PermissionError as escape:
        outcome, error = "escape", str(escape)
    except BaseException:
        outcome, error = "traceback", traceback.format_exc()[-1500:]
    seconds = time.process_time() - start
    Guard.watching = False
    if Guard.found is not None:
        outcome, error = "escape", Guard.found
    return {"outcome": outcome, "error": error, "peak_mb": status_mb("VmHWM"), "seconds": round(seconds, 3)}


def damaged(target, rng):
    """Return the damaged bytes of a target's file; where its structure cannot be damaged as chosen, its bytes are."""
    from fuzz_mutate import damaged_bytes

    data = (target.folder / target.file).read_bytes()
    try:
        return target.damage(rng, data)
    except Exception:
        return damaged_bytes(rng, data)


def outside(place):
    """Return what lies beside the folder that a reader is given, with sizes and times."""
    return sorted((entry.name, entry.stat().st_size * entry.is_file(), entry.is_file() and entry.stat().st_mtime_ns)
                  for entry in os.scandir(place))  # fmt: skip


def status_mb(key):
    """Return a figure of /proc/self/status [MB]."""
    with open("/proc/self/status") as handle:
        return next(int(line.split()[1]) / 1024 for line in handle if line.startswith(key + ":"))


if __name__ == "__main__":
    main()
