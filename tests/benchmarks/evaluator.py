"""Time the evaluator on one core against its peers: python tests/benchmarks/evaluator.py [MODEL.npz]

Peers: onnxruntime on a 3-32-32-6 network, scipy's RegularGridInterpolator on the sampled table, and the usual jaw joint
of face models (axis-angle and translation to a matrix, in numpy). One table to stdout, for numpy alone and for
jawusd[fast]: microseconds per call for one pose and for 24, and million poses per second for 1,000 and 100,000; then
the checks with their bars, and the torch layer beside a linear-blend jaw joint.
Ratios to onnxruntime are to calls timed right before each row, so that a busy machine slows both.
"""

from __future__ import annotations

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

import ctypes  # noqa: E402
import itertools  # noqa: E402
import platform  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
import onnx  # noqa: E402
import onnxruntime  # noqa: E402
import torch  # noqa: E402
from onnx import TensorProto, helper  # noqa: E402
from scipy.interpolate import RegularGridInterpolator  # noqa: E402
from scipy.optimize import least_squares  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from brute_force_ik import brute_force_ik  # noqa: E402
from example_model import example_arrays, example_meta, touching_arrays  # noqa: E402

from jawusd import evaluator  # noqa: E402
from jawusd.fast import accelerate  # noqa: E402
from jawusd.geometry.se3 import se3_exp, transform_points  # noqa: E402
from jawusd.geometry.so3 import so3_exp  # noqa: E402
from jawusd.rig.onnx_sidecar import decode_model  # noqa: E402
from jawusd.solvers import JawLayer  # noqa: E402

SIZES = (1, 24, 1000, 100_000)
REFERENCE = "onnxruntime 3-32-32-6"


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
    return one_thread(model)


