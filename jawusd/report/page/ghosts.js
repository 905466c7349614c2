// The captured poses nearest to a pose, which scene.js draws faintly. `data` has rows of d1, d2 and d3 [mm] and their
// number and least distance in d.
const makeGhosts = ({ captured, count, apart }) => {
  const all = new Float32Array(bytesOf(captured));
  const far = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
  return (d) => {
    const rows = Array.from({ length: all.length / 3 }, (_, k) => Array.from(all.subarray(3 * k, 3 * k + 3)));
    rows.sort((a, b) => far(a, d) - far(b, d));
    const found = [];
    for (const row of rows)
      if (found.length < count && found.every((other) => far(row, other) >= apart)) found.push(row);
    return found;
  };
};
