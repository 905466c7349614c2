"""The jaw model written down a second time, from its formulas, in 50-digit arithmetic (mpmath).

Independent of `jawusd.evaluator`: a test oracle for values and, by central differences, for derivatives.
"""

import mpmath as mp

mp.mp.dps = 50
_STEP = mp.mpf(10) ** -20


def gauge(arrays, d):
    """Incisal displacement (x, y, z) of d."""
    d1, d2, d3 = d
    low, high = (mp.mpf(float(x)) for x in arrays["path_limits"])
    scale = mp.mpf(float(arrays["path_scale_mm"]))
    e = mp.mpf(float(arrays["glide_softness_mm"]))
    four = mp.mpf(4)
    t = (low + _softplus(d1 - low, four) - _softplus(d1 - high, four)) / scale
    a = mp.sqrt(d2**2 + e**2) - e
    b = _softplus(d3, e) - _softplus(mp.mpf(0), e)
    features = [a, a * t, a * t**2, d2, d2 * t, d2**2 / 10, d2**2 * t / 10]
    rho = _dot(arrays["glide_arch"], features)
    bent = [mp.mpf("0.15") * x**2 / mp.sqrt(1 + x**2 / 16) for x in (a, b)]
    drop = _dot(arrays["glide_drop"], [a, b, *bent])
    one = mp.mpf(1)
    fade = mp.exp(-(((_softplus(d1, one) - _softplus(mp.mpf(0), one)) / mp.mpf(float(arrays["glide_fade_mm"]))) ** 2))
    gx, gz = (path(arrays, row, d1) for row in (0, 1))
    return [gx + d2, -(d1 + drop * fade), gz + rho + d3]


def path(arrays, row, s):
    """gx (row 0) or gz (row 1) at opening s, straight beyond the limits."""
    low, high = (mp.mpf(float(x)) for x in arrays["path_limits"])
    scale = mp.mpf(float(arrays["path_scale_mm"]))
    inside = min(max(s, low), high)
    c = [mp.mpf(float(x)) for x in arrays["path_coefficients"][row]]
    value = sum(c[k - 1] * (inside / scale) ** k for k in range(1, 6))
    slope = sum(k * c[k - 1] * (inside / scale) ** (k - 1) for k in range(1, 6)) / scale
    return value + slope * (s - inside)


def motion(arrays, d):
    """M(d) of either kind of model, 4x4."""
    if "spline_weights" not in arrays:
        return exp_se3(additive_log(arrays, d))
    u = gauge(arrays, d)
    omega = rotation_vector(arrays, u)
    R = exp_so3(omega)
    p = [mp.mpf(float(x)) for x in arrays["incisor"]]
    M = mp.eye(4)
    for i in range(3):
        for j in range(3):
            M[i, j] = R[i, j]
        M[i, 3] = u[i] + p[i] - sum(R[i, j] * p[j] for j in range(3))
    return M


def rotation_vector(arrays, u):
    """f(u) of an anchored model."""
    shear = [-u[1], u[0] - path(arrays, 0, -u[1]), u[2] - path(arrays, 1, -u[1])]
    q = [x / mp.mpf(float(s)) for x, s in zip(shear, arrays["spline_scales"])]
    at_q, at_rest = _features(arrays, q), _features(arrays, [mp.mpf(0)] * 3)
    change = [x - y for x, y in zip(at_q, at_rest)]
    return [_dot(arrays["spline_weights"][:, k], change) for k in range(3)]


def additive_log(arrays, d):
    """log M(d) of an additive model."""
    total = [mp.mpf(0)] * 6
    for i, x in enumerate(d, start=1):
        knots, twists, slopes = (arrays[f"curve{i}_{part}"] for part in ("knots", "twists", "slopes"))
        total = [a + b for a, b in zip(total, hermite(knots, twists, slopes, x))]
    return total


def hermite(knots, values, slopes, x):
    """Cubic Hermite interpolation by its four basis polynomials, straight outside the knots."""
    if x <= knots[0] or x >= knots[-1]:
        end = 0 if x <= knots[0] else -1
        beyond = x - mp.mpf(float(knots[end]))
        return [mp.mpf(float(v)) + mp.mpf(float(m)) * beyond for v, m in zip(values[end], slopes[end])]
    i = max(k for k in range(len(knots)) if knots[k] <= x)
    start, h = mp.mpf(float(knots[i])), mp.mpf(float(knots[i + 1])) - mp.mpf(float(knots[i]))
    s = (x - start) / h
    basis = [2 * s**3 - 3 * s**2 + 1, (s**3 - 2 * s**2 + s) * h, -2 * s**3 + 3 * s**2, (s**3 - s**2) * h]
    rows = [values[i], slopes[i], values[i + 1], slopes[i + 1]]
    return [sum(b * mp.mpf(float(row[k])) for b, row in zip(basis, rows)) for k in range(len(values[0]))]


def exp_so3(w):
    """Rotation matrix of a rotation vector, by the matrix exponential's own series."""
    K = mp.matrix([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    return mp.expm(K, method="taylor")


def exp_se3(twist):
    """Rigid motion of a twist (omega, v), by the matrix exponential's own series."""
    w, v = twist[:3], twist[3:]
    rows = [[0, -w[2], w[1], v[0]], [w[2], 0, -w[0], v[1]], [-w[1], w[0], 0, v[2]], [0, 0, 0, 0]]
    return mp.expm(mp.matrix(rows), method="taylor")


def pose(arrays, d):
    """pose(d) = A^-1 M(d) A rest."""
    A, rest = (mp.matrix(arrays[name].tolist()) for name in ("T_anatomical_skull", "T_rest"))
    return mp.inverse(A) * motion(arrays, [mp.mpf(float(x)) for x in d]) * A * rest


def derivative(function, d):
    """Central differences of a list-valued function of d at 20 digits' distance: one list per parameter."""
    d = [mp.mpf(float(x)) for x in d]
    columns = []
    for i in range(len(d)):
        ahead, behind = list(d), list(d)
        ahead[i] += _STEP
        behind[i] -= _STEP
        columns.append([(a - b) / (2 * _STEP) for a, b in zip(function(ahead), function(behind))])
    return columns


def _features(arrays, q):
    centres = arrays["spline_centres"]
    cubes = [mp.sqrt(sum((q[k] - mp.mpf(float(c[k]))) ** 2 for k in range(3))) ** 3 for c in centres]
    return [*cubes, *q]


def _softplus(x, e):
    return (x + mp.sqrt(x**2 + e**2)) / 2


def _dot(weights, features):
    return sum(mp.mpf(float(w)) * x for w, x in zip(weights, features))
