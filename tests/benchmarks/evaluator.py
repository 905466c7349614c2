"""Time the evaluator on one core against its peers: python tests/benchmarks/evaluator.py [MODEL.npz]

Peers: onnxruntime on a 3-32-32-6 network, scipy's RegularGridInterpolator on the sampled table, and the usual jaw joint
of face models (axis-angle and translation to a matrix, in numpy). One table to stdout: microseconds per call for one
pose and for 24, and million poses per second for 1,000 and 100,000; then the checks with their bars.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import platform  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
import onnx  # noqa: E402
import onnxruntime  # noqa: E402
from onnx import TensorProto, helper  # noqa: E402
from scipy.interpolate import RegularGridInterpolator  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from brute_force_ik import brute_force_ik  # noqa: E402
from example_model import example_arrays, example_meta  # noqa: E402

from jawusd import evaluator  # noqa: E402
from jawusd.evaluator.table import SampledTable  # noqa: E402
from jawusd.geometry.se3 import se3_exp  # noqa: E402
from jawusd.geometry.so3 import so3_exp  # noqa: E402

SIZES = (1, 24, 1000, 100_000)


def seconds(call: Callable[[], object], least: float = 0.15) -> float:
    """Return the processor time of one call, the best of five runs of at least ``least`` seconds together."""
    call()
    start = time.process_time()
    call()
    count = max(1, int(least / 5 / max(time.process_time() - start, 1e-7)))
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        for _ in range(count):
            call()
        best = min(best, (time.process_time() - start) / count)
    return best


def network() -> onnxruntime.InferenceSession:
    """Return a session of a 3-32-32-6 network, one thread."""
    rng = np.random.default_rng(0)
    nodes, weights, name, width = [], [], "d", 3
    for layer, out in enumerate((32, 32, 6)):
        weights.append(helper.make_tensor(f"W{layer}", TensorProto.FLOAT, [width, out], rng.normal(size=width * out)))
        weights.append(helper.make_tensor(f"b{layer}", TensorProto.FLOAT, [out], rng.normal(size=out)))
        nodes.append(helper.make_node("Gemm", [name, f"W{layer}", f"b{layer}"], [f"h{layer}"]))
        name, width = f"h{layer}", out
        if layer < 2:
            nodes.append(helper.make_node("Tanh", [name], [f"t{layer}"]))
            name = f"t{layer}"
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info("d", TensorProto.FLOAT, ["n", 3])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 6])],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def axis_angle_joint(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the matrices of the usual jaw joint."""
    T = np.zeros((len(rotation), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = so3_exp(rotation), translation, 1.0
    return T


def callers(rig: evaluator.JawRig, d: np.ndarray) -> dict[str, Callable[[], object]]:
    """Return one call per row of the table for these parameters; a single one is passed as shape (3,)."""
    single = len(d) == 1
    d32 = d.astype(np.float32)
    session = network()
    T = rig.pose(d)
    low, high = rig.arrays["d_range"].T
    knots = tuple(np.linspace(a, b, 33) for a, b in zip(low, high))
    twists = rig.twist(np.stack(np.meshgrid(*knots, indexing="ij"), axis=-1))
    table, grid = SampledTable(knots, twists, rig.arrays["T_rest"]), RegularGridInterpolator(knots, twists)
    x, pose = (d[0], T[0]) if single else (d, T)
    chin = rig.arrays["landmarks"][0]
    target = T[:, :3, :3] @ chin + T[:, :3, 3] + 0.3
    start, goal = (rig.project(x), target[0]) if single else (rig.project(d), target)
    noisy = se3_exp(np.full(6, [0.003] * 3 + [0.2] * 3)) @ pose
    rows = {
        "onnxruntime 3-32-32-6": lambda: session.run(None, {"d": d32}),
        "scipy grid, twists only": lambda: grid(d),
        "axis-angle joint": lambda: axis_angle_joint(d * 0.01, d),
        "pose, exact model": lambda: rig.pose(x),
        "pose, table": lambda: table.pose(x),
        "jacobian": lambda: rig.jacobian(x),
        "margin": lambda: rig.margin(x),
        "margin gradient": lambda: rig.margin_gradient(x),
        "validate parameters": lambda: rig.validate_parameters(x),
        "encode": lambda: rig.encode(noisy),
        "validate poses": lambda: rig.validate(noisy),
        "project": lambda: rig.project(x * 1.4),
        "ik, one drag": lambda: rig.ik(chin, goal, start=start),
    }
    if len(d) > 1000:
        del rows["project"], rows["ik, one drag"]
    return rows


def timings(rig: evaluator.JawRig) -> dict[str, dict[int, float]]:
    """Return seconds per call by row and batch size."""
    rng = np.random.default_rng(1)
    inside = rig.project(rng.uniform(*rig.arrays["d_range"].T, (2000, 3)))
    table: dict[str, dict[int, float]] = {}
    for size in SIZES:
        for name, call in callers(rig, np.resize(inside, (size, 3))).items():
            table.setdefault(name, {})[size] = seconds(call)
    return table


def drags(rig: evaluator.JawRig) -> tuple[float, float]:
    """Return the worst excess [mm] of 1,000 drags by about 2 mm over the paper's search, and one's milliseconds."""
    rng = np.random.default_rng(2)
    start = rig.project(rng.uniform(*rig.arrays["d_range"].T, (1000, 3)))
    handles = rig.arrays["landmarks"][:3]
    T = rig.pose(start)
    targets = np.einsum("nij,hj->nhi", T[:, :3, :3], handles) + T[:, None, :3, 3] + rng.normal(size=(1000, 1, 3))
    _, brute_mm = brute_force_ik(rig, handles, targets, start)
    excess, spent = [], []
    for d, target, best in zip(start, targets, brute_mm):
        before = time.process_time()
        _, distance_mm = rig.ik(handles, target, start=d)
        spent.append(time.process_time() - before)
        excess.append(float(distance_mm) - best)
    return max(excess), 1e3 * float(np.median(spent))


def main() -> None:
    """Print the table and the checks."""
    if len(sys.argv) > 1:
        rig = evaluator.load(sys.argv[1])
    else:
        rig = evaluator.JawRig(example_arrays(centres=80), example_meta())
    print(f"{platform.processor() or platform.machine()}, numpy {np.__version__}, one thread, processor time")
    table = timings(rig)
    print(f"{'':26}" + "".join(f"{f'n = {size:,}':>20}" for size in SIZES))
    for name, row in table.items():
        cells = [f"{row[n] * 1e6:.1f} us" if n < 1000 else f"{n / row[n] / 1e6:.3f} M/s" for n in SIZES if n in row]
        print(f"{name:26}" + "".join(f"{cell:>20}" for cell in cells))
    call = table["onnxruntime 3-32-32-6"][1]
    excess_mm, drag_ms = drags(rig)
    rate = {name: 1e-6 * SIZES[-1] / row[SIZES[-1]] for name, row in table.items() if SIZES[-1] in row}
    for text, found, bar in (
        ("one pose, exact / onnxruntime call", table["pose, exact model"][1] / call, "<= 8"),
        ("one pose, table / onnxruntime call", table["pose, table"][1] / call, "<= 3"),
        ("100,000 poses, exact [M/s]", rate["pose, exact model"], ">= 0.4"),
        ("100,000 poses, table [M/s]", rate["pose, table"], ">= 1.5"),
        ("100,000 margins [M/s]", rate["margin"], ">= 1.5"),
        ("100,000 verdicts of d [M/s]", rate["validate parameters"], ">= 1.5"),
        ("100,000 encodings [M/s]", rate["encode"], ">= 0.03"),
        ("IK of three handles, one drag [ms]", drag_ms, "<= 1"),
        ("IK, worst of 1,000 drags over brute force [mm]", excess_mm, "<= 0"),
    ):
        print(f"{text:50}{found:12.3g}   bar {bar}")


if __name__ == "__main__":
    main()
