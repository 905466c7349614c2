"use strict";
// Folded parts open when a link leads to them, and for printing.
(() => {
  const open = () => {
    const part = location.hash.length > 1 && document.getElementById(location.hash.slice(1));
    if (part && part.tagName === "DETAILS") {
      part.open = true;
      part.scrollIntoView();
    }
  };
  addEventListener("hashchange", open);
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => { part.open = true; }));
  open();
})();

// Replay of the captured take, drawn by scene.js.
(() => {
  const box = document.getElementById("replay");
  if (!box) return;
  const data = JSON.parse(document.getElementById("replay-data").textContent);
  const find = (name) => box.querySelector(`[data-replay="${name}"]`);
  const canvas = find("canvas"), play = find("play"), source = find("source");

  const captured = new Float32Array(bytesOf(data.captured)), fitted = new Float32Array(bytesOf(data.fitted));
  const d = new Float32Array(bytesOf(data.d)), frames = new Int32Array(bytesOf(data.frames));
  const state = new Uint8Array(bytesOf(data.state));
  const margin = new Float32Array(bytesOf(data.margin)); // to the bound [mm]
  const count = frames.length;
  let now = 0, running = false;

  const scene = makeScene(canvas, data);
  if (!scene) {
    find("message").textContent = "This browser has no WebGL 2: the replay cannot be shown.";
    canvas.hidden = true;
  }

  const rigid = (poses, k) => { // rows of a 3 x 4 matrix
    const p = poses.subarray(12 * k, 12 * k + 12);
    return new Float32Array([p[0], p[4], p[8], 0, p[1], p[5], p[9], 0, p[2], p[6], p[10], 0, p[3], p[7], p[11], 1]);
  };
  const known = (poses, k) => Number.isFinite(poses[12 * k]);
  const moved = (poses, k, p) => {
    const m = rigid(poses, k);
    return [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
  };

  const trace = (poses, point) => { // path of a landmark over the last second
    const places = [];
    for (let k = Math.max(0, now - Math.round(data.fps)); k <= now; k++)
      if (known(poses, k)) places.push(...moved(poses, k, point));
    return places;
  };
  const draw = () => {
    if (!scene) return;
    const poses = source.value === "fitted" ? fitted : captured;
    scene.draw(known(poses, now) ? rigid(poses, now) : null, data.traced.map((point) => trace(poses, point)));
  };

  // -- timeline ------------------------------------------------------------------------------------------------------
  const nearest = (frame) => {
    const next = frames.findIndex((each) => each >= frame);
    if (next <= 0) return next < 0 ? count - 1 : 0;
    return frames[next] - frame <= frame - frames[next - 1] ? next : next - 1;
  };
  const motion = {
    span: () => [frames[0], Math.max(frames[count - 1], frames[0] + 1)],
    at: (frame) => {
      const next = frames.findIndex((each) => each >= frame), k = next < 0 ? count - 1 : next, before = Math.max(k - 1, 0);
      const t = within((frame - frames[before]) / (frames[k] - frames[before] || 1), 0, 1);
      return [0, 1, 2].map((i) => d[3 * before + i] + t * (d[3 * k + i] - d[3 * before + i]));
    },
    grade: (frame) => {
      const k = nearest(frame), out = -margin[k];
      if (data.states[state[k]] === "lost") return null;
      return out <= 0 ? 0 : out <= data.tolerance ? 1 : 2;
    },
    step: count > 1 ? frames[1] - frames[0] : 1,
  };
  const timeline = makeTimeline(find("timeline"), motion, {
    seek: (frame) => {
      setRunning(false);
      show(nearest(frame));
    },
  });

  // -- controls ------------------------------------------------------------------------------------------------------
  const show = (index) => {
    now = Math.min(Math.max(Math.round(index), 0), count - 1);
    timeline.show(frames[now]);
    const values = [0, 1, 2].map((i) => d[3 * now + i]);
    const mm = (value) => (Number.isFinite(value) ? (Math.round(value * 10) / 10 || 0).toFixed(1) : "\u2013");
    find("d").textContent = values.map((value, i) => `d${i + 1} ${mm(value)}`).join("   ") + "   mm";
    find("frame").textContent = `frame ${frames[now]}, ${data.states[state[now]]}`;
    draw();
  };
  let started = 0, from = 0;
  const step = (time) => {
    if (!running) return;
    show((from + ((time - started) / 1000) * data.fps) % count);
    requestAnimationFrame(step);
  };
  const setRunning = (value) => {
    running = value;
    play.textContent = value ? "Pause" : "Play";
    if (value) {
      [started, from] = [performance.now(), now];
      requestAnimationFrame(step);
    }
  };
  play.addEventListener("click", () => setRunning(!running));
  source.addEventListener("change", draw);
  connectView(box, canvas, scene, draw);
  connectParts(box, scene, draw);
  let held = null;
  canvas.addEventListener("pointerdown", (event) => {
    held = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    scene?.orbit(event.clientX - held[0], event.clientY - held[1]);
    held = [event.clientX, event.clientY];
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (held = null));
  for (const button of document.querySelectorAll("[data-frame]"))
    button.addEventListener("click", () => {
      const index = frames.indexOf(Number(button.dataset.frame));
      if (index < 0) return;
      setRunning(false);
      show(index);
      box.scrollIntoView({ behavior: "smooth", block: "center" });
    });
  timeline.redraw();
  show(0);
})();
