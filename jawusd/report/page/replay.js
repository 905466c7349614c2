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

// Replay of the captured take in plain WebGL2, without external resources. Coordinates are mm in the anatomical frame.
(() => {
  const box = document.getElementById("replay");
  if (!box) return;
  const data = JSON.parse(document.getElementById("replay-data").textContent);
  const find = (name) => box.querySelector(`[data-replay="${name}"]`);
  const canvas = find("canvas"), slider = find("slider"), play = find("play"), source = find("source");

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const captured = new Float32Array(bytes(data.captured)), fitted = new Float32Array(bytes(data.fitted));
  const d = new Float32Array(bytes(data.d)), frames = new Int32Array(bytes(data.frames));
  const state = new Uint8Array(bytes(data.state));
  const count = frames.length;

  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) {
    find("message").textContent = "This browser has no WebGL 2: the replay cannot be shown.";
    canvas.hidden = true;
  }

  // -- matrices, column-major as in WebGL --------------------------------------------------------------
  const multiply = (a, b) => {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++)
      for (let r = 0; r < 4; r++)
        for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    return out;
  };
  const identity = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
  const rigid = (poses, k) => { // rows of a 3 x 4 matrix
    const p = poses.subarray(12 * k, 12 * k + 12);
    return new Float32Array([p[0], p[4], p[8], 0, p[1], p[5], p[9], 0, p[2], p[6], p[10], 0, p[3], p[7], p[11], 1]);
  };
  const known = (poses, k) => Number.isFinite(poses[12 * k]);
  const moved = (poses, k, p) => {
    const m = rigid(poses, k);
    return [0, 1, 2].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
  };

  // -- meshes --------------------------------------------------------------------------------------------------------
  const unpack = (part) => {
    const packed = new Uint16Array(bytes(part.vertices)), faces = new Uint16Array(bytes(part.faces));
    const vertices = new Float32Array(packed.length), normals = new Float32Array(packed.length);
    for (let i = 0; i < packed.length; i++) vertices[i] = part.low[i % 3] + packed[i] * part.step;
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const e = [0, 1, 2].map((i) => vertices[b + i] - vertices[a + i]);
      const g = [0, 1, 2].map((i) => vertices[c + i] - vertices[a + i]);
      const n = [e[1] * g[2] - e[2] * g[1], e[2] * g[0] - e[0] * g[2], e[0] * g[1] - e[1] * g[0]];
      for (const corner of [a, b, c]) for (let i = 0; i < 3; i++) normals[corner + i] += n[i];
    }
    return { ...part, vertices, normals, faces };
  };
  const parts = data.parts.map(unpack);
  const colors = { bone: [0.84, 0.8, 0.72], tooth: [0.95, 0.94, 0.9], gum: [0.82, 0.5, 0.5] };

  // -- camera --------------------------------------------------------------------------------------------------------
  const centre = data.centre;
  let turn = 0.6, tilt = 0.15, away = data.radius * 2.6, now = 0, running = false;
  const views = { front: [0, 0.05], left: [Math.PI / 2, 0.05], right: [-Math.PI / 2, 0.05], top: [0, 1.5] };
  const camera = (aspect) => {
    const [cy, sy, cx, sx] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    // x points to the subject's left, which is right in a front view
    const view = new Float32Array([cy, -sx * sy, cx * sy, 0, 0, cx, sx, 0, -sy, -sx * cy, cx * cy, 0, 0, 0, -away, 1]);
    for (let r = 0; r < 3; r++)
      view[12 + r] -= view[r] * centre[0] + view[4 + r] * centre[1] + view[8 + r] * centre[2];
    const f = 3.2, near = away / 20, far = away * 4;
    const lens = new Float32Array([
      f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
    ]);
    return { view, both: multiply(lens, view), lens };
  };

  // -- drawing -------------------------------------------------------------------------------------------------------
  // Depth offset of bone that nearly coincides with a scan, as roots and sockets do [mm].
  const BEHIND = { bone: 1.5, tooth: 0, gum: 0 };
  const vertexShader = `#version 300 es
    in vec3 place; in vec3 normal; uniform mat4 all, body, view; uniform float behind, slope; out vec3 n;
    void main() {
      n = mat3(view) * mat3(body) * normal;
      vec4 seen = all * body * vec4(place, 1.0);
      gl_Position = vec4(seen.xy, seen.w * (seen.z - slope * behind) / (seen.w + behind), seen.w);
    }`;
  const fragmentShader = `#version 300 es
    precision highp float; in vec3 n; uniform vec4 color; uniform float lit; out vec4 shown;
    void main() {
      float light = lit > 0.5 ? 0.35 + 0.65 * abs(normalize(n).z) : 1.0;
      shown = vec4(color.rgb * light * color.a, color.a);
    }`;
  let at = null;
  const setUp = () => {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertexShader], [gl.FRAGMENT_SHADER, fragmentShader]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "place");
    gl.bindAttribLocation(program, 1, "normal");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    at = {};
    for (const name of ["all", "body", "view", "color", "lit", "behind", "slope"]) at[name] = gl.getUniformLocation(program, name);
    for (const part of parts) {
      part.array = gl.createVertexArray();
      gl.bindVertexArray(part.array);
      [part.vertices, part.normals].forEach((values, slot) => {
        gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
        gl.enableVertexAttribArray(slot);
        gl.vertexAttribPointer(slot, 3, gl.FLOAT, false, 0, 0);
      });
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, part.faces, gl.STATIC_DRAW);
    }
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  };
  let traceArray = null, traceBuffer = null;
  const drawTrace = (poses, point, color) => { // path of a landmark over the last second
    const places = [];
    for (let k = Math.max(0, now - Math.round(data.fps)); k <= now; k++)
      if (known(poses, k)) places.push(...moved(poses, k, point));
    if (!traceArray) {
      traceArray = gl.createVertexArray();
      traceBuffer = gl.createBuffer();
    }
    gl.bindVertexArray(traceArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, traceBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(places), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.uniformMatrix4fv(at.body, false, identity);
    gl.uniform1f(at.lit, 0);
    gl.uniform1f(at.behind, 0);
    gl.uniform4f(at.color, ...color, 1);
    gl.drawArrays(gl.LINE_STRIP, 0, places.length / 3);
    gl.uniform1f(at.lit, 1);
  };
  const draw = () => {
    if (!gl) return;
    const width = Math.round(canvas.clientWidth * devicePixelRatio);
    const height = Math.round(canvas.clientHeight * devicePixelRatio);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const poses = source.value === "fitted" ? fitted : captured;
    const { view, both, lens } = camera(width / Math.max(height, 1));
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at.all, false, both);
    gl.uniformMatrix4fv(at.view, false, view);
    gl.uniform1f(at.lit, 1);
    gl.uniform1f(at.slope, lens[10]);
    const body = known(poses, now) ? rigid(poses, now) : null;
    for (const glassy of [false, true]) { // the translucent skull is drawn last
      for (const part of parts) {
        if ((part.name === "skull") !== glassy || (part.moves && !body)) continue;
        gl.uniformMatrix4fv(at.body, false, part.moves ? body : identity);
        gl.uniform4f(at.color, ...colors[part.kind], glassy ? 0.3 : 1);
        gl.uniform1f(at.behind, BEHIND[part.kind]);
        gl.depthMask(!glassy);
        gl.bindVertexArray(part.array);
        gl.drawElements(gl.TRIANGLES, part.faces.length, gl.UNSIGNED_SHORT, 0);
      }
      if (!glassy) data.traced.forEach((point) => drawTrace(poses, point, [0.84, 0.37, 0]));
    }
    gl.depthMask(true);
  };

  // -- controls ------------------------------------------------------------------------------------------------------
  const show = (index) => {
    now = Math.min(Math.max(Math.round(index), 0), count - 1);
    slider.value = now;
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
  slider.max = count - 1;
  slider.addEventListener("input", () => {
    setRunning(false);
    show(Number(slider.value));
  });
  source.addEventListener("change", draw);
  for (const button of box.querySelectorAll("[data-view]"))
    button.addEventListener("click", () => {
      [turn, tilt] = views[button.dataset.view];
      draw();
    });
  let held = null;
  canvas.addEventListener("pointerdown", (event) => {
    held = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    turn -= (event.clientX - held[0]) / 150;
    tilt = Math.min(Math.max(tilt + (event.clientY - held[1]) / 150, -1.55), 1.55);
    held = [event.clientX, event.clientY];
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (held = null));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    away = Math.min(Math.max(away * Math.exp(event.deltaY / 600), data.radius), data.radius * 10);
    draw();
  }, { passive: false });
  for (const button of document.querySelectorAll("[data-frame]"))
    button.addEventListener("click", () => {
      const index = frames.indexOf(Number(button.dataset.frame));
      if (index < 0) return;
      setRunning(false);
      show(index);
      box.scrollIntoView({ behavior: "smooth", block: "center" });
    });
  addEventListener("resize", draw);
  if (gl) setUp();
  show(0);
})();
