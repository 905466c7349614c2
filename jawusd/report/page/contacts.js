// Contacts of the teeth: clearances as the evaluator's, and distances to the opposing arch, which scene.js paints.
const inflated = async (text) => {
  const bytes = new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(bytes).arrayBuffer();
};

// Return the clearance [mm] at d [mm], trilinear in a grid and constant outside it.
const makeClearance = async ({ first, step, shape, values, unit }) => {
  const table = new Int16Array(await inflated(values));
  return (d) => {
    const places = d.map((x, i) => within((x - first[i]) / step[i], 0, shape[i] - 1));
    const cells = places.map((x, i) => Math.min(Math.floor(x), shape[i] - 2));
    let sum = 0;
    for (let corner = 0; corner < 8; corner++) {
      let weight = 1, at = 0;
      for (let i = 0; i < 3; i++) {
        const up = (corner >> i) & 1, share = places[i] - cells[i];
        weight *= up ? share : 1 - share;
        at = at * shape[i] + cells[i] + up;
      }
      sum += weight * table[at];
    }
    return unit * sum;
  };
};

// Return the fields of contact data with their values unpacked, for `paint` of a scene.
const openFields = (fields) => Promise.all(fields.map(async (field) => (
  { ...field, values: new Uint8Array(await inflated(field.values)) }
)));
