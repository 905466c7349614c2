// Keys of an animation, jaw parameters d [mm] at frames, interpolated as `jawusd animate` does, with undo and redo.

// Return the tangents [mm per frame] of the monotone cubic curve through keys, zero at both ends (Fritsch and Butland,
// SIAM J. Sci. Stat. Comput. 5, 1984).
const monotoneTangents = (keys) => keys.map(({ frame, d }, k) => d.map((x, i) => {
  if (k === 0 || k === keys.length - 1) return 0;
  const back = frame - keys[k - 1].frame, on = keys[k + 1].frame - frame;
  const before = (x - keys[k - 1].d[i]) / back, after = (keys[k + 1].d[i] - x) / on;
  return before * after > 0 ? (3 * (back + on)) / ((2 * on + back) / before + (on + 2 * back) / after) : 0;
}));

// `changed` is called after every change. A key is { frame, d, tangents } and is never modified; `tangents`, optional, has
// the slopes of d [mm per frame], null where the curve is monotone between keys.
const makeKeys = (changed) => {
  let keys = [], tangents = [], smooth = true;
  const past = [], future = [];
  const put = (next) => {
    keys = [...next].sort((a, b) => a.frame - b.frame);
    tangents = monotoneTangents(keys).map((slopes, k) => slopes.map((x, i) => keys[k].tangents?.[i] ?? x));
    changed();
  };
  const record = () => {
    past.push(keys);
    future.length = 0;
  };
  const step = (from, to) => {
    if (!from.length) return;
    to.push(keys);
    put(from.pop());
  };
  const find = (frame) => keys.find((key) => key.frame === frame);
  // Return d at a frame, constant before the first and after the last key; null without keys.
  const at = (frame) => {
    if (!keys.length) return null;
    const next = keys.findIndex((key) => key.frame > frame);
    if (next === 0 || next < 0) return keys.at(next < 0 ? -1 : 0).d;
    const [a, b] = [keys[next - 1], keys[next]], h = b.frame - a.frame, t = (frame - a.frame) / h;
    if (!smooth) return a.d.map((x, i) => x + t * (b.d[i] - x));
    const rise = t * t * (3 - 2 * t), [m, n] = [tangents[next - 1], tangents[next]];
    return a.d.map((x, i) => x + rise * (b.d[i] - x) + h * t * (1 - t) * ((1 - t) * m[i] - t * n[i]));
  };
  const replace = (key, next) => {
    put(keys.map((other) => (other === key ? next : other)));
    return next;
  };
  const rounded = (d) => d.map((x) => Math.round(x * 1e4) / 1e4 || 0);
  return {
    all: () => keys,
    find,
    at,
    record,
    // Add or replace the key at a frame.
    set: (frame, d) => {
      record();
      put([...keys.filter((key) => key.frame !== frame), { frame, d: rounded(d) }]);
    },
    remove: (frame) => {
      if (!find(frame)) return;
      record();
      put(keys.filter((key) => key.frame !== frame));
    },
    // Replace a key without a new step of undo, and return the new key; its frame stays if another key is there.
    move: (key, frame, d) => {
      return replace(key, { ...key, frame: frame === key.frame || find(frame) ? key.frame : frame, d: rounded(d) });
    },
    // Set or, with null, remove the given slope of d[axis] at a key, without a new step of undo; return the new key.
    bend: (key, axis, slope) => {
      const given = [0, 1, 2].map((i) => (i === axis ? slope : (key.tangents?.[i] ?? null)));
      const { tangents: _, ...plain } = key;
      const known = given.map((x) => (x === null ? null : rounded([x])[0]));
      return replace(key, known.every((x) => x === null) ? plain : { ...plain, tangents: known });
    },
    // Return the slopes [mm per frame] of smooth curves at a key; null if lines connect the keys.
    slopes: (key) => (smooth ? (tangents[keys.indexOf(key)] ?? null) : null),
    undo: () => step(past, future),
    redo: () => step(future, past),
    canUndo: () => past.length > 0,
    canRedo: () => future.length > 0,
    setSmooth: (value) => {
      smooth = value;
      changed();
    },
    // Return the text of keys.json, and a CSV table with a row per frame from the first to the last key.
    json: (fps) => JSON.stringify({ fps, interpolation: smooth ? "smooth" : "linear", keys }, null, 1) + "\n",
    csv: () => {
      const lines = ["frame,d1,d2,d3"];
      for (let frame = keys[0].frame; frame <= keys.at(-1).frame; frame++)
        lines.push([frame, ...rounded(at(frame))].join(","));
      return lines.join("\n") + "\n";
    },
  };
};
