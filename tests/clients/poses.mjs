// Print as JSON where three.js shows the vertices of each file: `node poses.mjs FILE.glb …`.

import { readFileSync } from "node:fs";
import { Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const shown = {};
for (const name of process.argv.slice(2)) {
  const bytes = readFileSync(name);
  const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
  const { scene } = await new GLTFLoader().parseAsync(buffer, "");
  scene.updateMatrixWorld(true);
  const vertices = [];
  scene.traverse((node) => {
    if (!node.isMesh) return;
    for (let k = 0; k < node.geometry.attributes.position.count; k++) {
      const vertex = node.getVertexPosition(k, new Vector3()).applyMatrix4(node.matrixWorld);
      vertices.push(vertex.toArray());
    }
  });
  shown[name] = vertices;
}
console.log(JSON.stringify(shown));
