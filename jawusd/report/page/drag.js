// Dragging the jaw: the grabbed point follows the pointer. Depth, which the pointer does not give, follows the habitual
// path, on which d2 = d3 = 0.
const makeDragging = (decoder, scene, canvas) => {
  const solve3 = (A, b) => {
    const det = (m) => dot(m[0], cross(m[1], m[2]));
    const whole = det(A);
    return [0, 1, 2].map((j) => det(A.map((row, i) => row.map((x, k) => (k === j ? b[i] : x)))) / whole);
  };
  const nearest = (start, point, target, right, up, sight) => {
    const residual = (d) => {
      const off = minus(moved(decoder.motion(d), point), target);
      return [dot(right, off), dot(up, off), sight[0] * d[1] + sight[2] * d[2]];
    };
    let d = [...start];
    for (let k = 0; k < 12; k++) {
      const r = residual(d), columns = gradient(residual, d);
      const normal = columns.map((a, i) => columns.map((b, j) => dot(a, b) + (i === j ? 1e-3 : 0)));
      const step = solve3(normal, columns.map((a) => -dot(a, r)));
      const size = Math.hypot(...step);
      d = decoder.boxed(d.map((x, i) => x + step[i] * Math.min(1, 5 / size)));
      if (size < 1e-3) break;
    }
    return decoder.inside(d, start);
  };
  // Return the ray of the pointer: origin, direction, and the axes of the camera, anatomical frame.
  const ray = (event) => {
    const rect = canvas.getBoundingClientRect(), { view, lens } = scene.camera();
    const x = (2 * (event.clientX - rect.left)) / rect.width - 1, y = 1 - (2 * (event.clientY - rect.top)) / rect.height;
    const axis = (r) => [view[r], view[4 + r], view[8 + r]];
    const [right, up, back] = [axis(0), axis(1), axis(2)];
    const eye = [0, 1, 2].map((i) => -(view[12] * right[i] + view[13] * up[i] + view[14] * back[i]));
    const along = [0, 1, 2].map((i) => (x / lens[0]) * right[i] + (y / lens[5]) * up[i] - back[i]);
    return { eye, along, right, up, sight: back };
  };
  // Return the distance along a ray to the nearest of the visible parts chosen by `moves`, Infinity if it misses
  // (Moeller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997).
  const hit = (eye, along, moves) => {
    let best = Infinity;
    for (const { vertices: v, faces: f, ...part } of scene.parts) {
      if (part.moves !== moves || part.hidden || part.name === "skull") continue;
      for (let i = 0; i < f.length; i += 3) {
        const corner = (k) => [v[3 * f[i + k]], v[3 * f[i + k] + 1], v[3 * f[i + k] + 2]];
        const a = corner(0), e = minus(corner(1), a), g = minus(corner(2), a), p = cross(along, g), area = dot(e, p);
        if (Math.abs(area) < 1e-9) continue;
        const s = minus(eye, a), u = dot(s, p) / area;
        if (u < 0 || u > 1) continue;
        const q = cross(s, e), w = dot(along, q) / area;
        if (w < 0 || u + w > 1) continue;
        const far = dot(g, q) / area;
        if (far > 0 && far < best) best = far;
      }
    }
    return best;
  };
  // Return the point of the jaw under the pointer at parameters d, in its place in occlusion; null if there is none.
  const grab = (event, d) => {
    const { eye, along } = ray(event), m = decoder.motion(d);
    const direction = [0, 1, 2].map((c) => m[4 * c] * along[0] + m[4 * c + 1] * along[1] + m[4 * c + 2] * along[2]);
    const local = rested(m, eye), far = hit(local, direction, true);
    if (!Number.isFinite(far) || far > hit(eye, along, false)) return null;
    return direction.map((x, i) => local[i] + far * x);
  };
  // Return the parameters, inside the bound, at which a point that `grab` returned lies under the pointer.
  const pull = (event, d, point) => {
    const { eye, along, right, up, sight } = ray(event), place = moved(decoder.motion(d), point);
    const far = dot(sight, minus(place, eye)) / dot(sight, along);
    return nearest(d, point, along.map((x, i) => eye[i] + far * x), right, up, sight);
  };
  return { grab, pull };
};
