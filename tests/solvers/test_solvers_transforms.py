"""The torch layer inside torch's own tools: state dicts, `torch.func`, captured graphs; and what it refuses."""

import copy

import numpy as np
import pytest
import torch
from example_model import example_arrays, example_meta, joint_arrays, moving_arrays, touching_arrays

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig
from jawusd.geometry.se3 import se3_exp
from jawusd.solvers import JawLayer

RIGS = {kind: JawRig(example_arrays(kind), example_meta(kind)) for kind in ("anchored", "additive")}
RIGS["touching"] = JawRig(
    {**example_arrays(), **touching_arrays(), **joint_arrays(), **moving_arrays()}, example_meta()
)
LAYERS = {kind: JawLayer(rig) for kind, rig in RIGS.items()}
EVERY = ("forward", "margin", "penalty", "project", "inside", "unconstrained", "encode", "loss")


POSES = ("forward", "encode", "loss")  # what the decoder has a part in


def cases(*names):
    """Every rig for poses; one for what only the bound decides, which is the same in all of them."""
    return [(kind, name) for name in names for kind in (sorted(RIGS) if name in POSES else ["anchored"])]


@pytest.fixture(params=sorted(RIGS))
def pair(request):
    return RIGS[request.param], LAYERS[request.param]


def arguments(rig, name, count=6, seed=0):
    """Poses off the model, parameters on both sides of the bound, or unconstrained vectors."""
    rng = np.random.default_rng(seed)
    d = rng.uniform(*(rig.d_range.T * 1.3), (count, 3))
    if name in ("encode", "loss"):
        return torch.tensor(se3_exp(rng.normal(size=(count, 6)) * ([0.01] * 3 + [0.7] * 3)) @ rig.pose(d))
    if name == "unconstrained":
        return torch.tensor(rig.project(d) * 0.9)
    return torch.tensor(d * 0.1 if name == "inside" else d)


def call(layer, name):
    """Return a function with one output."""
    function = getattr(layer, name)
    return (lambda T: torch.cat([function(T)[0], function(T)[1][..., None]], dim=-1)) if name == "encode" else function


class Wrapped(torch.nn.Module):
    """One function of a layer as a module, as exporters want it."""

    def __init__(self, layer, name):
        super().__init__()
        self.layer, self.name = layer, name

    def forward(self, x):
        return call(self.layer, self.name)(x)


