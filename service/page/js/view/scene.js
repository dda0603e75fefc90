/** What the large view and the small pictures have in common: surface, light, and where one looks from. */

import * as THREE from "three";

/** Towards the viewer, from which models are seen first. */
export const VIEW = new THREE.Vector3(0.45, 0.28, 1).normalize();
const FIELD = 28; // degrees
/** Clay. */
export const BASE = new THREE.Color(0xdac6b4);

export function surfaceMaterial() {
  return new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.8, metalness: 0 });
}

/** A camera that carries its lights along, so that what one looks at is lit. */
export function litCamera() {
  const camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
  const light = (colour, strength, x, y, z) => {
    const made = new THREE.DirectionalLight(colour, strength);
    made.position.set(x, y, z);
    camera.add(made, made.target);
  };
  light(0xfff1e0, 2.1, -1.2, 1.7, 1.5); // key
  light(0xe4ecff, 0.4, 1.8, -0.2, 1); // fill
  light(0xdce8ff, 2.2, 1.1, 0.9, -1.5); // rim, from behind
  camera.add(new THREE.HemisphereLight(0xffffff, 0x8a7a70, 1.05));
  return camera;
}

/** Tangent of half the angle of a camera's height. */
const slope = (camera) => Math.tan((camera.fov * Math.PI) / 360);

/** How far a camera must be from a sphere to have it in view. */
const distanceOf = (camera, { radius }) =>
  radius / Math.sin(Math.atan(slope(camera) * Math.min(camera.aspect, 1)));

/**
 * How far it must be to have positions (3V numbers) in the width of its view and in a share of its height.
 */
export function distanceTo(camera, positions, center, share) {
  const back = new THREE.Quaternion()
    .setFromRotationMatrix(new THREE.Matrix4().lookAt(VIEW, new THREE.Vector3(), camera.up))
    .invert();
  const high = slope(camera) * share;
  const wide = slope(camera) * camera.aspect;
  const point = new THREE.Vector3();
  let distance = 0;
  for (let i = 0; i < positions.length; i += 3) {
    point.fromArray(positions, i).sub(center).applyQuaternion(back);
    distance = Math.max(distance, point.z + Math.abs(point.x) / wide, point.z + Math.abs(point.y) / high);
  }
  return distance;
}

/** Put a camera so far from the middle of a sphere; where nothing is said, so that this fills its view. */
export function frame(camera, { center, radius }, distance = distanceOf(camera, { radius })) {
  camera.near = distance / 100;
  camera.far = distance * 20;
  camera.position.copy(center).addScaledVector(VIEW, distance);
  camera.lookAt(center);
  camera.updateProjectionMatrix();
}

export function sphereOf(positions) {
  const box = new THREE.Box3().setFromArray(positions);
  const center = box.getCenter(new THREE.Vector3());
  let squared = 0;
  for (let i = 0; i < positions.length; i += 3) {
    squared = Math.max(
      squared,
      center.distanceToSquared({ x: positions[i], y: positions[i + 1], z: positions[i + 2] }),
    );
  }
  return new THREE.Sphere(center, Math.sqrt(squared));
}

/** Of the box around positions (3V numbers). */
export const diagonalOf = (positions) =>
  new THREE.Box3().setFromArray(positions).getSize(new THREE.Vector3()).length();

/**
 * The side of faces to draw: of closed surfaces the outer one, as the inner would shine through along
 * silhouettes.
 * @param {ArrayLike<number>} faces
 * @param {number} vertexCount
 */
export function sideOf(faces, vertexCount) {
  const directed = new Set();
  const next = (i) => (i % 3 < 2 ? i + 1 : i - 2);
  for (let i = 0; i < faces.length; i += 1) directed.add(faces[i] * vertexCount + faces[next(i)]);
  for (let i = 0; i < faces.length; i += 1) {
    if (!directed.has(faces[next(i)] * vertexCount + faces[i])) return THREE.DoubleSide;
  }
  return THREE.FrontSide;
}

/** Have a material draw a side. */
export const face = (material, side) => Object.assign(material, { side, needsUpdate: true });

/** A geometry for shapes with these faces; positions and colours come later. */
export function geometryOf(faces, vertexCount) {
  const geometry = new THREE.BufferGeometry();
  const Index = vertexCount < 65536 ? Uint16Array : Uint32Array;
  geometry.setIndex(new THREE.BufferAttribute(Index.from(faces), 1));
  for (const name of ["position", "normal", "color"]) {
    const values = new THREE.BufferAttribute(new Float32Array(3 * vertexCount), 3);
    geometry.setAttribute(name, values.setUsage(THREE.DynamicDrawUsage));
  }
  return geometry;
}

export function move(geometry, positions) {
  geometry.attributes.position.array.set(positions);
  geometry.attributes.position.needsUpdate = true;
  geometry.computeVertexNormals();
  geometry.boundingSphere = geometry.boundingBox = null;
}

/** Colour each vertex; without `colours` (3V numbers in linear sRGB) the whole surface in its own. */
export function paint(geometry, colours) {
  const { array } = geometry.attributes.color;
  if (colours) array.set(colours);
  else for (let i = 0; i < array.length; i += 3) BASE.toArray(array, i);
  geometry.attributes.color.needsUpdate = true;
}
