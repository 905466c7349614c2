// Posing and keying a rig: sliders, dragging, the section of the bound, and a timeline of the take and of keys.
(() => {
  const box = document.getElementById("jaw");
  const data = JSON.parse(document.getElementById("jaw-data").textContent);
  const find = (name) => box.querySelector(`[data-jaw="${name}"]`);
  const canvas = find("canvas"), section = find("section"), play = find("play"), source = find("source");
  const sliders = ["d1", "d2", "d3"].map(find);
  const decoder = makeDecoder(data), scene = makeScene(canvas, data);
  const dragging = scene && makeDragging(decoder, scene, canvas);
  if (!scene) {
    find("message").textContent = "This browser has no WebGL 2: the jaw cannot be shown.";
    canvas.hidden = true;
  }
  const mm = (value) => (Math.round(value * 10) / 10 || 0).toFixed(1);

  let clearance = null; // of the teeth at d [mm], once it is unpacked

  // -- motions: the take, rows of d1, d2, d3 and margin [mm], and the keys ---------------------------------------------
  const take = new Float32Array(bytesOf(data.take)), count = take.length / 4;
  const IDLE_S = 5; // length of the timeline without a take
  const span = [data.first, data.first + (count > 1 ? count - 1 : Math.round(IDLE_S * data.fps))];
  const row = (k) => take.subarray(4 * k, 4 * k + 4);
  const takeAt = (frame) => {
    const at = within(frame - data.first, 0, count - 1), k = Math.min(Math.floor(at), count - 2), t = at - k;
    return count < 2 ? [...row(0)] : Array.from(row(k), (x, i) => x + t * (row(k + 1)[i] - x));
  };
  const ROUNDING = 1e-3; // of stored margins and keys [mm]
  const keyed = () => source.value === "keys";
  const motion = {
    span: () => span,
    at: (at) => (keyed() ? keys.at(at) : takeAt(at).slice(0, 3)),
    behind: (at) => (keyed() && count ? takeAt(at) : null),
    grade: (at, d) => {
      const off = -(keyed() ? decoder.margin(d) : takeAt(Math.round(at))[3]);
      if (clearance?.(d) < data.contact?.clearance[keyed() ? "authored" : "measured"]) return 2;
      return off <= ROUNDING ? 0 : off <= data.tolerance ? 1 : 2;
    },
    keys: () => keys.all(),
    slopes: (key) => keys.slopes(key),
  };

  // Return the paths of landmarks from a second before to a second after the frame.
  const paths = () => {
    const [low, high] = [-1, 1].map((side) => within(Math.round(frame + side * data.fps), ...span));
    const poses = [];
    for (let at = low; at <= high; at++) {
      const d = motion.at(at);
      if (d) poses.push(decoder.motion(d));
    }
    return poses.length < 2 ? [] : data.traced.map((point) => poses.flatMap((m) => moved(m, point)));
  };

  // -- the section of the bound at the current opening ---------------------------------------------------------------
  const CELLS = 40;
  const drawSection = () => {
    const pen = section.getContext("2d"), style = getComputedStyle(document.documentElement);
    const [, [low2, high2], [low3, high3]] = decoder.box;
    const [w, h] = [section.width, section.height];
    pen.clearRect(0, 0, w, h);
    pen.fillStyle = style.getPropertyValue("--green");
    const step = (high2 - low2) / CELLS;
    for (let i = 0; i < CELLS; i++)
      for (let j = 0; j < CELLS; j++) {
        const d = [now[0], low2 + ((i + 0.5) / CELLS) * (high2 - low2), high3 - ((j + 0.5) / CELLS) * (high3 - low3)];
        pen.globalAlpha = 0.4 * within(decoder.margin(d) / step + 0.5, 0, 1);
        if (pen.globalAlpha > 0) pen.fillRect((i * w) / CELLS, (j * h) / CELLS, w / CELLS, h / CELLS);
      }
    pen.globalAlpha = 1;
    pen.fillStyle = style.getPropertyValue("--vermilion");
    pen.beginPath();
    pen.arc(((now[1] - low2) / (high2 - low2)) * w, ((high3 - now[2]) / (high3 - low3)) * h, 5, 0, 2 * Math.PI);
    pen.fill();
  };

  // -- footage of the take at the frame; phones begin without -----------------------------------------------------------
  const camera = find("camera"), picture = find("footage");
  const showFootage = () => {
    if (!camera) return;
    const image = data.footage.cameras[camera.value]?.[Math.floor((frame - data.footage.first) / data.footage.step)];
    picture.hidden = !image;
    if (image) picture.src = `data:image/jpeg;base64,${image}`;
  };
  if (camera && !matchMedia("(max-width: 40rem)").matches) camera.selectedIndex = 1;
  camera?.addEventListener("change", showFootage);

  // -- showing a pose ------------------------------------------------------------------------------------------------
  let now = [0, 0, 0], frame = span[0], running = false, started = 0, from = 0, held = null;
  const nearest = makeGhosts(data.ghosts), ghosts = find("ghosts");
  const draw = () => {
    const m = decoder.motion(now), near = ghosts.checked ? nearest(now) : [];
    const faint = near.map((d) => new Float32Array(decoder.motion(d)));
    scene?.draw(new Float32Array(m), find("paths").checked ? paths() : [], faint);
    drawSection();
    box.dataset.ghosts = JSON.stringify(near);
    box.dataset.d = JSON.stringify(now);
    box.dataset.motion = JSON.stringify(m);
  };
  const show = (d, margin = decoder.margin(d)) => {
    now = d;
    sliders.forEach((slider, i) => {
      slider.value = now[i];
      find(`${slider.dataset.jaw}-mm`).textContent = `${mm(now[i])} mm`;
    });
    const out = -margin > ROUNDING;
    const word = out ? `outside the bound${-margin <= data.tolerance ? ", within tolerance" : ""}` : "inside the bound";
    find("margin").textContent = `${mm(Math.abs(margin))} mm ${word}`;
    if (clearance) {
      const apart = clearance(d), hundredths = Math.abs(apart).toFixed(2);
      const collide = apart < data.contact.clearance.authored ? ": teeth collide" : "";
      find("clearance").textContent = `clearance ${apart < 0 ? "-" : ""}${hundredths} mm${collide}`;
      box.dataset.clearance = apart;
    }
    draw();
  };
  const seek = (at) => {
    frame = at;
    find("frame").textContent = `frame ${at}`;
    find("seconds").textContent = `${((at - span[0]) / data.fps).toFixed(2)} s`;
    const there = keys.find(at) ? at : null;
    find("delete").disabled = there === null;
    timeline.show(at, there);
    showFootage();
    if (keyed()) {
      const d = keys.at(at);
      if (d) show(d);
    } else {
      const [d1, d2, d3, margin] = takeAt(at);
      show([d1, d2, d3], margin);
    }
  };

  // -- keys ----------------------------------------------------------------------------------------------------------
  const keys = makeKeys(() => {
    const all = keys.all();
    box.dataset.keys = JSON.stringify(all);
    find("undo").disabled = !keys.canUndo();
    find("redo").disabled = !keys.canRedo();
    find("json").disabled = find("csv").disabled = !all.length;
    source.value = "keys";
    timeline.redraw();
    seek(frame);
  });
  const timeline = makeTimeline(find("timeline"), motion, {
    seek: (at) => {
      setRunning(false);
      seek(at);
    },
    choose: (key) => {
      setRunning(false);
      source.value = "keys";
      timeline.redraw();
      seek(key.frame);
    },
    hold: keys.record,
    move: (key, at, d) => {
      const next = keys.move(key, at, decoder.boxed(d));
      seek(next.frame);
      return next;
    },
    bend: keys.bend,
  });
  const addKey = () => {
    setRunning(false);
    keys.set(frame, now);
  };
  const save = (name, type, text) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([text], { type }));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const actions = {
    play: () => setRunning(!running),
    key: addKey,
    delete: () => keys.remove(frame),
    undo: keys.undo,
    redo: keys.redo,
    json: () => save("keys.json", "application/json", keys.json(data.fps)),
    csv: () => save("d.csv", "text/csv", keys.csv()),
    close: () => {
      setRunning(false);
      show([0, 0, 0]);
    },
  };
  for (const [name, act] of Object.entries(actions)) find(name).addEventListener("click", act);
  find("smooth").addEventListener("change", () => keys.setSmooth(find("smooth").checked));
  source.addEventListener("change", () => {
    setRunning(false);
    timeline.redraw();
    seek(frame);
  });
  addEventListener("keydown", (event) => {
    const name = event.key.toLowerCase(), control = event.ctrlKey || event.metaKey;
    const busy = event.target.closest("button, select, input");
    let act = null;
    if (control && name === "z") act = event.shiftKey ? "redo" : "undo";
    else if (control && name === "y") act = "redo";
    else if (control || event.altKey || event.target.closest("select")) return;
    else if (name === "k") act = "key";
    else if (name === "delete" || name === "backspace") act = "delete";
    else if (name === " " && !busy) act = "play";
    if (!act) return;
    event.preventDefault();
    find(act).click();
  });

  // -- playing -------------------------------------------------------------------------------------------------------
  const played = () => {
    const all = keys.all();
    return keyed() ? [all[0]?.frame, all.at(-1)?.frame] : span;
  };
  const tick = (time) => {
    if (!running) return;
    const [first, last] = played(), at = from + (Math.max(time - started, 0) / 1000) * data.fps;
    seek(Math.min(Math.floor(first + ((at - first) % (last - first + 1))), last));
    requestAnimationFrame(tick);
  };
  const setRunning = (value) => {
    const [first, last] = played();
    running = value && last > first;
    play.textContent = running ? "Pause" : "Play";
    if (!running) return;
    started = performance.now();
    from = frame >= first && frame < last ? frame : first;
    requestAnimationFrame(tick);
  };

  // -- controls ------------------------------------------------------------------------------------------------------
  sliders.forEach((slider, i) => {
    [slider.min, slider.max] = decoder.box[i];
    slider.addEventListener("input", () => {
      setRunning(false);
      show(decoder.inside(now.map((x, k) => (k === i ? Number(slider.value) : x)), now));
    });
  });
  connectView(box, canvas, scene, draw);
  connectParts(box, scene, draw);
  for (const input of [find("paths"), ghosts]) input.addEventListener("change", draw);
  ghosts.parentElement.hidden = !data.ghosts.captured;
  find("contacts")?.addEventListener("change", () => {
    if (scene) scene.painted = find("contacts").checked;
    draw();
  });
  const openContacts = async () => {
    if (!data.contact) return;
    const fields = await openFields(data.contact.fields);
    clearance = await makeClearance(data.contact.clearance);
    scene?.paint(fields, data.contact.marks);
    timeline.redraw();
    show(now);
  };
  openContacts();
  canvas.addEventListener("pointerdown", (event) => {
    setRunning(false);
    held = { at: [event.clientX, event.clientY], point: dragging.grab(event, now) };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) {
      canvas.style.cursor = !running && event.pointerType === "mouse" && dragging.grab(event, now) ? "move" : "grab";
      return;
    }
    if (held.point) {
      show(dragging.pull(event, now, held.point));
      return;
    }
    scene.orbit(event.clientX - held.at[0], event.clientY - held.at[1]);
    held.at = [event.clientX, event.clientY];
    draw();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => (held = null));
  scene?.look("front");
  source.value = count ? "take" : "keys";
  source.hidden = count === 0;
  timeline.redraw();
  seek(frame);
  if (!count) show([0, 0, 0]);
  setRunning(!matchMedia("(prefers-reduced-motion: reduce)").matches);
})();
