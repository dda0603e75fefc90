/** What the large view and the small pictures have in common: surface, light, and where one looks from. */

import * as THREE from "three";

/** Towards the viewer, from which models are seen first. */
export const VIEW = new THREE.Vector3(0.45, 0.28, 1).normalize();
const FIELD = 28; // degrees
export const BASE = new THREE.Color(0xc7d0da);

export function surfaceMaterial() {
  return new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.62, metalness: 0, side: THREE.DoubleSide });
}

/** A camera that carries its lights along, so that what one looks at is lit. */
export function litCamera() {
  const camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
  const key = new THREE.DirectionalLight(0xfff6ea, 2.3);
  key.position.set(-1.2, 1.6, 1.4);
  const fill = new THREE.DirectionalLight(0xdfe9ff, 0.55);
  fill.position.set(1.6, -0.4, 1);
  camera.add(key, key.target, fill, fill.target, new THREE.HemisphereLight(0xffffff, 0x6d7786, 1.15));
  return camera;
}

/** Tangent of half the angle of a camera's height. */
const slope = (camera) => Math.tan((camera.fov * Math.PI) / 360);

/** How far a camera must be from a sphere to have it in view. */
const distanceOf = (camera, { radius }) => radius / Math.sin(Math.atan(slope(camera) * Math.min(camera.aspect, 1)));

/** How far it must be to have positions (3V numbers) in the width of its view and in a share of its height. */
export function distanceTo(camera, positions, center, share) {
  const back = new THREE.Quaternion().setFromRotationMatrix(
    new THREE.Matrix4().lookAt(VIEW, new THREE.Vector3(), camera.up)).invert();
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
    squared = Math.max(squared, center.distanceToSquared({ x: positions[i], y: positions[i + 1], z: positions[i + 2] }));
  }
  return new THREE.Sphere(center, Math.sqrt(squared));
}

/** Of the box around positions (3V numbers). */
export const diagonalOf = (positions) => new THREE.Box3().setFromArray(positions).getSize(new THREE.Vector3()).length();

/** A geometry for shapes with these faces; positions and colours come later. */
export function geometryOf(faces, vertexCount) {
  const geometry = new THREE.BufferGeometry();
  const Index = vertexCount < 65536 ? Uint16Array : Uint32Array;
  geometry.setIndex(new THREE.BufferAttribute(Index.from(faces), 1));
  for (const name of ["position", "normal", "color"]) {
    geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(3 * vertexCount), 3).setUsage(THREE.DynamicDrawUsage));
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
