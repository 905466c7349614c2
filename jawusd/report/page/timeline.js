// A timeline on a canvas: frames, a strip of verdicts, keys, and curves of d1 to d3 [mm]. A drag scrubs, the wheel or
// two fingers zoom, and a double click shows everything.
//
// `motion` describes what is shown: span() is its first and last frame; at(frame) its parameters, null or not finite where
// unknown; grade(frame, d) 0 inside the bound, 1 within the tolerance, 2 invalid, null unknown; behind(frame), optional,
// a motion for comparison; keys(), optional, its keys; slopes(key) the slopes of its curves there, null without handles;
// step, optional, the frames of an arrow key. `act` receives seek(frame), and with keys choose(key), hold() before a key or
// a handle is dragged, and move(key, frame, d) and bend(key, axis, slope or null), which return the new key.
const makeTimeline = (canvas, motion, act) => {
  const GUTTER = 36, EDGE = 10, RULER = 20, STRIP = 9, ROW = motion.keys ? 20 : 6, FOOT = 8;
  const COLORS = ["--blue", "--vermilion", "--green"], GRADES = ["--green", "--orange", "--vermilion"];
  const HANDLE = 44; // length of a handle [px]
  const LEAST = 8, MOST = 3; // shortest view [frames], and longest view relative to the span
  const pen = canvas.getContext("2d"), sheet = document.createElement("canvas"), ink = sheet.getContext("2d");
  const pointers = new Map();
  let view = null, range = [-1, 1], frame = 0, chosen = null, held = null, pinch = null;

  // -- places --------------------------------------------------------------------------------------------------------
  const width = () => canvas.clientWidth, height = () => canvas.clientHeight;
  const left = GUTTER, right = () => width() - EDGE, top = RULER + STRIP + ROW, bottom = () => height() - FOOT;
  const seen = () => view ?? motion.span();
  const xOf = (f) => left + ((f - seen()[0]) / (seen()[1] - seen()[0])) * (right() - left);
  const yOf = (x) => bottom() - ((x - range[0]) / (range[1] - range[0])) * (bottom() - top);
  const frameAt = (x) => seen()[0] + ((x - left) / (right() - left)) * (seen()[1] - seen()[0]);
  const place = (event) => {
    const rect = canvas.getBoundingClientRect();
    return [event.clientX - rect.left, event.clientY - rect.top];
  };
  const setView = (from, length) => {
    const [first, last] = motion.span(), most = MOST * (last - first);
    const size = within(length, LEAST, most), start = within(from, first, first + most - size);
    view = start === first && size === last - first ? null : [start, start + size];
    redraw();
  };

  // -- drawing -------------------------------------------------------------------------------------------------------
  const ticks = (low, high, count) => {
    const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough * (1 - 1e-9));
    const out = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high * (1 + 1e-9); k++) out.push(k * step);
    return out;
  };
  const known = (d) => d && Number.isFinite(d[0]);
  const fit = () => { // the range of values; it stays while a key is dragged
    const [first, last] = motion.span(), values = [0];
    for (let k = 0; k <= 300; k++)
      for (const d of [motion.at, motion.behind].map((at) => at?.(first + (k / 300) * (last - first))))
        if (known(d)) values.push(...d);
    for (const key of motion.keys?.() ?? []) values.push(...key.d);
    const [low, high] = [Math.min(...values), Math.max(...values)], room = Math.max(0.08 * (high - low), 1);
    range = [low - room, high + room];
  };
  const curves = (at, color) => {
    for (const axis of [0, 1, 2]) {
      ink.strokeStyle = color(COLORS[axis]);
      ink.beginPath();
      let on = false;
      for (let x = left; x <= right(); x++) {
        const d = at(frameAt(x));
        if (known(d)) ink[on ? "lineTo" : "moveTo"](x, yOf(d[axis]));
        on = known(d);
      }
      ink.stroke();
    }
  };
  const strip = (color) => {
    for (let x = left; x < right(); x++) {
      const d = motion.at(frameAt(x + 0.5)), grade = known(d) ? motion.grade(frameAt(x + 0.5), d) : null;
      ink.fillStyle = grade === null ? color("--line") : color(GRADES[grade]);
      ink.fillRect(x, RULER, 1.5, STRIP);
    }
  };
  const keyMarks = (color) => {
    const middle = RULER + STRIP + ROW / 2;
    for (const key of motion.keys()) {
      const x = xOf(key.frame), strong = key.frame === chosen;
      if (x < left - 6 || x > right() + 6) continue;
      ink.fillStyle = strong ? color("--orange") : color("--ink");
      ink.beginPath();
      for (const [a, b] of [[-6, 0], [0, -6], [6, 0], [0, 6]]) ink.lineTo(x + a, middle + b);
      ink.fill();
      ink.lineWidth = strong ? 2.5 : 1.5;
      key.d.forEach((value, axis) => {
        ink.strokeStyle = color(COLORS[axis]);
        ink.fillStyle = strong ? color("--orange") : color("--paper");
        ink.beginPath();
        ink.arc(x, yOf(value), 4.5, 0, 2 * Math.PI);
        ink.fill();
        ink.stroke();
      });
    }
  };
  // Return the ends of the handles of the chosen key: { key, axis, side, x, y }, a line along each curve to both sides.
  const handles = () => {
    const key = motion.keys?.().find((each) => each.frame === chosen), slopes = key && motion.slopes(key);
    if (!slopes) return [];
    const across = xOf(1) - xOf(0), up = yOf(1) - yOf(0);
    return slopes.flatMap((slope, axis) => {
      const scale = HANDLE / Math.hypot(across, slope * up);
      return [-1, 1].map((side) => ({
        key, axis, side, x: xOf(key.frame) + side * scale * across, y: yOf(key.d[axis]) + side * scale * slope * up,
      }));
    });
  };
  const handleMarks = (color) => {
    ink.lineWidth = 1;
    for (const { key, axis, x, y } of handles()) {
      ink.strokeStyle = ink.fillStyle = color(COLORS[axis]);
      ink.beginPath();
      ink.moveTo(xOf(key.frame), yOf(key.d[axis]));
      ink.lineTo(x, y);
      ink.stroke();
      ink.fillRect(x - 3, y - 3, 6, 6);
    }
  };
  const grid = (color) => {
    ink.textBaseline = "middle";
    ink.fillStyle = color("--soft");
    ink.strokeStyle = color("--line");
    ink.textAlign = "center";
    for (const f of ticks(...seen(), Math.max(2, width() / 70))) {
      if (f !== Math.round(f)) continue;
      ink.fillText(f, xOf(f), RULER / 2);
      ink.strokeRect(xOf(f), top, 0, bottom() - top);
    }
    ink.textAlign = "right";
    for (const value of ticks(...range, Math.max(2, (bottom() - top) / 30))) {
      ink.fillText(value, left - 6, yOf(value));
      ink.strokeRect(left, yOf(value), right() - left, 0);
    }
    ink.fillText("mm", left - 6, RULER + STRIP);
  };
  const paint = () => {
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, canvas.width, canvas.height);
    if (sheet.width && sheet.height) pen.drawImage(sheet, 0, 0);
    pen.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    const x = xOf(frame);
    if (x < left - 1 || x > right() + 1) return;
    pen.fillStyle = getComputedStyle(canvas).color;
    pen.fillRect(x - 0.75, RULER - 5, 1.5, bottom() - RULER + 5);
    pen.beginPath();
    for (const [a, b] of [[-5, -9], [5, -9], [0, 0]]) pen.lineTo(x + a, RULER + b);
    pen.fill();
  };
  const redraw = () => {
    const [w, h] = [width(), height()].map((size) => Math.round(size * devicePixelRatio));
    for (const each of [canvas, sheet]) if (each.width !== w || each.height !== h) [each.width, each.height] = [w, h];
    const style = getComputedStyle(canvas), color = (name) => style.getPropertyValue(name);
    if (!held?.key) fit();
    ink.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    ink.clearRect(0, 0, width(), height());
    ink.font = "11px system-ui, sans-serif";
    ink.lineWidth = 1;
    grid(color);
    strip(color);
    ink.save();
    ink.beginPath();
    ink.rect(left - 6, 0, right() - left + 12, height());
    ink.clip();
    ink.lineWidth = 2;
    if (motion.behind) {
      ink.globalAlpha = 0.3;
      curves(motion.behind, color);
      ink.globalAlpha = 1;
    }
    curves(motion.at, color);
    if (motion.keys) {
      handleMarks(color);
      keyMarks(color);
    }
    ink.restore();
    canvas.dataset.area = JSON.stringify({ left, right: right(), top, bottom: bottom(), view: seen(), range });
    paint();
  };

  // -- pointers ------------------------------------------------------------------------------------------------------
  // Return the key under a point: its diamond, or its dot on a curve with the axis of that curve, or a handle with its
  // side; null if there is none.
  const under = ([x, y], reach) => {
    let best = null, least = reach;
    for (const key of motion.keys?.() ?? []) {
      const marks = [[RULER + STRIP + ROW / 2, null], ...key.d.map((value, axis) => [yOf(value), axis])];
      for (const [markY, axis] of marks) {
        const far = Math.hypot(x - xOf(key.frame), y - markY);
        if (far < least) [least, best] = [far, { key, axis }];
      }
    }
    for (const { key, axis, side, x: handleX, y: handleY } of handles()) {
      const far = Math.hypot(x - handleX, y - handleY);
      if (far < least) [least, best] = [far, { key, axis, side }];
    }
    return best;
  };
  const scrub = (x) => act.seek(Math.round(within(frameAt(within(x, left, right())), motion.span()[0], Infinity)));
  const fingers = () => {
    const [a, b] = [...pointers.values()].map(([x]) => x);
    return { middle: (a + b) / 2, apart: Math.max(Math.abs(a - b), 10) };
  };
  canvas.addEventListener("pointerdown", (event) => {
    const at = place(event);
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, at);
    if (pointers.size === 2) {
      const { middle, apart } = fingers();
      [held, pinch] = [null, { frame: frameAt(middle), length: (seen()[1] - seen()[0]) * apart }];
      return;
    }
    held = under(at, event.pointerType === "mouse" ? 9 : 18) ?? {};
    held.from = at;
    if (held.key) act.choose(held.key);
    else scrub(at[0]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = place(event);
    if (!pointers.has(event.pointerId)) {
      canvas.style.cursor = under(at, 9) ? "move" : "ew-resize";
      return;
    }
    pointers.set(event.pointerId, at);
    if (pinch) {
      const { middle, apart } = fingers(), length = pinch.length / apart;
      setView(pinch.frame - ((middle - left) / (right() - left)) * length, length);
    } else if (held?.key) {
      if (!held.moved && Math.hypot(at[0] - held.from[0], at[1] - held.from[1]) < 3) return;
      if (!held.moved) act.hold();
      held.moved = true;
      const value = range[0] + ((bottom() - at[1]) / (bottom() - top)) * (range[1] - range[0]);
      if (held.side) {
        const ahead = held.side * Math.max(held.side * (frameAt(at[0]) - held.key.frame), 2 * (frameAt(1) - frameAt(0)));
        held.key = act.bend(held.key, held.axis, (value - held.key.d[held.axis]) / ahead);
        return;
      }
      const d = held.key.d.map((x, axis) => (axis === held.axis ? value : x));
      held.key = act.move(held.key, Math.max(Math.round(frameAt(at[0])), motion.span()[0]), d);
    } else if (held) scrub(at[0]);
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (event) => {
      pointers.delete(event.pointerId);
      const refit = held?.moved;
      if (pointers.size < 2) pinch = null;
      held = null;
      if (refit) redraw();
    });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const length = seen()[1] - seen()[0], [x] = place(event);
    if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) {
      setView(seen()[0] + ((event.deltaX || event.deltaY) / (right() - left)) * length, length);
      return;
    }
    const size = length * Math.exp(event.deltaY / 500), share = (x - left) / (right() - left);
    setView(frameAt(x) - share * within(size, LEAST, Infinity), size);
  }, { passive: false });
  canvas.addEventListener("dblclick", (event) => {
    const found = under(place(event), 9);
    if (!found?.side) return setView(motion.span()[0], motion.span()[1] - motion.span()[0]);
    act.hold();
    act.bend(found.key, found.axis, null);
  });
  canvas.addEventListener("keydown", (event) => {
    const [first, last] = motion.span(), step = motion.step ?? 1;
    const to = { ArrowLeft: frame - step, ArrowRight: frame + step, Home: first, End: last }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    act.seek(Math.max(Math.round(to), first));
  });
  addEventListener("resize", redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  return {
    redraw,
    // Move the playhead, and mark the key at frame `key`, if any.
    show: (at, key = null) => {
      frame = at;
      canvas.setAttribute("aria-valuenow", Math.round(at));
      if (key === chosen) paint();
      else {
        chosen = key;
        redraw();
      }
    },
  };
};