# Both in torch's own forward mode: the first until 2.13, the second from 2.14 on.
@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:FutureWarning")
@pytest.mark.parametrize(("kind", "name"), cases(*EVERY))
def test_vmap_and_jacrev_agree_with_batches_and_with_differences(kind, name):
    rig, layer = RIGS[kind], LAYERS[kind]
    x, function = arguments(rig, name), call(layer, name)
    torch.testing.assert_close(torch.func.vmap(function)(x), function(x), rtol=0, atol=1e-12)
    found = torch.func.vmap(torch.func.jacrev(function))(x)
    h, entries = 1e-5, 12 if x.ndim == 3 else 3  # of poses the upper three rows: nobody moves the fourth
    differences = []
    for entry in range(entries):
        step = torch.zeros(x[0].numel(), dtype=x.dtype)
        step[entry] = h
        step = step.reshape(x.shape[1:])
        differences.append((function(x + step) - function(x - step)) / (2 * h))
    numeric = torch.stack(differences, dim=-1)
    upper = found.flatten(-2)[..., :12] if x.ndim == 3 else found
    torch.testing.assert_close(upper, numeric, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(torch.func.vmap(torch.func.jacfwd(function))(x), found, rtol=1e-9, atol=1e-9)


def test_nested_batches_under_vmap(pair):
    rig, layer = pair
    T = arguments(rig, "loss", 12).reshape(2, 3, 2, 4, 4)
    torch.testing.assert_close(torch.func.vmap(torch.func.vmap(layer.loss))(T), layer.loss(T))


@pytest.mark.slow
def test_project_is_the_evaluators(pair):
    """As near as the plain rig finds, never outside; the same point, but where two are as near."""
    rig, layer = pair
    d = np.random.default_rng(1).uniform(rig.d_range[:, 0] - 6, rig.d_range[:, 1] + 6, (800, 3))
    found, expected = layer.project(torch.tensor(d)).numpy(), rig.project(d)
    left, best = (np.linalg.norm(x - d, axis=1) for x in (found, expected))
    assert (left <= best + 1e-4).all() and (rig.margin(found) >= -1e-12).all()
    same = np.abs(left - best) < 1e-6
    assert same.mean() > 0.95
    np.testing.assert_allclose(found[same], expected[same], atol=2e-3)
    valid = rig.margin(d) >= 0
    np.testing.assert_array_equal(found[valid], d[valid])


def test_every_vector_is_inside_and_every_point_inside_is_reached(pair):
    rig, layer = pair
    rng = np.random.default_rng(2)
    z = rng.normal(size=(3000, 3)) * rng.choice([0.1, 1.0, 30.0, 1e4], (3000, 1))
    d = layer.inside(torch.tensor(z))
    assert (rig.margin(d.numpy()) > 0).all()
    near = np.abs(z).max(axis=1) < 50
    np.testing.assert_allclose(layer.unconstrained(d).numpy()[near], z[near], rtol=1e-6, atol=1e-6)
    low, high = rig.d_range.T
    all_over = rng.uniform(low - 1, high + 1, (20000, 3))
    all_over = torch.tensor(all_over[rig.margin(all_over) > 1e-3])
    assert len(all_over) > 2000
    np.testing.assert_allclose(layer.inside(layer.unconstrained(all_over)).numpy(), all_over.numpy(), atol=1e-9)
    assert torch.isnan(layer.unconstrained(torch.tensor([20.0, 15.0, 0.0], dtype=torch.float64))).all()


def test_the_way_to_the_inside_is_smooth(pair):
    """Its slope changes by as little as a twice differentiable function's would."""
    _, layer = pair
    line = torch.linspace(-3, 3, 601, dtype=torch.float64)[:, None] * torch.tensor([0.7, 1.0, -0.6])
    slopes = torch.func.vmap(torch.func.jacrev(layer.inside))(line)
    assert (slopes[1:] - slopes[:-1]).abs().max() < 0.05 * slopes.abs().max()
    assert (torch.linalg.det(slopes) > 0).all()


def test_state_of_the_same_rig_loads_and_of_another_is_refused():
    rig, layer = RIGS["anchored"], LAYERS["anchored"]
    arrays = example_arrays()
    other = JawLayer(JawRig(dict(arrays, path_coefficients=arrays["path_coefficients"] * 1.2), example_meta()))
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(EvaluatorError, match="is of rig"):
        other.load_state_dict(layer.state_dict())
    for name, value in other.state_dict().items():
        torch.testing.assert_close(value, before[name])
    nameless = {name: value for name, value in layer.state_dict().items() if name != "rig_hash"}
    with pytest.raises(EvaluatorError, match="is of an unknown rig"):
        JawLayer(rig).load_state_dict(nameless, strict=False)
    parent = torch.nn.Sequential(JawLayer(rig))
    parent.load_state_dict(torch.nn.Sequential(layer).state_dict())


@pytest.mark.parametrize(("kind", "name"), cases(*EVERY))
def test_nothing_but_buffers_decides_what_is_computed(kind, name):
    """A layer built from another rig computes as the first one does once it has its buffers."""
    rig, layer = RIGS[kind], LAYERS[kind]
    changed = {key: value * 1.05 for key, value in example_arrays(rig.kind).items() if key in ("landmarks", "incisor")}
    changed["slice_support"] = rig.arrays["slice_support"] * 0.9
    decoder = ("path_coefficients", "glide_drop", "glide_d2_factors", "spline_weights", "curve1_twists")
    changed |= {key: rig.arrays[key] * 1.1 for key in decoder if key in rig.arrays}
    other = JawLayer(JawRig({**rig.arrays, **changed}, example_meta(rig.kind)))
    x = arguments(rig, name)
    assert not torch.equal(call(other, name)(x), call(layer, name)(x))
    found = torch.func.functional_call(
        Wrapped(other, name), {f"layer.{k}": v for k, v in layer.state_dict().items()}, x
    )
    torch.testing.assert_close(found, call(layer, name)(x), rtol=0, atol=0)


@pytest.mark.parametrize(("kind", "name"), cases(*EVERY))
def test_another_type_of_number_is_one_clear_error(kind, name):
    rig, layer = RIGS[kind], LAYERS[kind]
    with pytest.raises(TypeError, match=r"float32.*float64.*layer.to\(torch.float32\)"):
        call(layer, name)(arguments(rig, name).float())
    single = copy.deepcopy(layer).float()
    found = call(single, name)(arguments(rig, name).float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), call(layer, name)(arguments(rig, name)), rtol=1e-3, atol=0.05)


