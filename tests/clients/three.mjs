// Compare vertices in three.js with the expected ones: `node three.mjs FOLDER`, filled by files.py.
// Prints a line for each file; exits 1 where a vertex is not where it should be.

import { readFileSync } from "node:fs";
import { join } from "node:path";
import { AnimationMixer, LoopOnce, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const FRAMES_PER_SECOND = 30;
const folder = process.argv[2];
const expected = JSON.parse(readFileSync(join(folder, "expected.json")));

async function load(name) {
  const bytes = readFileSync(join(folder, name));
  const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
  const { scene, animations } = await new GLTFLoader().parseAsync(buffer, "");
  const meshes = [];
  scene.traverse((node) => node.isMesh && meshes.push(node));
  if (meshes.length !== 1) throw new Error(`${name} holds ${meshes.length} meshes`);
  return { scene, mesh: meshes[0], animations };
}

// The largest distance of a vertex, as it is drawn, from where it should be.
function distance(mesh, vertices) {
  mesh.updateWorldMatrix(true, false);
  if (mesh.geometry.attributes.position.count !== vertices.length) return Infinity;
  const seen = new Vector3();
  return Math.max(
    ...vertices.map((vertex, k) =>
      mesh
        .getVertexPosition(k, seen)
        .applyMatrix4(mesh.matrixWorld)
        .distanceTo(new Vector3(...vertex)),
    ),
  );
}

function report(name, error, tolerance) {
  const good = error <= tolerance;
  console.log(
    `three.js  ${name}: largest distance of a vertex ${error.toExponential(1)}${good ? "" : ": WRONG"}`,
  );
  if (!good) process.exitCode = 1;
}

const { mesh: shape } = await load("shape.glb");
report("shape.glb", distance(shape, expected.shape.vertices), expected.tolerance);

const { mesh: colored } = await load("colored.glb");
const uncolored = !colored.material.vertexColors || colored.geometry.attributes.color?.itemSize !== 3;
report("colored.glb", uncolored ? Infinity : distance(colored, expected.shape.vertices), expected.tolerance);

for (const [name, tolerance] of [
  ["animation", expected.tolerance],
  ["long", expected.basis_tolerance],
]) {
  const { scene, mesh, animations } = await load(`${name}.glb`);
  const mixer = new AnimationMixer(scene);
  const action = mixer.clipAction(animations[0]).setLoop(LoopOnce);
  action.clampWhenFinished = true; // or the action would jump back to the first key at its end
  action.play();
  const errors = expected[name].times.map((frame, k) => {
    action.reset(); // so that times may be set in any order
    mixer.setTime(frame / FRAMES_PER_SECOND);
    return distance(mesh, expected[name].vertices[k]);
  });
  report(`${name}.glb`, Math.max(...errors), tolerance);
}
