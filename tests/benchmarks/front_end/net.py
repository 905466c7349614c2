"""Train a small network that tells upper crowns, lower crowns and everything else apart, and write it as ONNX.

    python tests/benchmarks/front_end/net.py FOLDER [--persons 120] [--steps 2500]

Needs torch. Writes FOLDER/net.onnx: input `rgb` (1, 3, h, w), 0 .. 1, h and w multiples of 8; output `logits` (1, 3, h,
w) of upper, lower, other. Seeded: the same versions of torch and numpy, and one thread, give the same weights.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).parent))
from mouths import classes, crop, label_maps, painted

FIRST_PERSON = 20_000  # persons of the benchmarks have other seeds
BATCH = 8
EXAMPLE_PX = 64  # of the picture that the graph is traced with; others may have any size
WIDTHS = (12, 24, 48, 64)


class Block(nn.Sequential):
    """Two convolutions."""

    def __init__(self, inside: int, outside: int) -> None:
        layers: list[nn.Module] = []
        for first in (inside, outside):
            layers += [nn.Conv2d(first, outside, 3, padding=1, bias=False), nn.BatchNorm2d(outside), nn.ReLU()]
        super().__init__(*layers)


class Net(nn.Module):
    """A U-Net (Ronneberger et al. 2015) of three reductions."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.ModuleList([Block(a, b) for a, b in zip((3, *WIDTHS[:-1]), WIDTHS)])
        self.up = nn.ModuleList([Block(a + b, b) for a, b in zip(WIDTHS[:0:-1], WIDTHS[-2::-1])])
        self.last = nn.Conv2d(WIDTHS[0], 3, 1)

    def forward(self, rgb: Tensor) -> Tensor:
        """Return logits (n, 3, h, w) of pictures (n, 3, h, w), 0 .. 1."""
        kept, x = [], 2 * rgb - 1
        for k, block in enumerate(self.down):
            x = block(x if k == 0 else nn.functional.max_pool2d(x, 2))
            kept.append(x)
        for block, skip in zip(self.up, kept[-2::-1]):
            x = block(torch.cat([nn.functional.interpolate(x, scale_factor=2.0, mode="nearest"), skip], 1))
        return self.last(x)


def main() -> None:
    """Train and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--persons", type=int, default=120)
    parser.add_argument("--steps", type=int, default=2500)
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    start = time.perf_counter()
    mouths = list(label_maps(range(FIRST_PERSON, FIRST_PERSON + options.persons)))
    print(f"{len(mouths)} mouths drawn in {time.perf_counter() - start:.0f} s", flush=True)
    net = trained(Net(), mouths, options.steps)
    options.folder.mkdir(parents=True, exist_ok=True)
    path = options.folder / "net.onnx"
    write(net, path)
    count = sum(p.numel() for p in net.parameters())
    print(f"{count} weights, {path.stat().st_size / 1e6:.2f} MB, {time.perf_counter() - start:.0f} s")


def trained(net: Net, mouths: list, steps: int) -> Net:
    """Return the network after so many batches, each painted anew."""
    rng = np.random.default_rng(0)
    optimizer = torch.optim.AdamW(net.parameters(), lr=3e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
    losses = []
    for step in range(steps):
        pairs = [batch_item(mouths[rng.integers(len(mouths))], rng) for _ in range(BATCH)]
        rgb = torch.from_numpy(np.stack([p for p, _ in pairs])).permute(0, 3, 1, 2).float() / 255
        wanted = torch.from_numpy(np.stack([c for _, c in pairs])).long()
        loss = nn.functional.cross_entropy(net(rgb), wanted)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % 100 == 99:
            print(f"step {step + 1}: loss {np.mean(losses[-100:]):.4f}", flush=True)
    return net.eval()


def batch_item(mouth, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture (h, w, 3) and the classes of its pixels (h, w)."""
    labels, depth = crop(mouth, rng)
    return painted(labels, depth, rng), classes(labels)


def write(net: Net, path: Path) -> None:
    """Write the network as ONNX, for pictures of any size."""
    sizes = {"rgb": {2: "h", 3: "w"}, "logits": {2: "h", 3: "w"}}
    example = torch.zeros(1, 3, EXAMPLE_PX, EXAMPLE_PX)
    names = {"input_names": ["rgb"], "output_names": ["logits"]}
    torch.onnx.export(net, (example,), str(path), dynamic_axes=sizes, dynamo=False, **names)


if __name__ == "__main__":
    main()
