/**
 * The surface of the training files: materials and textures, on vertices that are split along seams.
 */

import * as THREE from "three";

const WIDTH = { SCALAR: 1, VEC2: 2 };
const NUMBERS = { 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };

export class Skin {
  /** Read the server's GLB of the reference. */
  static async of(buffer) {
    const size = new DataView(buffer).getUint32(12, true);
    const tree = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 20, size)));
    const start = 28 + size;
    const array = (index) => {
      const { bufferView, componentType, count, type } = tree.accessors[index];
      const Type = NUMBERS[componentType];
      return new Type(buffer, start + tree.bufferViews[bufferView].byteOffset, count * WIDTH[type]);
    };
    const pictures = await Promise.all(
      tree.images.map(({ bufferView, mimeType }) => {
        const { byteOffset, byteLength } = tree.bufferViews[bufferView];
        return createImageBitmap(
          new Blob([new Uint8Array(buffer, start + byteOffset, byteLength)], { type: mimeType }),
        );
      }),
    );
    return new Skin(tree, array, pictures);
  }

  constructor(tree, array, pictures) {
    const { primitives } = tree.meshes[0];
    const { attributes } = primitives[0];
    const count = tree.accessors[attributes.POSITION].count;
    this.rows =
      attributes._VERTEX === undefined
        ? Array.from({ length: count }, (_, k) => k)
        : array(attributes._VERTEX);
    this.geometry = new THREE.BufferGeometry();
    for (const name of ["position", "normal"]) {
      const values = new THREE.BufferAttribute(new Float32Array(3 * count), 3);
      this.geometry.setAttribute(name, values.setUsage(THREE.DynamicDrawUsage));
    }
    if (attributes.TEXCOORD_0 !== undefined) {
      this.geometry.setAttribute("uv", new THREE.BufferAttribute(array(attributes.TEXCOORD_0), 2));
    }
    const parts = primitives.map(({ indices }) => array(indices));
    const index = new Uint32Array(parts.reduce((sum, part) => sum + part.length, 0));
    let begin = 0;
    parts.forEach((part, k) => {
      index.set(part, begin);
      this.geometry.addGroup(begin, part.length, k);
      begin += part.length;
    });
    this.geometry.setIndex(new THREE.BufferAttribute(index, 1));
    this.textures = pictures.map((picture) => {
      const texture = new THREE.Texture(picture);
      Object.assign(texture, { flipY: false, colorSpace: THREE.SRGBColorSpace, needsUpdate: true });
      texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
      return texture;
    });
    this.materials = primitives.map(({ material }) => {
      const { pbrMetallicRoughness: look, alphaMode } = tree.materials[material];
      const [red, green, blue, opacity] = look.baseColorFactor;
      return new THREE.MeshStandardMaterial({
        color: new THREE.Color(red, green, blue),
        opacity,
        transparent: alphaMode === "BLEND",
        roughness: look.roughnessFactor,
        metalness: look.metallicFactor,
        map: look.baseColorTexture ? this.textures[tree.textures[look.baseColorTexture.index].source] : null,
        polygonOffset: true,
        polygonOffsetFactor: 1,
        polygonOffsetUnits: 1,
      });
    });
  }

  /** Take the positions of a geometry with the same vertices, not split. */
  follow(geometry) {
    for (const name of ["position", "normal"]) {
      const [from, to] = [geometry.attributes[name].array, this.geometry.attributes[name].array];
      this.rows.forEach((row, k) => {
        for (let i = 0; i < 3; i += 1) to[3 * k + i] = from[3 * row + i];
      });
      this.geometry.attributes[name].needsUpdate = true;
    }
  }

  dispose() {
    for (const part of [this.geometry, ...this.materials, ...this.textures]) part.dispose();
  }
}
