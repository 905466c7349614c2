"""Analytic jaw models for tests: plausible in size and shape, made without any fitting.

`example_arrays(kind)` gives the named arrays of a rig (see `jawusd.evaluator.JawRig`), `example_meta(kind)` the header.
The jaw opens 42 mm along a slightly deviating path, turns 30 degrees while its condyles slide 12 mm, moves 9 mm
sideways and 7 mm forward; skull and anatomical frames differ, and the scans' rest is not the identity.
"""

import numpy as np

OPENING_MM = 42.0
INCISOR = np.array([0.3, -2.0, -1.5])
# incisal point, left and right first molar, left and right condyle: anatomical coordinates at rest [mm]
LANDMARKS_ANATOMICAL = np.array(
    [INCISOR, [24.0, 4.0, -32.0], [-24.5, 4.2, -31.5], [50.0, 38.0, -88.0], [-51.0, 37.5, -87.0]]
)


def example_arrays(kind="anchored", centres=40):
    """Return the arrays of an example model of kind "anchored" (with so many spline centres) or "additive"."""
    A = _transform([0.2, -0.1, 0.3], [3.0, -40.0, 20.0])
    rest = _transform([0.01, -0.02, 0.005], [0.2, -0.4, 0.3])
    to_mandible = np.linalg.inv(A @ rest)
    arrays = {
        "T_anatomical_skull": A,
        "T_rest": rest,
        "incisor": INCISOR.copy(),
        "d_range": np.array([[0.0, OPENING_MM], [-9.0, 9.5], [-1.5, 7.0]]),
        "landmarks": LANDMARKS_ANATOMICAL @ to_mandible[:3, :3].T + to_mandible[:3, 3],
        "residual_limit_mm": np.array(0.9),
        "tolerance_mm": np.array(0.0),
        **_bounds(),
    }
    arrays |= _anchored(centres) if kind == "anchored" else _additive()
    return arrays


def touching_arrays(kind="anchored"):
    """Return what rigs have whose scans meet: a rough glide surface (anchored ones) and clearances."""
    rng = np.random.default_rng(21)
    shape, first, step = (7, 9, 6), np.array([-1.0, -8.0, -2.0]), np.array([0.5, 2.0, 1.6])
    values = np.round(100 * (0.4 * np.arange(7)[:, None, None] + rng.uniform(0.01, 0.5, shape)))
    arrays = {
        "contact_first_mm": first,
        "contact_step_mm": step,
        "contact_shape": np.array(shape, dtype=float),
        "contact_values": values.ravel(),
        "contact_closed_mm": np.array(0.4),
        "contact_error_mm": np.array(0.05),
        "contact_limit_mm": np.array(-0.3),
    }
    if kind == "additive":
        return arrays
    d2, d3 = np.arange(-9.0, 10.0, 1.5), np.arange(-2.0, 8.0, 1.0)
    side = np.stack([0.3 * np.cos(d2), 0.2 * np.sin(0.7 * d2 + 0.5), np.zeros(len(d2))], axis=1)
    front = np.stack([np.cos(0.8 * d3), np.sin(d3 + 0.3), np.ones(len(d3))], axis=1)
    side[:, 2] = -(side[d2 == 0, :2] * front[d3 == 0, :2]).sum()
    return {**arrays, "glide_d2": d2, "glide_d2_factors": side, "glide_d3": d3, "glide_d3_factors": front}


def joint_arrays():
    """Return what rigs have whose bones are scanned: clearances of the condyles."""
    values = np.round(100 * np.random.default_rng(22).uniform(-0.5, 1.5, (9, 5, 4)))
    return {
        "joint_first_mm": np.array([-1.0, -8.0, -2.0]),
        "joint_step_mm": np.array([5.0, 4.0, 3.0]),
        "joint_shape": np.array(values.shape, dtype=float),
        "joint_values": values.ravel(),
        "joint_closed_mm": np.array(-0.4),
        "joint_error_mm": np.array(0.1),
        "joint_limit_mm": np.array(-0.5),
    }


def moving_arrays():
    """Return what rigs have whose take has a frame rate: covariances of velocity and acceleration."""
    mixing = np.array([[30.0, 0.0, 0.0], [4.0, 12.0, 0.0], [-3.0, 1.0, 7.0]])
    return {"velocity_covariance": mixing @ mixing.T, "acceleration_covariance": 90.0 * mixing.T @ mixing}


def held_out_arrays():
    """Return the arrays of rigs whose fit held frames out: how far these lie outside the bound."""
    return {"held_out_share": np.array(0.76), "held_out_p95_mm": np.array(4.2)}


def example_meta(kind="anchored"):
    """Return the header that goes with `example_arrays`."""
    return {
        "format": "jawusd-model/2",
        "kind": kind,
        "method": kind,
        "actor": "example",
        "units": {"length": "mm", "angle": "rad"},
        "twist_order": ["omega", "v"],
    }


