"""Drive a fuzz worker: restart it when it crashes or hangs, and keep the table."""

import json
import os
import select
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
HELD = ("accepted", "refused", "ended")
MOST_CPU_S, MOST_WALL_S = 10.0, 180.0
READERS = (
    "capture.toml", "calibration", "PNG masks", "video masks", "PLY, STL, OBJ", "tracks npz", "model npz", "keys",
    "CSV", "ARKit CSV", "landmarks", "HDF5", "library", "build.json", "journal", "usda", "usdc", "usdz", "ONNX",
    "USD grammar", "TOML schemas", "JSON schemas", "foreign cameras",
)  # fmt: skip


@dataclass
class Tally:
    """Count the outcomes of one reader; `bad` holds (seed or file, outcome, error) of everything that is a fault."""

    accepted: int = 0
    refused: int = 0
    ended: int = 0
    traceback: int = 0
    crash: int = 0
    hang: int = 0
    escape: int = 0
    peak_mb: float = 0.0
    seconds: float = 0.0
    bad: list = field(default_factory=list)

    def add(self, what, answer):
        outcome = answer["outcome"]
        setattr(self, outcome, getattr(self, outcome) + 1)
        self.peak_mb = max(self.peak_mb, answer.get("peak_mb", 0.0))
        self.seconds = max(self.seconds, answer.get("seconds", 0.0))
        if outcome not in HELD:
            self.bad.append((what, outcome, answer["error"]))


class Worker:
    """A worker process that is started when needed."""

    def __init__(self, folder):
        self.folder, self.process = folder, None

    def ask(self, request):
        """Return the answer to a request; crashes and hangs are answers too."""
        if self.process is None:
            self._start()
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def close(self):
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process.stdin.close()
            self.process.stdout.close()
            self.process = None

    def _start(self):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parents[1]), str(HERE)])}
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "TF_FATAL_THROW": "0"}
        environment |= {"PXR_WORK_THREAD_LIMIT": "1", "TF_ENV_SETTING_ALERTS_ENABLED": "0"}  # as the program
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "fuzz_worker.py"), str(self.folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        ready = self.process.stdout.readline()
        if not ready:
            raise RuntimeError(f"the fuzz worker did not start: exit code {self.process.wait()}")

    def _answer(self):
        start, cpu = time.monotonic(), self._cpu_s()
        while not select.select([self.process.stdout], [], [], 0.25)[0]:
            busy, waited = self._cpu_s() - cpu, time.monotonic() - start
            if busy > MOST_CPU_S or waited > MOST_WALL_S:
                self.close()
                return {"outcome": "hang", "error": f"{busy:.0f} s of work in {waited:.0f} s"}
        line = self.process.stdout.readline()
        if line:
            return json.loads(line)
        code = self.process.wait()
        self.close()
        return {"outcome": "crash", "error": f"exit code {code}"}

    def _cpu_s(self):
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(folder, counts, seed):
    """Read so many damaged inputs per reader; yield reader and tally, one after the other.

    Args:
        folder: where the worker works.
        counts: inputs by reader.
        seed: of the first input; the others follow.
    """
    worker = Worker(folder)
    try:
        for reader, count in counts.items():
            tally = Tally()
            for number in range(seed, seed + count):
                tally.add(number, worker.ask({"reader": reader, "seed": number}))
            yield reader, tally
    finally:
        worker.close()
