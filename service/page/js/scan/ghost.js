/** A scan as points over the shape, placed by its fit. */

import * as THREE from "three";
import { distant } from "../view/colours.js";
import { matrixOf } from "../view/pose.js";
import { sameCode } from "../server/space.js";

// Size of a point for three.js, in radii of the model: about a hundredth of the radius in the picture
const SIZE = 0.04;

/**
 * Shows `store.scan` while `store.ghost` is on. Colours are distances while the fitted shape is shown.
 */
export class Ghost {
  #scan = null;

  /** @param {import("../store.js").Page} store */
  constructor(store, viewer) {
    this.store = store;
    this.viewer = viewer;
    const material = new THREE.PointsMaterial({ vertexColors: true, transparent: true, opacity: 0.85 });
    this.points = new THREE.Points(new THREE.BufferGeometry(), material);
    this.points.frustumCulled = this.points.visible = this.points.matrixAutoUpdate = false;
    viewer.scene.add(this.points);
    store.on(["scan", "ghost", "code"], () => this.#show());
  }

  #show() {
    const { scan, ghost, code } = this.store;
    const visible = Boolean(scan) && ghost;
    if (!visible && !this.points.visible) return;
    if (scan && scan !== this.#scan) this.#take(scan);
    this.points.visible = visible;
    if (visible) this.#paint(scan, sameCode(code, scan.latent));
    this.viewer.draw();
  }

  #take(scan) {
    this.#scan = scan;
    this.points.geometry.dispose();
    this.points.geometry = new THREE.BufferGeometry();
    const attribute = new THREE.Float32BufferAttribute(scan.used.positions.flat(), 3);
    this.points.geometry.setAttribute("position", attribute);
    this.points.geometry.setAttribute(
      "color",
      new THREE.BufferAttribute(new Float32Array(attribute.array.length), 3),
    );
    const there = matrixOf(scan.placement);
    this.points.matrix.copy(there).invert();
    this.points.updateMatrixWorld(true);
    this.points.material.size = SIZE * this.viewer.sphere.radius;
  }

  #paint({ used, limit }, own) {
    const { color } = this.points.geometry.attributes;
    if (own) color.array.set(distant(used.distances, limit));
    else color.array.fill(0.25);
    color.needsUpdate = true;
  }
}
