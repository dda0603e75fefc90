/** Vertices of the shown mesh in the picture: which of them a place means, and where they are drawn. */

import { Raycaster, Vector2, Vector3 } from "three";

export class Picker {
  /** @param {import("three").Mesh} mesh the shown mesh; its geometry may change */
  constructor(canvas, camera, mesh) {
    this.canvas = canvas;
    this.camera = camera;
    this.mesh = mesh;
  }

  /**
   * Return the vertex nearest to the surface under a place of the window. Beside the shape, return the vertex
   * that is drawn nearest, at most `reach` pixels away, or null.
   */
  pick(place, reach) {
    const caster = new Raycaster();
    caster.setFromCamera(this.#inPicture(place), this.camera);
    const hit = caster.intersectObject(this.mesh)[0];
    if (!hit) return this.#near(place, reach);
    const corners = [hit.face.a, hit.face.b, hit.face.c];
    const away = (vertex) => this.at(vertex).distanceTo(hit.point);
    const vertex = corners.reduce((a, b) => (away(a) <= away(b) ? a : b));
    return { vertex, position: this.at(vertex) };
  }

  #near({ clientX, clientY }, reach) {
    const box = this.canvas.getBoundingClientRect();
    let [least, found] = [reach, null];
    for (let vertex = 0; vertex < this.mesh.geometry.attributes.position.count; vertex += 1) {
      const { x, y } = this.project(this.at(vertex));
      const far = Math.hypot(x - clientX + box.left, y - clientY + box.top);
      if (far < least) [least, found] = [far, vertex];
    }
    return found === null ? null : { vertex: found, position: this.at(found) };
  }

  /** Return the position of a vertex in the scene. */
  at(vertex) {
    const { geometry, matrixWorld } = this.mesh;
    return new Vector3().fromBufferAttribute(geometry.attributes.position, vertex).applyMatrix4(matrixWorld);
  }

  /** Positions of all vertices in the scene, 3V numbers. */
  get positions() {
    const positions = new Float32Array(this.mesh.geometry.attributes.position.array.length);
    for (let i = 0; i < positions.length; i += 3) this.at(i / 3).toArray(positions, i);
    return positions;
  }

  /** Return where a point of the scene is drawn, in pixels from the upper left of the picture. */
  project(position) {
    const { x, y } = position.clone().project(this.camera);
    return { x: ((x + 1) / 2) * this.canvas.clientWidth, y: ((1 - y) / 2) * this.canvas.clientHeight };
  }

  /** Return the point of the scene at a place of the window, as deep as another point. */
  unproject(place, depth) {
    const { x, y } = this.#inPicture(place);
    return new Vector3(x, y, depth.clone().project(this.camera).z).unproject(this.camera);
  }

  /** Return a place of the window in the coordinates of the picture, −1 … 1. */
  #inPicture({ clientX, clientY }) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [(clientX - box.left) / box.width, (clientY - box.top) / box.height];
    return new Vector2(2 * x - 1, 1 - 2 * y);
  }
}
