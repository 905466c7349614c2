"""Time the torch layer for growing batches, on CPU and CUDA: python tests/benchmarks/torch_layer.py [RIG]

One row per function and device: million poses per second for each batch size, forwards and backwards, the best of five
calls. `pose` is compared with the numpy evaluator: the largest difference of a matrix entry [mm, rad] in float32 and
float64. Without a CUDA device only the CPU's rows are printed, and that is said. "-": a call would take over 2 s.
"""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from example_model import example_arrays, example_meta

from jawusd import evaluator
from jawusd.solvers import JawLayer

SIZES = (256, 4_096, 65_536, 1_048_576)
LONGEST_S = 2.0  # of a call


def seconds(call: Callable[[], torch.Tensor], device: str) -> float:
    """Return the wall time of one call with its gradients, the best of five after two to warm up."""
    best = np.inf
    for k in range(7):
        start = time.perf_counter()
        call().sum().backward()
        if device == "cuda":
            torch.cuda.synchronize()
        if k >= 2:
            best = min(best, time.perf_counter() - start)
    return best


def rows(rig: evaluator.JawRig, device: str, dtype: torch.dtype) -> None:
    """Print the rates of every function, and how far poses are from the numpy evaluator's."""
    layer = JawLayer(rig).to(device=device, dtype=dtype)
    rng = np.random.default_rng(5)
    name = f"{device} {str(dtype).removeprefix('torch.')}"
    inside = rig.project(rng.uniform(*rig.d_range.T, (4_096, 3)))
    found = layer(torch.tensor(inside, device=device, dtype=dtype)).detach().cpu().numpy()
    print(f"{name:14}pose: at most {np.abs(found - rig.pose(inside)).max():.2g} from the numpy evaluator")
    rates: dict[str, list[float]] = {}  # million poses per second; nan where a call would take too long
    for size in SIZES:
        chosen = inside[rng.integers(0, len(inside), size)]
        d = torch.tensor(chosen, device=device, dtype=dtype).requires_grad_()
        T = layer(d).detach().requires_grad_()
        calls = {
            "pose": lambda d=d: layer(d),
            "margin": lambda d=d: layer.margin(d),
            "project": lambda d=d: layer.project(1.4 * d),
            "loss": lambda T=T: layer.loss(T),
            "encode": lambda T=T: layer.encode(T)[0],
        }
        for call, timed in calls.items():
            before = rates.setdefault(call, [])
            slow = bool(before) and not size / (1e6 * before[-1]) < LONGEST_S
            before.append(np.nan if slow else size / seconds(timed, device) / 1e6)
    for call, found_rates in rates.items():
        line = "".join(f"{'-' if np.isnan(rate) else f'{rate:.3g}':>14}" for rate in found_rates)
        print(f"{name:14}{call:10}{line}", flush=True)


def main() -> None:
    """Print the table."""
    if len(sys.argv) > 1:
        rig = evaluator.load(sys.argv[1])
    else:
        rig = evaluator.JawRig(example_arrays(centres=80), example_meta())
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    chip = torch.cuda.get_device_name() if len(devices) > 1 else "no CUDA device"
    print(f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads; {chip}; million poses/s")
    print(f"{'':24}" + "".join(f"{f'n = {size:,}':>14}" for size in SIZES))
    for device in devices:
        for dtype in (torch.float32, torch.float64):
            rows(rig, device, dtype)


if __name__ == "__main__":
    main()
