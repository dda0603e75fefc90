/** Writes a shape into the GLB file of the reference, whose names, materials and textures stay. */

import { BufferAttribute, BufferGeometry } from "three";

const JSON_CHUNK = 20; // offset of the text
const FLOAT = 5126;

/**
 * Return a GLB file with other positions, and with normals that follow them.
 * @param {ArrayBuffer} glb file with one buffer and one set of vertices, as shapespace writes it
 * @param {Float32Array} positions 3V numbers
 */
export function withPositions(glb, positions) {
  const size = new DataView(glb).getUint32(12, true);
  const tree = JSON.parse(new TextDecoder().decode(new Uint8Array(glb, JSON_CHUNK, size)));
  const binary = glb.slice(JSON_CHUNK + size + 8);
  const numbers = (index) => {
    const { bufferView, componentType, count } = tree.accessors[index];
    const { byteOffset, byteLength } = tree.bufferViews[bufferView];
    const [Type, bytes] = { 5123: [Uint16Array, 2], 5125: [Uint32Array, 4], [FLOAT]: [Float32Array, 4] }[
      componentType
    ];
    return { count, values: new Type(binary, byteOffset, byteLength / bytes) };
  };
  const primitives = tree.meshes.flatMap((mesh) => mesh.primitives);
  const { attributes } = primitives[0];
  const { count, values: to } = numbers(attributes.POSITION);
  const row = attributes._VERTEX === undefined ? null : numbers(attributes._VERTEX).values;
  const normals = numbers(attributes.NORMAL).values;
  // Vertices that are split by texture coordinates alone share a normal, and sharp edges do not.
  const groups = new Map();
  const group = Uint32Array.from({ length: count }, (_, k) => {
    const key = [row?.[k] ?? k, ...normals.subarray(3 * k, 3 * k + 3)].join();
    if (!groups.has(key)) groups.set(key, groups.size);
    return groups.get(key);
  });
  for (let k = 0; k < count; k += 1) {
    const from = 3 * (row?.[k] ?? k);
    to.set(positions.subarray(from, from + 3), 3 * k);
  }
  const geometry = new BufferGeometry();
  const merged = new Float32Array(3 * groups.size);
  group.forEach((j, k) => merged.set(to.subarray(3 * k, 3 * k + 3), 3 * j));
  geometry.setAttribute("position", new BufferAttribute(merged, 3));
  geometry.setIndex(
    primitives.flatMap(({ indices }) => Array.from(numbers(indices).values, (corner) => group[corner])),
  );
  geometry.computeVertexNormals();
  const found = geometry.attributes.normal.array;
  group.forEach((j, k) => normals.set(found.subarray(3 * j, 3 * j + 3), 3 * k));
  geometry.dispose();
  const axis = (i) => to.filter((_, k) => k % 3 === i);
  Object.assign(tree.accessors[attributes.POSITION], {
    min: [0, 1, 2].map((i) => axis(i).reduce((a, b) => Math.min(a, b))),
    max: [0, 1, 2].map((i) => axis(i).reduce((a, b) => Math.max(a, b))),
  });
  return join(tree, binary);
}

/** Return the file of a tree and a buffer. */
function join(tree, binary) {
  const text = new TextEncoder().encode(JSON.stringify(tree));
  const size = text.length + (-text.length & 3);
  const file = new Uint8Array(JSON_CHUNK + size + 8 + binary.byteLength).fill(0x20);
  const view = new DataView(file.buffer);
  const heads = [0x46546c67, 2, file.length, size, 0x4e4f534a];
  heads.forEach((value, k) => view.setUint32(4 * k, value, true));
  file.set(text, JSON_CHUNK);
  view.setUint32(JSON_CHUNK + size, binary.byteLength, true);
  view.setUint32(JSON_CHUNK + size + 4, 0x004e4942, true);
  file.set(new Uint8Array(binary), JSON_CHUNK + size + 8);
  return file;
}
