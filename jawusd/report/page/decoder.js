// The sampled decoder of a rig: motions of the jaw and the margin to the bound at jaw parameters d [mm].
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
// Return a point moved by a column-major 4 x 4 motion, and the inverse.
const moved = (m, p) => [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
const rested = (m, p) => {
  const q = [p[0] - m[12], p[1] - m[13], p[2] - m[14]];
  return [0, 1, 2].map((c) => m[4 * c] * q[0] + m[4 * c + 1] * q[1] + m[4 * c + 2] * q[2]);
};

const STEP = 0.05; // of numerical derivatives [mm]
const gradient = (f, d) => [0, 1, 2].map((i) => {
  const [above, below] = [[...d], [...d]];
  above[i] += STEP;
  below[i] -= STEP;
  const [high, low] = [f(above), f(below)];
  return Array.isArray(high) ? high.map((x, k) => (x - low[k]) / (2 * STEP)) : (high - low) / (2 * STEP);
});

// `data` has axes and a table of twists (3 rad, 3 mm) and margins [mm] on their grid, interpolated linearly.
const makeDecoder = (data) => {
  const WIDTH = 7;
  const axes = data.axes, counts = axes.map((axis) => axis.length);
  const table = new Float32Array(bytesOf(data.table));
  const locate = (axis, x) => {
    let low = 0, high = axis.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (axis[middle] <= x) low = middle; else high = middle;
    }
    return [low, within((x - axis[low]) / (axis[low + 1] - axis[low]), 0, 1)];
  };
  const sample = (d) => {
    const cells = axes.map((axis, i) => locate(axis, d[i]));
    const out = new Array(WIDTH).fill(0);
    for (let corner = 0; corner < 8; corner++) {
      let weight = 1, row = 0;
      for (let i = 0; i < 3; i++) {
        const up = (corner >> i) & 1;
        weight *= up ? cells[i][1] : 1 - cells[i][1];
        row = row * counts[i] + cells[i][0] + up;
      }
      for (let k = 0; k < WIDTH; k++) out[k] += weight * table[WIDTH * row + k];
    }
    return out;
  };
  const margin = (d) => sample(d)[6];
  // Return the motion, column-major, by the exponential map of SE(3).
  const motion = (d) => {
    const [wx, wy, wz, vx, vy, vz] = sample(d);
    const square = wx * wx + wy * wy + wz * wz, angle = Math.sqrt(square);
    const a = angle > 1e-6 ? Math.sin(angle) / angle : 1 - square / 6;
    const b = angle > 1e-6 ? (1 - Math.cos(angle)) / square : 0.5 - square / 24;
    const c = angle > 1e-6 ? (1 - a) / square : 1 / 6 - square / 120;
    const W = [[0, -wz, wy], [wz, 0, -wx], [-wy, wx, 0]];
    const WW = W.map((row) => [0, 1, 2].map((j) => row[0] * W[0][j] + row[1] * W[1][j] + row[2] * W[2][j]));
    const combined = (f, g) => [0, 1, 2].map((i) => [0, 1, 2].map((j) => (i === j) + f * W[i][j] + g * WW[i][j]));
    const R = combined(a, b), V = combined(b, c);
    const t = V.map((row) => row[0] * vx + row[1] * vy + row[2] * vz);
    return [R[0][0], R[1][0], R[2][0], 0, R[0][1], R[1][1], R[2][1], 0, R[0][2], R[1][2], R[2][2], 0, ...t, 1];
  };
  const boxed = (d) => d.map((x, i) => within(x, axes[i][0], axes[i][counts[i] - 1]));
  // Return the parameters moved inside the bound: to the nearest point by Newton steps, or else towards d1 alone;
  // `fallback` if both fail.
  const inside = (wanted, fallback) => {
    let d = boxed(wanted);
    for (let k = 0; k < 10 && margin(d) < 0; k++) {
      const g = gradient(margin, d), size = dot(g, g);
      if (size < 1e-6) break;
      d = boxed(d.map((x, i) => x + ((0.01 - margin(d)) * g[i]) / size));
    }
    for (let share = 0.9; share >= -0.01 && margin(d) < 0; share -= 0.1) d = boxed([d[0], d[1] * share, d[2] * share]);
    return margin(d) < 0 ? fallback : d;
  };
  const box = axes.map((axis, i) => [axis[0], axis[counts[i] - 1]]);
  return { box, margin, motion, boxed, inside };
};