@pytest.mark.parametrize("part", ["bound", "interior"])
def test_the_bound_is_the_same_in_all_rigs(part):
    """Which is why it is compiled and exported for one of them."""
    first = getattr(LAYERS["anchored"], part).state_dict()
    for layer in LAYERS.values():
        assert type(getattr(layer, part)) is type(getattr(LAYERS["anchored"], part))
        state = getattr(layer, part).state_dict()
        assert list(state) == list(first) and all(torch.equal(state[key], first[key]) for key in first)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name"), cases("forward", "margin", "penalty", "unconstrained"))
def test_compiles_as_one_graph_for_any_batch(kind, name):
    rig, layer = RIGS[kind], LAYERS[kind]
    torch._dynamo.reset()
    compiled = torch.compile(call(layer, name), fullgraph=True, dynamic=True, backend="aot_eager")
    for count in (6, 9):
        x = arguments(rig, name, count).requires_grad_()
        found = compiled(x)
        torch.testing.assert_close(found, call(layer, name)(x), rtol=0, atol=1e-12)
        (slope,) = torch.autograd.grad(found.sum(), x)
        (expected,) = torch.autograd.grad(call(layer, name)(x).sum(), x)
        torch.testing.assert_close(slope, expected, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "atol"), [("forward", 1e-12), ("inside", 1e-9), ("project", 0.05), ("loss", 1e-6)])
def test_exports_with_a_dynamic_batch(name, atol):
    """Searches make a fixed number of steps in a captured graph: enough for poses and parameters a jaw comes near."""
    rig, layer = RIGS["anchored"], LAYERS["anchored"]
    x = arguments(rig, name)
    program = torch.export.export(Wrapped(layer, name), (x,), dynamic_shapes=({0: torch.export.Dim("n")},))
    captured = program.module()
    for count in (3, 40):
        x = arguments(rig, name, count, seed=count)
        torch.testing.assert_close(captured(x), call(layer, name)(x), rtol=0, atol=atol)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")  # inside torch's exporter
@pytest.mark.parametrize(("kind", "name"), cases("forward", "margin"))
def test_onnx_export_with_a_dynamic_batch(kind, name, tmp_path):
    pytest.importorskip("onnxscript")
    onnxruntime = pytest.importorskip("onnxruntime")
    rig, layer = RIGS[kind], LAYERS[kind]
    path = tmp_path / "layer.onnx"
    batch = ({0: torch.export.Dim("n")},)
    torch.onnx.export(Wrapped(layer, name).eval(), (arguments(rig, name),), path, dynamic_shapes=batch, verbose=False)
    session = onnxruntime.InferenceSession(path)
    x = arguments(rig, name, 11, seed=4)
    (found,) = session.run(None, {session.get_inputs()[0].name: x.numpy()})
    np.testing.assert_allclose(found, call(layer, name)(x).numpy(), atol=1e-10)