def one_thread(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    """Return a session of one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])


def axis_angle_joint(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Return the matrices of the usual jaw joint."""
    T = np.zeros((len(rotation), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = so3_exp(rotation), translation, 1.0
    return T


def sampled(rig: evaluator.JawRig) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return the arguments of the rig's table: 33 knots [mm] each way, twists."""
    knots = tuple(np.linspace(low, high, 33) for low, high in rig.d_range)
    return knots, rig.twist(np.stack(np.meshgrid(*knots, indexing="ij"), axis=-1))


def peers(rig: evaluator.JawRig, d: np.ndarray) -> dict[str, Callable[[], object]]:
    """Return one call of each peer."""
    session, sidecar, d32 = network(), one_thread(decode_model(rig)), d.astype(np.float32)
    knots, twists = sampled(rig)
    grid = RegularGridInterpolator(knots, twists)
    return {
        REFERENCE: lambda: session.run(None, {"d": d32}),
        "actor.onnx": lambda: sidecar.run(None, {"d": d32}),
        "scipy grid, twists only": lambda: grid(d),
        "axis-angle joint": lambda: axis_angle_joint(d * 0.01, d),
    }


def callers(rig: evaluator.JawRig, d: np.ndarray) -> dict[str, Callable[[], object]]:
    """Return one call per function for these parameters; a single one is passed as shape (3,)."""
    single = len(d) == 1
    T = rig.pose(d)
    x, pose = (d[0], T[0]) if single else (d, T)
    handles = rig.landmarks[:3]
    target = transform_points(T, handles) + 0.3
    start, goal = (rig.project(x), target[0]) if single else (rig.project(d), target)
    noisy = se3_exp(np.full(6, [0.003] * 3 + [0.2] * 3)) @ pose
    rows = {
        "pose, exact model": lambda: rig.pose(x),
        "jacobian": lambda: rig.jacobian(x),
        "margin": lambda: rig.margin(x),
        "margin gradient": lambda: rig.margin_gradient(x),
        "validate parameters": lambda: rig.validate_parameters(x),
        "encode": lambda: rig.encode(noisy),
        "validate poses": lambda: rig.validate(noisy),
        "project": lambda: rig.project(x * 1.4),
        "ik, three handles": lambda: rig.ik(handles, goal, start=start),
    }
    if len(d) > 1000:
        del rows["project"], rows["ik, three handles"]
    return rows


def timings(rigs: dict[str, evaluator.JawRig]) -> dict[str, dict[int, float]]:
    """Return seconds per call by row and batch size; rows of a rig carry its name."""
    plain = rigs["numpy"]
    rng = np.random.default_rng(1)
    inside = plain.project(rng.uniform(*plain.d_range.T, (2000, 3)))
    found: dict[str, dict[int, float]] = {}
    for size in SIZES:
        d = np.resize(inside, (size, 3))
        calls = peers(plain, d)
        for kind, rig in rigs.items():
            calls |= {f"{name} [{kind}]": call for name, call in callers(rig, d).items()}
        for name, call in calls.items():
            if size == 1:
                found.setdefault(f"{REFERENCE} beside {name}", {})[1] = seconds(calls[REFERENCE])
            found.setdefault(name, {})[size] = seconds(call)
    return found


def encoding_error_mm(rig: evaluator.JawRig) -> float:
    """Return by how much residuals of 200 encodings exceed those of scipy's least_squares at worst [mm]."""
    rng = np.random.default_rng(3)
    d = rig.project(rng.uniform(*rig.d_range.T, (200, 3)))
    T = se3_exp(rng.normal(size=(200, 6)) * ([0.01] * 3 + [0.5] * 3)) @ rig.pose(d)
    landmarks = rig.landmarks
    found, residual_mm = rig.encode(T)
    excess = []
    for start, pose, left_mm in zip(d, T, residual_mm):
        wanted = transform_points(pose, landmarks)

        def miss(x: np.ndarray, wanted: np.ndarray = wanted) -> np.ndarray:
            return (transform_points(rig.pose(x), landmarks) - wanted).ravel()

        oracle = least_squares(miss, start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
        excess.append(left_mm - np.sqrt(2 * oracle.cost / len(landmarks)))
    return float(max(excess))


def drags(rigs: dict[str, evaluator.JawRig]) -> dict[str, tuple[float, float]]:
    """Return the worst excess [mm] of 1,000 drags by about 2 mm over the paper's search, and one's milliseconds."""
    rng = np.random.default_rng(2)
    fast = rigs["fast"]
    start = fast.project(rng.uniform(*fast.d_range.T, (1000, 3)))
    handles = fast.landmarks[:3]
    targets = transform_points(fast.pose(start), handles) + rng.normal(size=(1000, 1, 3))
    _, brute_mm = brute_force_ik(fast, handles, targets, start)
    found = {}
    for kind, rig in rigs.items():
        excess, spent = [], []
        for d, target, best in zip(start, targets, brute_mm):
            before = time.process_time()
            _, distance_mm = rig.ik(handles, target, start=d)
            spent.append(time.process_time() - before)
            excess.append(float(distance_mm) - best)
        found[kind] = max(excess), 1e3 * float(np.median(spent))
    return found


def verdict_with_teeth(rig: evaluator.JawRig) -> float:
    """Return what a verdict on one pose takes where the rig also knows how the teeth meet, in onnxruntime calls."""
    touching = accelerate(evaluator.JawRig({**rig.arrays, **touching_arrays(rig.kind)}, rig.meta))
    d = touching.project([8.0, 1.0, 1.0])
    T, d32, session = touching.pose(d), d[None].astype(np.float32), network()
    reference = seconds(lambda: session.run(None, {"d": d32}))
    return seconds(lambda: touching.validate(T)) / reference


def stream_verdict_ms(rig: evaluator.JawRig) -> float:
    """Return the time of a verdict on one pose of a stream with a speed limit [ms]."""
    stream, time_s = rig.verdicts(speed_limit_mm_s=100.0), itertools.count()
    T = rig.pose(rig.project([8.0, 1.0, 1.0]))
    return 1e3 * seconds(lambda: stream(T, next(time_s)))


def checks(rigs: dict[str, evaluator.JawRig], table: dict[str, dict[int, float]]) -> None:
    """Print what the bars are about."""
    bars = {
        "numpy": {"exact": 8, "exact rate": 0.4, "encode rate": 0.03, "stream": 0.5},
        "fast": {"exact": 0.4, "exact rate": 1.5, "encode rate": 0.1, "stream": 0.1},
    }
    dragged = drags(rigs)
    for kind, bar in bars.items():

        def ratio(name: str, kind: str = kind) -> float:
            row = f"{name} [{kind}]"
            return table[row][1] / table[f"{REFERENCE} beside {row}"][1]

        def rate(name: str, kind: str = kind) -> float:
            return 1e-6 * SIZES[-1] / table[f"{name} [{kind}]"][SIZES[-1]]

        excess_mm, drag_ms = dragged[kind]
        rows = [
            ("one pose, exact / onnxruntime call", ratio("pose, exact model"), f"<= {bar['exact']}"),
            ("100,000 poses, exact [M/s]", rate("pose, exact model"), f">= {bar['exact rate']}"),
            ("project from outside [us]", 1e6 * table[f"project [{kind}]"][1], "<= 300"),
            ("100,000 margins [M/s]", rate("margin"), ">= 1.5"),
            ("100,000 verdicts of d [M/s]", rate("validate parameters"), ">= 1.5"),
            ("100,000 encodings [M/s]", rate("encode"), f">= {bar['encode rate']}"),
            ("encoding, residual over scipy's [mm]", encoding_error_mm(rigs[kind]), "<= 1e-4"),
            ("verdict on one pose of a stream [ms]", stream_verdict_ms(rigs[kind]), f"<= {bar['stream']}"),
            ("IK of three handles, one drag [ms]", drag_ms, "<= 1"),
            ("IK, worst of 1,000 drags over brute force [mm]", excess_mm, "<= 0"),
        ]
        if kind != "numpy":
            rows.append(("encoding of one pose / onnxruntime call", ratio("encode"), "<= 1.5"))
            rows.append(("verdict on one pose / onnxruntime call", ratio("validate poses"), "<= 1.8"))
            rows.append(("the same of a rig with teeth", verdict_with_teeth(rigs[kind]), "<= 1.8"))
        for text, found, wanted in rows:
            print(f"{kind:6} {text:50}{found:12.3g}   bar {wanted}")


def blended(R: torch.Tensor, t: torch.Tensor, vertices: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return vertices (n, v, 3) moved by rotations (n, 3, 3) and translations (n, 3), linearly blended."""
    return vertices + weights * (vertices @ R.transpose(1, 2) + t[:, None] - vertices)


def rotations(turn: torch.Tensor) -> torch.Tensor:
    """Return the rotations (n, 3, 3) of the usual jaw joint, axis-angle (n, 3)."""
    angle = turn.norm(dim=1)[:, None, None]
    x, y, z = (turn / angle[:, :, 0]).unbind(dim=1)
    o = torch.zeros_like(x)
    K = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=turn.dtype) + torch.sin(angle) * K + (1 - torch.cos(angle)) * (K @ K)


def keep_memory() -> None:
    """Let glibc keep what tensors of 25 MB free.

    Or else some processes ask the system for it at each call and others never do: 6,000 page faults, as much time again
    as the whole joint takes, on whichever of two alike functions has a tensor more alive (mallopt(3): M_MMAP_THRESHOLD
    is -3 and at most 32 MiB, M_TRIM_THRESHOLD -1).
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(-3, 32 << 20)
        libc.mallopt(-1, 1 << 30)


def torch_checks(rig: evaluator.JawRig) -> None:
    """Print what the torch layer costs, forwards and backwards, for 256 frames."""
    keep_memory()
    torch.set_num_threads(1)
    rng = np.random.default_rng(5)
    layer = JawLayer(rig)
    d = torch.tensor(rig.project(rng.uniform(*rig.d_range.T, (256, 3)))).requires_grad_()
    T = layer(d).detach().requires_grad_()
    vertices, weights = torch.tensor(rng.normal(size=(4000, 3)) * 30), torch.tensor(rng.uniform(size=(4000, 1)))
    turn = torch.tensor(rng.normal(size=(256, 3)) * 0.1).requires_grad_()
    shift = torch.zeros(256, 3, dtype=torch.float64, requires_grad=True)

    def skinned() -> torch.Tensor:
        T = layer(d)
        return blended(T[:, :3, :3], T[:, :3, 3], vertices, weights)

    calls = {
        "joint": lambda: blended(rotations(turn), shift, vertices, weights),
        "pose": lambda: layer(d),
        "pose, 4,000 vertices": skinned,
        "loss": lambda: layer.loss(T),
        "project": lambda: layer.project(d * 1.4),
        "inside": lambda: layer.inside(d * 0.1),
    }
    spent = dict.fromkeys(calls, np.inf)
    for _ in range(5):  # in turn, so that a busy machine slows all
        for name, call in calls.items():
            spent[name] = min(spent[name], seconds(lambda call=call: call().sum().backward()))
    rows = [
        ("pose / jaw joint of 4,000 vertices", spent["pose"] / spent["joint"], "<= 1.2"),
        ("pose and its 4,000 vertices / the same", spent["pose, 4,000 vertices"] / spent["joint"], "<= 1.2"),
        ("loss / pose", spent["loss"] / spent["pose"], "<= 4"),
        *((f"{name} [ms]", 1e3 * spent[name], "-") for name in calls),
    ]
    for text, found, wanted in rows:
        print(f"torch  {text:50}{found:12.3g}   bar {wanted}")


def main() -> None:
    """Print the table and the checks."""
    if len(sys.argv) > 1:
        rig = evaluator.load(sys.argv[1])
    else:
        rig = evaluator.JawRig(example_arrays(centres=80), example_meta())
    rigs = {"numpy": rig, "fast": accelerate(rig)}
    print(f"{platform.processor() or platform.machine()}, numpy {np.__version__}, one thread, processor time")
    table = timings(rigs)
    print(f"{'':34}" + "".join(f"{f'n = {size:,}':>16}" for size in SIZES))
    for name, row in table.items():
        if " beside " not in name:
            cells = [f"{row[n] * 1e6:.1f} us" if n < 1000 else f"{n / row[n] / 1e6:.3f} M/s" for n in SIZES if n in row]
            print(f"{name:34}" + "".join(f"{cell:>16}" for cell in cells))
    checks(rigs, table)
    torch_checks(rig)


if __name__ == "__main__":
    main()
