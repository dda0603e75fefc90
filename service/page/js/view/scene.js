/** Parts of the large view and the small pictures: surface, light, and camera. */

import * as THREE from "three";

/** Direction from the model to the initial camera. */
export const VIEW = new THREE.Vector3(0.45, 0.28, 1).normalize();
const FIELD = 28; // degrees of the camera's height
/** Colour of clay. */
export const BASE = new THREE.Color(0xdac6b4);

export function surfaceMaterial() {
  return new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.8, metalness: 0 });
}

/** A camera with lights that move with it, so that the visible side is lit. */
export function litCamera() {
  const camera = new THREE.PerspectiveCamera(FIELD, 1, 0.01, 100);
  const light = (colour, x = 0, y = 0, z = 0) => {
    const made = new THREE.DirectionalLight(colour);
    made.position.set(x, y, z);
    camera.add(made, made.target);
    return made;
  };
  const key = light(0xfff1e0);
  const fill = light(0xe4ecff, 1.8, -0.2, 1);
  const rim = light(0xdce8ff, 1.1, 0.9, -1.5); // from behind
  const around = new THREE.HemisphereLight(0xffffff, 0x8a7a70);
  camera.add(around);
  camera.userData.lights = [key, fill, rim, around];
  illuminate(camera, "studio");
  return camera;
}

/** Strengths of the key, fill and rim lights and of the light from all around, and the key's position. */
const LIGHTS = {
  studio: { strengths: [2.1, 0.4, 2.2, 1.05], key: [-1.2, 1.7, 1.5] },
  soft: { strengths: [0.9, 0.6, 0.8, 2.1], key: [-0.4, 1.2, 2] },
  side: { strengths: [3.6, 0.08, 2.6, 0.22], key: [-2.2, 0.9, 0.2] },
};

/** Set the light of a camera by its name. */
export function illuminate(camera, name) {
  const { strengths, key } = LIGHTS[name];
  const { lights } = camera.userData;
  strengths.forEach((strength, k) => Object.assign(lights[k], { intensity: strength }));
  lights[0].position.set(...key);
}

/** Return the tangent of half the angle of a camera's height. */
const slope = (camera) => Math.tan((camera.fov * Math.PI) / 360);

/** Return the distance of a camera from a sphere that fills its view. */
const distanceOf = (camera, { radius }) =>
  radius / Math.sin(Math.atan(slope(camera) * Math.min(camera.aspect, 1)));

/**
 * Return the distance at which positions (3V numbers) fit the width and a share of the height of the view,
 * for a camera in a direction from the centre.
 */
export function distanceTo(camera, positions, center, share, direction = VIEW) {
  const back = new THREE.Quaternion()
    .setFromRotationMatrix(new THREE.Matrix4().lookAt(direction, new THREE.Vector3(), camera.up))
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

/** Put a camera at a distance from the centre of a sphere; by default the sphere fills the view. */
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

/** Return the sphere around the bounding box of positions (3V numbers). */
export const diagonalOf = (positions) =>
  new THREE.Box3().setFromArray(positions).getSize(new THREE.Vector3()).length();

/**
 * Return the side of faces to draw: the outer side of closed surfaces, whose inner side would show along
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

/** Set the drawn side of a material. */
export const face = (material, side) => Object.assign(material, { side, needsUpdate: true });

/** Return a geometry for shapes with some faces; positions and colours come later. */
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

/** Colour each vertex by `colours` (3V numbers in linear sRGB); without them, use the surface's colour. */
export function paint(geometry, colours, base = BASE) {
  const { array } = geometry.attributes.color;
  if (colours) array.set(colours);
  else for (let i = 0; i < array.length; i += 3) base.toArray(array, i);
  geometry.attributes.color.needsUpdate = true;
}
