// Run by node: parse a .usdz or .glb with three.js and print the matrices of the mandible's mesh, as JSON.
// Usage: node three_read.mjs NODE_MODULES FILE TIME,TIME,... MESH     (times in seconds)
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [, , modules, file, times, meshName] = process.argv;
const THREE = await import(pathToFileURL(`${modules}/three/build/three.module.js`));
const kind = file.endsWith(".glb") ? "GLTFLoader" : "USDLoader";
const { [kind]: Loader } = await import(pathToFileURL(`${modules}/three/examples/jsm/loaders/${kind}.js`));

const bytes = readFileSync(file);
const data = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const parsed = kind === "USDLoader" ? new Loader().parse(data) : await new Loader().parseAsync(data, "");
const scene = parsed.scene ?? parsed;
const mesh = scene.getObjectByName(meshName);
const clips = parsed.animations ?? [];
const mixer = new THREE.AnimationMixer(scene);
clips.forEach((clip) => mixer.clipAction(clip).play());
const actor = scene.getObjectByName("Actor") ?? scene.children[0];
const found = {};
for (const time of times.split(",").map(Number)) {
  mixer.setTime(time);
  scene.updateMatrixWorld(true);
  const relative = actor.matrixWorld.clone().invert().multiply(mesh.matrixWorld);
  found[time] = relative.clone().transpose().elements; // row by row
}
function named(root) {
  const rows = [];
  root.traverse((node) => node.isMesh && rows.push([node.name, Object.keys(node.geometry.attributes).sort()]));
  return rows;
}
console.log("RESULT " + JSON.stringify({ revision: THREE.REVISION, clips: clips.length, tracks: clips[0]?.tracks.length ?? 0, matrices: found, points: mesh.geometry.attributes.position.count, looks: Object.fromEntries(scene.children.length ? named(scene) : []) }));
