"use strict";
// A jaw in plain WebGL2, without external resources. Coordinates are mm in the anatomical frame.
const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const within = (x, low, high) => Math.min(Math.max(x, low), high);

// Return a scene drawn on a canvas. `data` has parts, centre and radius; `draw(body, lines)` draws the moving parts at a
// column-major 4 x 4 motion (null hides them) and polylines, flat arrays of x, y, z. A part with `hidden` is not drawn.
// `ghosts`, optional, are further motions at which the moving teeth and bone are drawn faintly.
const makeScene = (canvas, data) => {
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) return null;
  // -- matrices, column-major as in WebGL --------------------------------------------------------------
  const multiply = (a, b) => {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++)
      for (let r = 0; r < 4; r++)
        for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    return out;
  };
  const identity = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);

  // -- meshes --------------------------------------------------------------------------------------------------------
  const unpack = (part) => {
    const packed = new Uint16Array(bytesOf(part.vertices)), faces = new Uint16Array(bytesOf(part.faces));
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
  let turn = 0.6, tilt = 0.15, away = data.radius * 2.6;
  const views = { front: [0, 0.05], left: [Math.PI / 2, 0.05], right: [-Math.PI / 2, 0.05], top: [0, 1.5], below: [0, -1.5] };
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
    in vec3 place; in vec3 normal; uniform mat4 all, body, view, opposing; uniform float behind, slope;
    out vec3 n, there;
    void main() {
      there = (opposing * vec4(place, 1.0)).xyz;
      n = mat3(view) * mat3(body) * normal;
      vec4 seen = all * body * vec4(place, 1.0);
      gl_Position = vec4(seen.xy, seen.w * (seen.z - slope * behind) / (seen.w + behind), seen.w);
    }`;
  const fragmentShader = `#version 300 es
    precision highp float; precision highp sampler3D;
    in vec3 n, there; uniform vec4 color; uniform float lit; out vec4 shown;
    uniform sampler3D field; uniform vec3 origin, size; uniform vec2 scale; uniform vec4 marks[4]; uniform float painted;
    void main() {
      float light = lit > 0.5 ? 0.35 + 0.65 * abs(normalize(n).z) : 1.0;
      vec3 base = color.rgb, at = (there - origin) / size;
      if (painted > 0.5 && all(greaterThan(at, vec3(0.0))) && all(lessThan(at, vec3(1.0)))) {
        float apart = scale.x + scale.y * texture(field, at.zyx).r;
        for (int k = 3; k >= 0; k--) if (apart < marks[k].a) base = marks[k].rgb;
      }
      shown = vec4(base * light * color.a, color.a);
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
    const UNIFORMS = ["all", "body", "view", "color", "lit", "behind", "slope"];
    const OF_MARKS = ["opposing", "origin", "size", "scale", "marks", "painted", "field"];
    for (const name of [...UNIFORMS, ...OF_MARKS]) at[name] = gl.getUniformLocation(program, name);
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
  const drawLine = (places, color) => {
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
    gl.uniform1f(at.painted, 0);
    gl.uniform1f(at.behind, 0);
    gl.uniform4f(at.color, ...color, 1);
    gl.drawArrays(gl.LINE_STRIP, 0, places.length / 3);
    gl.uniform1f(at.lit, 1);
  };
  // -- contacts: distances to the upper and to the lower arch as textures, painted on the teeth of the other one --------
  let opposed = null;
  const inverse = (m) => {
    const back = (v) => [0, 1, 2].map((c) => m[4 * c] * v[0] + m[4 * c + 1] * v[1] + m[4 * c + 2] * v[2]);
    const t = back([m[12], m[13], m[14]]).map((x) => -x);
    return new Float32Array([m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0, ...t, 1]);
  };
  const paint = (fields, marks) => {
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    opposed = fields.map(({ origin, step, shape: [x, y, z], low, unit, values }, slot) => {
      gl.activeTexture(gl.TEXTURE0 + slot);
      gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
      gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, z, y, x, 0, gl.RED, gl.UNSIGNED_BYTE, values);
      for (const name of ["WRAP_S", "WRAP_T", "WRAP_R"])
        gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${name}`], gl.CLAMP_TO_EDGE);
      for (const name of ["MIN", "MAG"]) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${name}_FILTER`], gl.LINEAR);
      return { origin: origin.map((low) => low - step / 2), size: [x, y, z].map((n) => n * step), scale: [low, 255 * unit] };
    });
    gl.uniform4fv(at.marks, marks.flatMap(([red, green, blue, apart]) => [red / 255, green / 255, blue / 255, apart]));
  };
  const useField = (part, body) => {
    const slot = part.moves ? 0 : 1, field = part.kind === "tooth" && api.painted && body ? opposed?.[slot] : null;
    gl.uniform1f(at.painted, field ? 1 : 0);
    if (!field) return;
    gl.uniform1i(at.field, slot);
    gl.uniformMatrix4fv(at.opposing, false, part.moves ? body : inverse(body));
    gl.uniform3fv(at.origin, field.origin);
    gl.uniform3fv(at.size, field.size);
    gl.uniform2fv(at.scale, field.scale);
  };
  const GHOST = 0.16; // opacity
  const drawPart = (part, body, alpha) => {
    gl.uniformMatrix4fv(at.body, false, part.moves ? body : identity);
    gl.uniform4f(at.color, ...colors[part.kind], alpha);
    gl.uniform1f(at.behind, BEHIND[part.kind]);
    gl.bindVertexArray(part.array);
    gl.drawElements(gl.TRIANGLES, part.faces.length, gl.UNSIGNED_SHORT, 0);
  };
  const drawGhosts = (ghosts) => {
    gl.uniform1f(at.painted, 0);
    gl.depthMask(false);
    for (const ghost of ghosts)
      for (const part of parts) if (part.moves && !part.hidden && part.kind !== "gum") drawPart(part, ghost, GHOST);
  };
  const draw = (body, lines, ghosts = []) => {
    const width = Math.round(canvas.clientWidth * devicePixelRatio);
    const height = Math.round(canvas.clientHeight * devicePixelRatio);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    const { view, both, lens } = camera(width / Math.max(height, 1));
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(at.all, false, both);
    gl.uniformMatrix4fv(at.view, false, view);
    gl.uniform1f(at.lit, 1);
    gl.uniform1f(at.slope, lens[10]);
    for (const glassy of [false, true]) { // the translucent skull is drawn last
      for (const part of parts) {
        if ((part.name === "skull") !== glassy || (part.moves && !body) || part.hidden) continue;
        useField(part, body);
        gl.depthMask(!glassy);
        drawPart(part, body, glassy ? 0.3 : 1);
      }
      if (!glassy) for (const line of lines) drawLine(line, [0.84, 0.37, 0]);
    }
    drawGhosts(ghosts);
    gl.depthMask(true);
  };

  // -- view ----------------------------------------------------------------------------------------------------------
  const look = (name) => { [turn, tilt] = views[name]; };
  const orbit = (dx, dy) => { // movement of the pointer [px]
    turn -= dx / 150;
    tilt = within(tilt + dy / 150, -1.55, 1.55);
  };
  const zoom = (step) => { away = Math.min(Math.max(away * Math.exp(step / 600), data.radius), data.radius * 10); };
  setUp();
  const seen = () => camera(canvas.clientWidth / Math.max(canvas.clientHeight, 1));
  const api = { draw, look, orbit, zoom, parts, identity, paint, painted: true, camera: seen };
  return api;
};

// Connect the boxes that show and hide the parts of a scene, named by `data-part`; boxes without a part are hidden.
const connectParts = (box, scene, draw) => {
  for (const input of box.querySelectorAll("[data-part]")) {
    const parts = scene?.parts.filter(({ name, kind }) => [name, kind].includes(input.dataset.part)) ?? [];
    input.parentElement.hidden = !parts.length;
    input.addEventListener("change", () => {
      for (const part of parts) part.hidden = !input.checked;
      draw();
    });
  }
};

// Connect the view buttons, the wheel and the size of the window to a scene; `draw` draws it again.
const connectView = (box, canvas, scene, draw) => {
  for (const button of box.querySelectorAll("[data-view]"))
    button.addEventListener("click", () => {
      scene?.look(button.dataset.view);
      draw();
    });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    scene?.zoom(event.deltaY);
    draw();
  }, { passive: false });
  addEventListener("resize", draw);
};
