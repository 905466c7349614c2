// Posing a rig by sliders and by dragging: the sampled decoder of the rig, drawn by scene.js.
(() => {
  const box = document.getElementById("jaw");
  const data = JSON.parse(document.getElementById("jaw-data").textContent);
  const find = (name) => box.querySelector(`[data-jaw="${name}"]`);
  const canvas = find("canvas"), section = find("section"), play = find("play");
  const sliders = ["d1", "d2", "d3"].map(find);
  const scene = makeScene(canvas, data);
  if (!scene) {
    find("message").textContent = "This browser has no WebGL 2: the jaw cannot be shown.";
    canvas.hidden = true;
  }

  // -- decoder: twists (3 rad, 3 mm) and margin [mm] on a grid, interpolated linearly ---------------------------------
  const WIDTH = 7;
  const axes = data.axes, counts = axes.map((axis) => axis.length);
  const table = new Float32Array(bytesOf(data.table));
  const clip = new Float32Array(bytesOf(data.clip));
  const within = (x, low, high) => Math.min(Math.max(x, low), high);
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
  const moved = (m, p) => [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
  const rested = (m, p) => { // the inverse of `moved`
    const q = [p[0] - m[12], p[1] - m[13], p[2] - m[14]];
    return [0, 1, 2].map((c) => m[4 * c] * q[0] + m[4 * c + 1] * q[1] + m[4 * c + 2] * q[2]);
  };
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

  // -- staying inside the bound --------------------------------------------------------------------------------------
  const STEP = 0.05; // of numerical derivatives [mm]
  const boxed = (d) => d.map((x, i) => within(x, axes[i][0], axes[i][counts[i] - 1]));
  const gradient = (f, d) => [0, 1, 2].map((i) => {
    const [above, below] = [[...d], [...d]];
    above[i] += STEP;
    below[i] -= STEP;
    const [high, low] = [f(above), f(below)];
    return Array.isArray(high) ? high.map((x, k) => (x - low[k]) / (2 * STEP)) : (high - low) / (2 * STEP);
  });
  // Return the parameters moved inside the bound: to the nearest point by Newton steps, or else towards d1 alone.
  const inside = (wanted) => {
    let d = boxed(wanted);
    for (let k = 0; k < 10 && margin(d) < 0; k++) {
      const g = gradient(margin, d), size = dot(g, g);
      if (size < 1e-6) break;
      d = boxed(d.map((x, i) => x + ((0.01 - margin(d)) * g[i]) / size));
    }
    for (let share = 0.9; share >= -0.01 && margin(d) < 0; share -= 0.1) d = boxed([d[0], d[1] * share, d[2] * share]);
    return margin(d) < 0 ? now : d;
  };

  // -- dragging: the grabbed point follows the pointer; depth, which the pointer does not give, follows the habitual ----
  // -- path, on which d2 = d3 = 0 ------------------------------------------------------------------------------------
  const solve3 = (A, b) => {
    const det = (m) => dot(m[0], cross(m[1], m[2]));
    const whole = det(A);
    return [0, 1, 2].map((j) => det(A.map((row, i) => row.map((x, k) => (k === j ? b[i] : x)))) / whole);
  };
  const drag = (start, point, target, right, up, sight) => {
    const residual = (d) => {
      const off = minus(moved(motion(d), point), target);
      return [dot(right, off), dot(up, off), sight[0] * d[1] + sight[2] * d[2]];
    };
    let d = [...start];
    for (let k = 0; k < 12; k++) {
      const r = residual(d), columns = gradient(residual, d);
      const normal = columns.map((a, i) => columns.map((b, j) => dot(a, b) + (i === j ? 1e-3 : 0)));
      const step = solve3(normal, columns.map((a) => -dot(a, r)));
      const size = Math.hypot(...step);
      d = boxed(d.map((x, i) => x + step[i] * Math.min(1, 5 / size)));
      if (size < 1e-3) break;
    }
    return inside(d);
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
  // Return the distance along a ray to the nearest of the parts chosen by `moves`, Infinity if it misses (Moeller and
  // Trumbore, "Fast, minimum storage ray/triangle intersection", 1997).
  const hit = (eye, along, moves) => {
    let best = Infinity;
    for (const { vertices: v, faces: f, ...part } of scene.parts) {
      if (part.moves !== moves || part.name === "skull") continue;
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
  const grab = (event) => {
    const { eye, along } = ray(event), m = motion(now);
    const direction = [0, 1, 2].map((c) => m[4 * c] * along[0] + m[4 * c + 1] * along[1] + m[4 * c + 2] * along[2]);
    const local = rested(m, eye), far = hit(local, direction, true);
    if (!Number.isFinite(far) || far > hit(eye, along, false)) return null;
    return direction.map((x, i) => local[i] + far * x);
  };

  // -- the section of the bound at the current opening ---------------------------------------------------------------
  const CELLS = 48;
  const drawSection = () => {
    const pen = section.getContext("2d"), style = getComputedStyle(document.documentElement);
    const [low2, high2] = [axes[1][0], axes[1][counts[1] - 1]], [low3, high3] = [axes[2][0], axes[2][counts[2] - 1]];
    const [w, h] = [section.width, section.height];
    pen.clearRect(0, 0, w, h);
    pen.fillStyle = style.getPropertyValue("--green");
    const step = (high2 - low2) / CELLS;
    for (let i = 0; i < CELLS; i++)
      for (let j = 0; j < CELLS; j++) {
        const d = [now[0], low2 + ((i + 0.5) / CELLS) * (high2 - low2), high3 - ((j + 0.5) / CELLS) * (high3 - low3)];
        pen.globalAlpha = 0.4 * within(margin(d) / step + 0.5, 0, 1);
        if (pen.globalAlpha > 0) pen.fillRect((i * w) / CELLS, (j * h) / CELLS, w / CELLS, h / CELLS);
      }
    pen.globalAlpha = 1;
    pen.fillStyle = style.getPropertyValue("--vermilion");
    pen.beginPath();
    pen.arc(((now[1] - low2) / (high2 - low2)) * w, ((high3 - now[2]) / (high3 - low3)) * h, 5, 0, 2 * Math.PI);
    pen.fill();
  };

  // -- controls ------------------------------------------------------------------------------------------------------
  let now = [0, 0, 0], running = false, started = 0, held = null;
  const draw = () => {
    const m = motion(now);
    scene?.draw(new Float32Array(m), []);
    drawSection();
    box.dataset.d = JSON.stringify(now);
    box.dataset.motion = JSON.stringify(m);
  };
  const show = (d) => {
    now = d;
    const mm = (value) => (Math.round(value * 10) / 10 || 0).toFixed(1);
    sliders.forEach((slider, i) => {
      slider.value = now[i];
      find(`${slider.dataset.jaw}-mm`).textContent = `${mm(now[i])} mm`;
    });
    find("margin").textContent = `${mm(Math.max(margin(now), 0))} mm inside the bound`;
    draw();
  };
  const frames = clip.length / 3;
  const tick = (time) => {
    if (!running) return;
    const frame = 3 * (Math.floor(((time - started) / 1000) * data.fps) % frames);
    show([...clip.subarray(frame, frame + 3)]);
    requestAnimationFrame(tick);
  };
  const setRunning = (value) => {
    running = value && frames > 0;
    play.textContent = running ? "Pause" : "Play the take";
    if (running) {
      started = performance.now();
      requestAnimationFrame(tick);
    }
  };
  play.hidden = frames === 0;
  play.addEventListener("click", () => setRunning(!running));
  sliders.forEach((slider, i) => {
    [slider.min, slider.max] = [axes[i][0], axes[i][counts[i] - 1]];
    slider.addEventListener("input", () => {
      setRunning(false);
      show(inside(now.map((x, k) => (k === i ? Number(slider.value) : x))));
    });
  });
  find("close").addEventListener("click", () => {
    setRunning(false);
    show([0, 0, 0]);
  });
  connectView(box, canvas, scene, draw);
  canvas.addEventListener("pointerdown", (event) => {
    setRunning(false);
    held = { at: [event.clientX, event.clientY], point: grab(event), start: now };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) {
      canvas.style.cursor = !running && event.pointerType === "mouse" && grab(event) ? "move" : "grab";
      return;
    }
    if (!held.point) {
      scene.orbit(event.clientX - held.at[0], event.clientY - held.at[1]);
      held.at = [event.clientX, event.clientY];
      draw();
      return;
    }
    const { eye, along, right, up, sight } = ray(event), place = moved(motion(now), held.point);
    const far = dot(sight, minus(place, eye)) / dot(sight, along);
    show(drag(now, held.point, along.map((x, i) => eye[i] + far * x), right, up, sight));
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (held = null));
  scene?.look("front");
  show([0, 0, 0]);
  setRunning(!matchMedia("(prefers-reduced-motion: reduce)").matches);
})();
