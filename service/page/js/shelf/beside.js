/** A second shape beside the shape of the sliders, to compare them. */

import * as THREE from "three";
import * as api from "../server/api.js";
import { report } from "../messages.js";
import { VIEW, geometryOf, move } from "../view/scene.js";
import { meshOf } from "../server/shape-loop.js";

const APART = 1.1; // distance between the middles, in widths of the reference
/** Direction across the initial view, so that both shapes are at one distance. */
const SIDEWAYS = new THREE.Vector3(VIEW.z, 0, -VIEW.x).normalize();

export class Beside {
  #asked = { model: null, other: null, mesh: null };
  #given = false; // whether the view comes from the same address as the shape

  /** @param {import("../store.js").Page} store */
  constructor(store, viewer) {
    this.store = store;
    this.viewer = viewer;
    this.mesh = new THREE.Mesh();
    this.mesh.frustumCulled = false;
    this.ground = viewer.ground();
    this.#appear(false);
    viewer.scene.add(this.mesh);
    store.on(["other", "model", "fine", "hasFine"], () => this.#fetch());
    store.on(["ground"], () => this.#appear(this.mesh.visible));
  }

  #appear(is) {
    this.mesh.visible = is;
    this.ground.visible = is && this.store.ground;
  }

  #fetch() {
    const { model, other, references } = this.store;
    const before = this.#asked;
    const asked = { model, other, mesh: meshOf(this.store) };
    this.#asked = asked;
    if (before.model !== model) {
      this.#given = Boolean(other);
      this.#appear(false); // the viewer has a new model
    } else if (before.other !== other) this.#given = false;
    if (!other) {
      if (this.mesh.visible) this.viewer.makeRoom(null);
      this.#appear(false);
      this.viewer.draw();
      return;
    }
    api
      .shapes(model, [other], asked.mesh)
      .then(({ shapes }) => {
        // Answers may come out of order, as a coarse shape after the fine one.
        if (this.#asked === asked) this.#show(references[asked.mesh], shapes[0]);
      })
      .catch(report);
  }

  #show({ faces, vertices }, positions) {
    const { geometry, position } = this.mesh;
    geometry.dispose();
    this.mesh.geometry = geometryOf(faces, vertices.length / 3);
    move(this.mesh.geometry, positions);
    this.viewer.cover(this.mesh);
    position.copy(SIDEWAYS).multiplyScalar(APART * extent(vertices, SIDEWAYS));
    this.mesh.updateMatrixWorld(true);
    const { center, radius } = this.viewer.sphere;
    this.ground.open({ center: center.clone().add(position), radius });
    this.ground.under(positions, faces, this.mesh.matrixWorld);
    this.viewer.makeRoom(moved(positions, position), this.#given);
    this.#appear(true);
    this.viewer.draw();
  }
}

/** Return shifted positions (3V numbers). */
function moved(positions, by) {
  const axes = by.toArray();
  return positions.map((x, i) => x + axes[i % 3]);
}

/** Return the extent of positions (3V numbers) along a direction. */
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
