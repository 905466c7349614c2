"""Attack the program with hostile files, systems and signals: python tests/faults/attacks.py [NAME ...].

Prints a line per attack: whether it was held off, exit code, time [s], resident memory of the largest process
[MB], and the last line of output. An attack is held off if the command ends in time, with the expected exit code and
words, without a traceback and within the memory limit.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]
from hostile_rigs import doubling, enlarge, nested  # noqa: E402  # from the folder above

GOLDEN, CAPTURE = ROOT / "tests" / "golden" / "rig_v2_anchored", ROOT / "examples" / "capture"
PROGRAM = [sys.executable, "-m", "jawusd"]
YES, NO, FORMAT, CAPTURE_NO, RIG, OUTPUT, ENDED = 0, 1, 3, 5, 8, 10, 12  # exit codes
MOST_S = 300


@dataclass(frozen=True)
class Attack:
    """An attack and its expected outcome.

    Attributes:
        words: makes files in an empty folder, and returns the arguments of `jawusd`.
        code: exit code, negative for a signal.
        says: text required in the output.
        most_mb: limit of resident memory.
        limit: called in the process before the program starts.
        act: called with the running process and the file of its output.
        env: environment variables.
        first: Python code that the process runs before the program.
    """

    words: Callable[[Path], list[str]]
    code: int
    says: str = ""
    most_mb: int = 600
    limit: Callable[[], None] | None = None
    act: Callable[[int, Path], None] | None = None
    env: tuple[tuple[str, str], ...] = ()
    first: str = ""


def rig(folder: Path) -> Path:
    """Copy a rig without its checksums."""
    from example_rig import forget_checksums

    there = Path(shutil.copytree(GOLDEN, folder / "actor"))
    forget_checksums(there)
    return there


def many_faces(folder: Path) -> list[str]:
    """View a rig of some MB that declares 300 million corners of faces."""
    there = rig(folder)
    enlarge(there / "geo.usdc", "/Actor/geo/Mandible/LowerTeethMesh.faceVertexIndices", 300_000_000)
    return ["view", str(there / "actor.usda"), "--port", "0"]


def layer(command: str, body: str, folder: Path) -> list[str]:
    """Run a command over a layer."""
    (folder / "a.usda").write_text(body)
    return [command, str(folder / "a.usda")]


def linked(folder: Path) -> list[str]:
    """Make a rig load a layer from outside its folder through a link."""
    there = rig(folder)
    (there / "rig.usdc").rename(folder / "rig.usdc")
    (there / "rig.usdc").symlink_to(folder / "rig.usdc")
    return ["info", str(there / "actor.usda")]


def named(name: str, folder: Path) -> list[str]:
    """Describe a rig in a folder of a given name."""
    return ["info", str(shutil.copytree(rig(folder), folder / name) / "actor.usda")]


def escapes(folder: Path) -> list[str]:
    """Give an actor a name with control characters that clear the terminal."""
    there = rig(folder) / "actor.usda"
    text = there.read_text()
    there.write_text(text.replace('over "Actor"', 'over "Actor"', 1))
    (there.parent / "shot.usda").write_text(
        '#usda 1.0\n( subLayers = [@actor.usda@] )\nover "Actor" {\n    string jaw:actor = "a\\x1b[2Jb"\n}\n'
    )
    return ["info", str(there.parent / "shot.usda")]


def pictures(folder: Path) -> list[str]:
    """Check a capture with masks as pictures in a folder whose name is not UTF-8."""
    import cv2
    import numpy as np

    there = Path(shutil.copytree(CAPTURE, folder / "cap\udcff"))
    for masks in [path for path in there.rglob("*.mkv") if "masks" in path.parts]:
        masks.with_suffix("").mkdir()
        data = cv2.imencode(".png", np.zeros((36, 48), np.uint8))[1].tobytes()
        for number in range(4):
            (masks.with_suffix("") / f"{number:06d}.png").write_bytes(data)
    toml = there / "capture.toml"
    toml.write_text(toml.read_text().replace(".mkv", "/%06d.png"))
    return ["check", str(toml)]


def archive(folder: Path) -> list[str]:
    """Describe tracks that unpack to 4 GB."""
    packed = zipfile.ZipFile(folder / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with packed, packed.open("a.npy", "w", force_zip64=True) as member:
        for _ in range(64):
            member.write(bytes(64 << 20))
    return ["info", str(folder / "a.npz")]


def cut(folder: Path) -> list[str]:
    """Describe truncated tracks."""
    (folder / "a.npz").write_bytes(b"PK\x03\x04 and no more")
    return ["info", str(folder / "a.npz")]


def device(folder: Path) -> list[str]:
    """Check a capture whose scan is an endless device."""
    there = Path(shutil.copytree(CAPTURE, folder / "capture"))
    scan = next((there / "scans").iterdir())
    scan.unlink()
    scan.symlink_to("/dev/zero")
    return ["check", str(there / "capture.toml"), "--allow-outside"]


def forged(folder: Path) -> list[str]:
    """Write the report of a build whose record is a list."""
    (folder / "build.json").write_text('{"format": "jawusd-build/1", "stages": [], "sha256": ""}')
    return ["report", str(folder)]


def over_device(folder: Path) -> list[str]:
    """Overwrite a pipe with --force."""
    there = rig(folder)
    os.mkfifo(folder / "out.usda")
    (folder / "keys.json").write_text(
        '{"fps": 24, "keys": [{"frame": 0, "d": [0, 0, 0]}, {"frame": 8, "d": [5, 0, 0]}]}'
    )
    return ["animate", str(there), str(folder / "keys.json"), "-o", str(folder / "out.usda"), "--force"]


def viewed(folder: Path) -> list[str]:
    """View a rig."""
    return ["view", str(rig(folder) / "actor.usda"), "--port", "0"]


def when_serving(number: int, process: int, said: Path) -> None:
    """Send a signal once the viewer has printed its address."""
    end = time.monotonic() + MOST_S / 2
    while "http://" not in said.read_text(errors="replace") and time.monotonic() < end:
        time.sleep(0.1)
    os.kill(process, number)


def space(most_mb: int) -> None:
    """Limit address space as `ulimit -v` does."""
    resource.setrlimit(resource.RLIMIT_AS, (most_mb << 20, most_mb << 20))


def without_proc() -> None:
    """Hide /proc from the program; needs root."""
    import ctypes

    libc = ctypes.CDLL(None, use_errno=True)
    private, recursive, detach, new_mounts = 1 << 18, 1 << 14, 2, 0x00020000
    if libc.unshare(new_mounts) or libc.mount(b"none", b"/", None, private | recursive, None):
        raise OSError(ctypes.get_errno(), "needs root")
    libc.umount2(b"/proc", detach)


ASCII = (("LC_ALL", "C"), ("PYTHONUTF8", "0"), ("PYTHONCOERCECLOCALE", "0"))
ATTACKS = {
    "300 million corners": Attack(many_faces, FORMAT, "values, more than the limit", 1800),
    "40,000 prims deep, info": Attack(partial(layer, "info", nested(40_000)), ENDED, "a library crashed"),
    "40,000 prims deep, validate": Attack(partial(layer, "validate", nested(40_000)), ENDED, "a library crashed"),
    "40,000 prims deep, view": Attack(partial(layer, "view", nested(40_000)), ENDED, "a library crashed"),
    "2 ** 28 prims": Attack(
        partial(layer, "info", doubling(28)),
        ENDED,
        "processor time",
        6_000,
        first="import jawusd.rig.untrusted as limits; limits.MAX_CPU_S = 4",  # instead of 20
    ),
    "2 ** 28 prims in 1 GB": Attack(
        partial(layer, "info", doubling(28)), ENDED, "", 1100, env=(("JAWUSD_MEMORY_GB", "1"),)
    ),
    "layer by a link": Attack(linked, RIG, "outside the folder of this file"),
    "folder not UTF-8": Attack(partial(named, "a\udcff"), RIG, "not UTF-8"),
    "emoji, LC_ALL=C": Attack(partial(named, "😀"), YES, "actor", env=ASCII[:1]),
    "emoji, ASCII names": Attack(partial(named, "😀"), RIG, "set PYTHONUTF8=1", env=ASCII),
    "escape sequences": Attack(escapes, YES, "a\\x1b[2Jb"),
    "pictures, not UTF-8": Attack(pictures, CAPTURE_NO, "errors", 1200),
    "archive of 4 GB": Attack(archive, FORMAT, "the limit is 0.5 GB"),
    "archive cut off": Attack(cut, FORMAT, "not a readable npz file"),
    "scan is /dev/zero": Attack(device, CAPTURE_NO, "is not a regular file", 1200),
    "forged build.json": Attack(forged, FORMAT, "build.json"),
    "--force over a pipe": Attack(over_device, OUTPUT, "out.usda"),
    "ulimit -v 60 MB": Attack(viewed, ENDED, "ulimit -v", limit=partial(space, 60)),
    "ulimit -v 300 MB": Attack(viewed, ENDED, "ulimit -v", limit=partial(space, 300)),
    "ulimit -v 900 MB": Attack(viewed, ENDED, "ulimit -v", limit=partial(space, 900)),
    "no /proc": Attack(lambda folder: ["info", str(rig(folder) / "actor.usda")], YES, "actor", limit=without_proc),
    "SIGTERM": Attack(viewed, -signal.SIGTERM, "", 1200, act=partial(when_serving, signal.SIGTERM)),
    "SIGINT": Attack(viewed, YES, "", 1200, act=partial(when_serving, signal.SIGINT)),
}


def after(code: str) -> list[str]:
    """Return the program, started in a process that has run some code."""
    return [sys.executable, "-c", f"{code}\nfrom jawusd.__main__ import main\nmain()"]


def largest_mb(pid: int) -> float:
    """Return the largest peak memory of a process and its children [MB]; `wait4` would count that of this process."""
    found = [0.0]
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        found += [int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM")]
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except (OSError, ValueError):  # it has ended
        return max(found)
    return max([*found, *(largest_mb(int(child)) for child in children)])


def run(attack: Attack, folder: Path) -> tuple[bool, str]:
    """Return whether an attack was held off, and the rest of its line."""
    from forked import in_copy
    from run_jawusd import heed_signals

    def prepare() -> None:
        heed_signals()
        if attack.limit is not None:
            attack.limit()

    words = in_copy(partial(attack.words, folder))  # memory of other processes only
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **dict(attack.env)}
    begun = time.monotonic()
    with open(folder / "said", "w+b") as said:
        process = subprocess.Popen(
            [*(after(attack.first) if attack.first else PROGRAM), *words],
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            env=environment,
            preexec_fn=prepare,
        )
        if attack.act is not None:
            attack.act(process.pid, folder / "said")
        peak_mb = 0.0
        while (code := process.poll()) is None and time.monotonic() - begun < MOST_S:
            peak_mb = max(peak_mb, largest_mb(process.pid))
            time.sleep(0.02)
        if code is None:
            process.kill()
            code = process.wait()
        said.seek(0)
        text = said.read().decode(errors="replace")
    held = code == attack.code and attack.says in text and peak_mb <= attack.most_mb
    held = held and "Traceback" not in text and "\x1b" not in text
    last = (text.strip().splitlines() or [""])[-1].replace(str(folder), "...")
    return held, f"{code:>4} {time.monotonic() - begun:>6.1f} {peak_mb:>6.0f}  {last:.150}"


def main() -> None:
    """Run the attacks and print the outcomes."""
    chosen = sys.argv[1:] or list(ATTACKS)
    print(f"{'attack':<28}{'held':<5}{'code':>5} {'s':>6} {'MB':>6}  said")
    held = []
    for name in chosen:
        with tempfile.TemporaryDirectory() as folder:
            result, line = run(ATTACKS[name], Path(folder))
        held.append(result)
        print(f"{name:<28}{'yes' if result else 'NO':<5} {line}", flush=True)
    print(f"{sum(held)} of {len(held)} held")
    sys.exit(not all(held))


if __name__ == "__main__":
    main()
