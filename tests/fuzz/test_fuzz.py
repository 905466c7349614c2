"""Damaged files end in success or in one clear error, whatever reads them.

The long series is tests/benchmarks/fuzz.py.
"""

import pytest
from fuzz_driver import HELD, READERS, Worker

PER_READER = 80
DEAR = {"USD grammar": 40}  # half a second each
# Inputs of the series that broke a reader before it was mended: made anew from their seeds.
ONCE_BROKEN = {
    "capture.toml": (210, 248, 253, 301),
    "calibration": (424,),
    "PNG masks": (465,),
    "video masks": (257, 335),
    "tracks npz": (5, 205, 210, 221, 223, 241, 251, 259, 268, 349, 409),
    "model npz": (2, 12, 213, 219, 303, 447, 913),
    "keys": (361, 20119, 20257),
    "ARKit CSV": (214,),
    "landmarks": (439,),
    "HDF5": (4, 13, 77, 90, 143),
    "library": (553, 1036),
    "usda": (493, 1140, 55, 57, 70, 71, 73, 87, 95, 109),
    "usdc": (12, 22, 57, 99, 103, 117, 120, 122, 604),
    "usdz": (4,),
    "ONNX": (62,),
}


@pytest.fixture(scope="module")
def worker(tmp_path_factory):
    worker = Worker(tmp_path_factory.mktemp("fuzz") / "work")
    yield worker
    worker.close()


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_damaged_files_are_read_or_refused(worker, reader):
    seeds = [*ONCE_BROKEN.get(reader, ()), *range(DEAR.get(reader, PER_READER))]
    bad = []
    for seed in seeds:
        answer = worker.ask({"reader": reader, "seed": seed})
        if answer["outcome"] not in HELD:
            bad.append((seed, answer["outcome"], answer["error"]))
    assert bad == []