def _anchored(count):
    rng = np.random.default_rng(7)
    centres = rng.uniform([-0.2, -1.6, -1.2], [3.0, 1.6, 1.6], (count, 3))
    scales = np.array([15.0, 6.0, 5.0])
    path = np.array([[0.4, -1.1, 0.5, 0.6, -0.3], [-2.0, -14.0, -4.0, 1.0, 0.3]])
    weights = _interpolating_weights(centres, scales, path)
    return {
        "path_coefficients": path,
        "path_scale_mm": np.array(OPENING_MM),
        "path_limits": np.array([-3.0, 1.15 * OPENING_MM]),
        "glide_arch": np.array([0.25, -0.2, 0.05, 0.02, -0.03, 0.04, -0.02]),
        "glide_drop": np.array([0.15, 0.25, 0.3, 0.35]),
        "glide_softness_mm": np.array(2.0),
        "glide_fade_mm": np.array(14.0),
        "spline_scales": scales,
        "spline_centres": centres,
        "spline_weights": weights,
    }


def _interpolating_weights(centres, scales, path):
    """Weights that make the spline follow a rotation a jaw could have (plus its polynomial tail)."""
    q = centres * scales  # opening above the path, and lateral and sagittal distance from it [mm]
    opening, side, front = q.T
    s = opening / OPENING_MM
    omega = np.stack(
        [
            np.deg2rad(30.0) * (1.25 * s - 0.25 * s**2) - 0.012 * front * np.exp(-s),
            -0.016 * side * (1 - 0.3 * s) + 0.0004 * side * front,
            0.006 * side * np.exp(-((s / 0.5) ** 2)),
        ],
        axis=1,
    )
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    m = len(centres)
    system = np.zeros((m + 4, m + 4))
    system[:m, :m] = distance**3
    system[:m, m : m + 3] = centres
    system[:m, m + 3] = 1.0
    system[m:, :m] = system[:m, m:].T
    solution = np.linalg.solve(system, np.concatenate([omega, np.zeros((4, 3))]))
    return solution[: m + 3]  # the constant drops out: the rig subtracts the value at rest


def _additive():
    opening = np.linspace(0.0, OPENING_MM, 9)
    side = np.linspace(-10.0, 10.0, 7)
    front = np.linspace(-2.0, 8.0, 6)
    s = opening / OPENING_MM
    lateral = side / 10.0
    zero1, zero2, zero3 = np.zeros_like(opening), np.zeros_like(side), np.zeros_like(front)
    angle = np.deg2rad(30.0) * (1.25 * s - 0.25 * s**2)
    twists1 = [angle, 0.01 * s, zero1, 0.4 * s - 1.1 * s**2, -0.93 * opening, -4.0 * s - 12.0 * s**2]
    twists2 = [0.01 * lateral**2, -0.16 * lateral, 0.05 * lateral, side, -2.0 * lateral**2, 0.5 * lateral**2]
    twists3 = [-0.012 * front, zero3, zero3, zero3, -0.2 * front - 0.02 * front**2, front]
    arrays = {}
    for i, knots, rows in ((1, opening, twists1), (2, side, twists2), (3, front, twists3)):
        twists = np.stack(np.broadcast_arrays(*rows), axis=1) + 0.0 * zero2[0]
        arrays[f"curve{i}_knots"] = knots
        arrays[f"curve{i}_twists"] = twists - [np.interp(0.0, knots, column) for column in twists.T]
        arrays[f"curve{i}_slopes"] = np.gradient(twists, knots, axis=0)
    return arrays


def _bounds():
    """Sections that shrink with opening, wider to the left than to the right, softly cornered."""
    d1 = np.linspace(0.0, OPENING_MM, 33)
    angle = 2 * np.pi * np.arange(16) / 16
    directions = np.stack([np.cos(angle), 1.6 * np.sin(angle)], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    s = d1 / OPENING_MM
    left, right = 8.5 * (1 - 0.75 * s**1.2), 8.0 * (1 - 0.7 * s**1.3)
    forward, back = 6.0 * (1 - 0.8 * s) + 0.3, 0.6 + 0.6 * np.sin(np.pi * s)
    reach2 = np.where(directions[:, 0] > 0, left[:, None], right[:, None])
    reach3 = np.where(directions[:, 1] > 0, forward[:, None], back[:, None])
    support = np.sqrt((reach2 * directions[:, 0]) ** 2 + (reach3 * directions[:, 1]) ** 2)
    outline2 = np.concatenate([np.stack([d1, left], 1), np.stack([d1, -right], 1)[::-1]])
    outline3 = np.concatenate([np.stack([d1, forward], 1), np.stack([d1, -back], 1)[::-1]])
    rng = np.random.default_rng(3)
    t = rng.uniform(0, 1, 400)
    codes = np.stack(
        [
            OPENING_MM * t,
            rng.uniform(-0.9, 0.9, 400) * np.interp(t, s, np.minimum(left, right)),
            rng.uniform(-0.1, 0.8, 400) * np.interp(t, s, forward),
        ],
        axis=1,
    )
    return {
        "slice_d1": d1,
        "slice_directions": directions,
        "slice_support": support,
        "slice_softness_mm": np.array(0.15),
        "slice_margin_mm": np.array(0.8),
        "polygon_d1d2": outline2,
        "polygon_d1d2_counts": np.array([len(outline2)]),
        "polygon_d1d3": outline3,
        "polygon_d1d3_counts": np.array([len(outline3)]),
        "codes": codes,
    }


def _transform(omega, t):
    angle = np.linalg.norm(omega)
    x, y, z = np.asarray(omega) / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    T = np.eye(4)
    T[:3, :3] = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)
    T[:3, 3] = t
    return T
