/** Another shape beside the one of the sliders, to compare them. */

import * as THREE from "three";
import * as api from "../server/api.js";
import { report } from "../messages.js";
import { VIEW, face, geometryOf, move, paint, surfaceMaterial } from "../view/scene.js";
import { meshOf } from "../server/shape-loop.js";

const APART = 1.1; // of the reference's width, from middle to middle
/** Across the view that shapes are seen from first, so that both are as near. */
const SIDEWAYS = new THREE.Vector3(VIEW.z, 0, -VIEW.x).normalize();

export class Beside {
  #asked = null;

  /** @param {import("../store.js").Page} store */
  constructor(store, viewer) {
    this.store = store;
    this.viewer = viewer;
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), surfaceMaterial());
    this.mesh.frustumCulled = this.mesh.visible = false;
    viewer.scene.add(this.mesh);
    store.on(["other", "model", "fine", "hasFine"], () => this.#fetch());
  }

  #fetch() {
    const { model, other, references } = this.store;
    const mesh = meshOf(this.store);
    this.#asked = other;
    if (!other) {
      if (this.mesh.visible) this.viewer.makeRoom(null);
      this.mesh.visible = false;
      this.viewer.draw();
      return;
    }
    api
      .shapes(model, [other], mesh)
      .then(({ shapes }) => {
        if (this.#asked === other && this.store.model === model) this.#show(references[mesh], shapes[0]);
      })
      .catch(report);
  }

  /** Positions where they are seen. */
  #places(positions) {
    const point = new THREE.Vector3();
    const there = new Float32Array(positions.length);
    for (let i = 0; i < positions.length; i += 3) {
      point.fromArray(positions, i).add(this.mesh.position).toArray(there, i);
    }
    return there;
  }

  #show({ faces, vertices }, positions) {
    this.mesh.geometry.dispose();
    this.mesh.geometry = geometryOf(faces, vertices.length / 3);
    move(this.mesh.geometry, positions);
    paint(this.mesh.geometry, null);
    face(this.mesh.material, this.viewer.side);
    this.mesh.position.copy(SIDEWAYS).multiplyScalar(APART * extent(vertices, SIDEWAYS));
    this.mesh.updateMatrixWorld(true);
    if (!this.mesh.visible) this.viewer.makeRoom(this.#places(positions));
    this.mesh.visible = true;
    this.viewer.draw();
  }
}

/** How far positions (3V numbers) reach along a direction. */
function extent(positions, direction) {
  let [least, most] = [Infinity, -Infinity];
  const point = new THREE.Vector3();
  for (let i = 0; i < positions.length; i += 3) {
    const along = point.fromArray(positions, i).dot(direction);
    least = Math.min(least, along);
    most = Math.max(most, along);
  }
  return most - least;
}
