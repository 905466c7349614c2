"""Long runs: python tests/benchmarks/long_runs.py [--frames 1000 20000] [--captures 50] [--sessions 300].

frames      peak memory of tracking a take of so many frames: the example's masks, played to and fro
captures    `build-many` of short captures that is killed five times and meets a full disk once (no file may grow
            beyond some size), then resumed to the end: every folder is compared with that of a serial build
at once     two builds started together in one folder: one is told so, the other ends as a serial build
sessions    memory of a viewer after so many pages were opened, used and closed
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from faults import digests, finish, kill, records, start_build, unfinished
from package_copy import ROOT
from short_example import write_short

SHORT_FRAMES = 30
FULL_BYTES = 60_000  # a file may have on the full disk: tracks and meshes are larger


def main() -> None:
    """Run what was asked for; leave with 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="*", default=[1000, 20_000])
    parser.add_argument("--captures", type=int, default=50)
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--sessions", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if options.frames:
            track_memory(folder, options.frames)
        good = not options.captures or many(folder, options.captures, options.kills, options.seed)
        if options.sessions:
            sessions(folder, options.sessions)
    sys.exit(not good)


def program(*arguments: object) -> list[str]:
    """Return the command line of the program."""
    return [sys.executable, "-m", "jawusd", *map(str, arguments)]


def track_memory(folder: Path, counts: list[int]) -> None:
    """Track takes of several lengths and print the peak memory of each."""
    peaks = []
    for count in counts:
        take = looped_take(folder / f"take{count}", count)
        start = time.perf_counter()
        line = program("track", take, "-o", folder / f"{count}.npz", "--jobs", 1)
        process = subprocess.Popen(line, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        peaks.append(usage.ru_maxrss / 1024)
        took = time.perf_counter() - start
        print(f"{count:>6} frames: {peaks[-1]:.0f} MB, {took:.0f} s, exit code {status >> 8}", flush=True)
    print(f"memory of {counts[-1]} frames is {peaks[-1] / peaks[0]:.2f} of that of {counts[0]}")


def looped_take(folder: Path, count: int) -> Path:
    """Write a capture of so many frames from the example's: forwards, backwards, forwards, as numbered pictures."""
    import cv2

    from jawusd.media.video import Video

    write_short(folder, 300)
    text = (folder / "capture.toml").read_text().replace(".mkv", "/%06d.png")
    (folder / "capture.toml").write_text(re.sub(r"frames = \[20, \d+\]", f"frames = [20, {20 + count}]", text))
    for video in sorted(folder.rglob("*.mkv")):
        place = video.with_suffix("")
        place.mkdir()
        stored = Video(video).count
        for frame in Video(video).frames():
            cv2.imwrite(str(place / f"x{frame.index}.png"), frame.image)
        last = min(stored, 315) - 1
        for number in range(count + 60):
            shown = number if number < 20 else 20 + (last - 20 - abs((number - 20) % (2 * (last - 20)) - (last - 20)))
            os.link(place / f"x{shown}.png", place / f"{number:06d}.png")
    return folder


def many(folder: Path, count: int, kills: int, seed: int) -> bool:
    """Disturb a run over many captures, finish it, and compare each folder with a serial build."""
    take, rng = write_short(folder / "take", SHORT_FRAMES), np.random.default_rng(seed)
    # as deep as the others: build.json tells the way to the take
    serial, out = folder / "alone" / "serial", folder / "out"
    start = time.perf_counter()
    code, said = finish(start_build(take, serial))
    if code:
        sys.exit(said)
    alone_s = time.perf_counter() - start
    (folder / "list.txt").write_text("".join(f"take, number{k:03d}\n" for k in range(count)))
    line = program("build-many", folder / "list.txt", "-o", out, "--workers", 2)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    for number in range(kills):
        resumed = ["--resume"] if out.exists() else []
        process = subprocess.Popen([*line, *resumed], env=environment, **quiet)
        time.sleep(rng.uniform(0.5, 1.5) * alone_s * count / 2 / (kills + 1))
        print(f"kill {number}: {'at work' if kill(process) else 'had ended'}, {built(out)} built", flush=True)
    full = subprocess.run([*line, "--resume"], env=environment, preexec_fn=_full_disk, check=False, **quiet)
    print(f"full disk: exit code {full.returncode}, {built(out)} built, {full.stderr.count('Traceback')} tracebacks")
    last = subprocess.run([*line, "--resume"], env=environment, check=False, **quiet)
    wanted, noted = digests(serial), records(serial)
    equal = sum(digests(one) == wanted and records(one) == noted for one in out.iterdir() if one.is_dir())
    left = sum(len(unfinished(one)) for one in out.iterdir() if one.is_dir())
    print(f"resumed: exit code {last.returncode}; {equal} of {count} folders equal to a serial build, {left} scraps")
    return at_once(folder, take, wanted) and equal == count and not left


def _full_disk() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (FULL_BYTES, FULL_BYTES))


def built(out: Path) -> int:
    """Return how many folders hold a finished rig."""
    return len(list(out.glob("*/report.html")))


def at_once(folder: Path, take: Path, wanted: dict[str, str]) -> bool:
    """Start two builds in one folder and compare what they leave with a serial build."""
    both = [start_build(take, folder / "both"), start_build(take, folder / "both")]
    ends = [finish(process) for process in both]
    same = digests(folder / "both") == wanted
    said = [text.strip().splitlines()[-1][-120:] for code, text in ends if code]
    print(f"two at once: exit codes {sorted(code for code, _ in ends)}, equal: {same}; {said}")
    return same and sorted(code for code, _ in ends)[0] == 0


def sessions(folder: Path, count: int) -> None:
    """Open, use and close pages of a rig, and print the memory after a tenth of them and at the end."""
    from example_rig import FPS, example_meshes, example_motion, example_rig
    from quiet_page import QuietPage

    from jawusd.pipeline.view import open_viewer
    from jawusd.rig.bake import bake_rig

    frames, d = example_motion()
    bake_rig(folder / "rig", example_rig(), example_meshes(), name="a", fps=FPS, frames=frames, d=d, table_size=17)
    viewer = open_viewer(folder / "rig", "127.0.0.1", 0)
    resident = {}
    for number in range(1, count + 1):
        page = QuietPage(viewer, number)
        page.enter(page.page.pose.sliders[0], 5.0 + number % 10)
        page.call(page.page.close)
        if number in (count // 10, count // 2, count):
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            resident[number] = pages * resource.getpagesize() / 2**20
    viewer.stop()
    print("sessions: " + ", ".join(f"{megabytes:.0f} MB after {number}" for number, megabytes in resident.items()))


if __name__ == "__main__":
    main()
