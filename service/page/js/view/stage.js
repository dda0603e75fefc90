/** The ground below the shape: a disc that fades into the page, and a soft shadow. */

import * as THREE from "three";

const WIDTH = 1.5; // of the disc and of the shadow, in radii of the model
const CELLS = 96; // along each side of the shadow
const BLUR = 2; // cells on each side that a blur averages
// Shadows of parts on the ground and of parts above it: darkness, height at which it ends, and number of
// blurs. Where feet touch the ground, their shadow is sharper.
const CONTACT = { dark: 0.62, end: 0.08, blurred: 1 };
const BODY = { dark: 0.26, end: 1.6, blurred: 5 };

export class Stage extends THREE.Group {
  #disc;
  #shadow;
  #radius = 1;
  #alpha = new Uint8Array(4 * CELLS * CELLS); // alpha of black pixels
  #seen = new Float32Array(CELLS * CELLS);
  #touched = new Float32Array(CELLS * CELLS);
  #spare = new Float32Array(CELLS * CELLS);

  constructor() {
    super();
    const flat = { transparent: true, depthWrite: false, toneMapped: false };
    const disc = new THREE.RingGeometry(0, 1, 64, 24);
    const { position } = disc.attributes;
    const fade = Float32Array.from(
      { length: position.count },
      (_, i) => 1 - THREE.MathUtils.smoothstep(Math.hypot(position.getX(i), position.getY(i)), 0.25, 0.9),
    );
    const colours = Float32Array.from({ length: 4 * fade.length }, (_, i) =>
      i % 4 < 3 ? 1 : fade[(i - 3) / 4],
    );
    disc.setAttribute("color", new THREE.BufferAttribute(colours, 4));
    this.#disc = new THREE.Mesh(disc, new THREE.MeshBasicMaterial({ ...flat, vertexColors: true }));
    const map = new THREE.DataTexture(this.#alpha, CELLS, CELLS);
    map.magFilter = map.minFilter = THREE.LinearFilter;
    this.#shadow = new THREE.Mesh(
      new THREE.PlaneGeometry(2, 2),
      new THREE.MeshBasicMaterial({ ...flat, map }),
    );
    this.#disc.renderOrder = -2;
    this.#shadow.renderOrder = -1;
    this.add(this.#disc, this.#shadow);
    this.rotation.x = -Math.PI / 2; // both lie flat, visible from above only
  }

  /** Move below the middle of a model. */
  open({ center, radius }) {
    this.position.copy(center);
    this.#radius = WIDTH * radius;
    this.scale.setScalar(this.#radius);
  }

  /** Set the disc's colour by the theme. */
  set colour(colour) {
    this.#disc.material.color.set(colour);
  }

  /** Move below positions (3V numbers) after a motion (Matrix4), and draw their shadow. */
  under(positions, faces, motion) {
    const points = new Float32Array(positions.length);
    const point = new THREE.Vector3();
    let low = Infinity;
    for (let i = 0; i < positions.length; i += 3) {
      point.fromArray(positions, i).applyMatrix4(motion).toArray(points, i);
      low = Math.min(low, point.y);
    }
    this.position.y = low;
    this.#seen.fill(0);
    this.#touched.fill(0);
    for (let i = 0; i < points.length; i += 3) this.#cast(points[i], points[i + 1], points[i + 2]);
    // Corners alone would leave holes in large faces.
    for (let f = 0; f < faces.length; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const middle = (axis) => (points[a + axis] + points[b + axis] + points[c + axis]) / 3;
      this.#cast(middle(0), middle(1), middle(2));
    }
    for (let times = BODY.blurred; times > 0; times -= 1) {
      if (times === CONTACT.blurred) this.#touched.forEach((dark, i) => (this.#seen[i] += dark));
      this.#blur();
    }
    for (let i = 0; i < this.#seen.length; i += 1) this.#alpha[4 * i + 3] = 255 * this.#seen[i];
    this.#shadow.material.map.needsUpdate = true;
  }

  /** Darken the cell under a point; the lowest of several points counts. */
  #cast(x, y, z) {
    const cell = (offset) => Math.floor((offset / this.#radius + 1) * (CELLS / 2));
    const [column, row] = [cell(x - this.position.x), cell(this.position.z - z)];
    if (column < 0 || row < 0 || column >= CELLS || row >= CELLS) return;
    const height = ((y - this.position.y) / this.#radius) * WIDTH;
    const at = row * CELLS + column;
    const darken = (cells, { dark, end }) => {
      cells[at] = Math.max(cells[at], dark * Math.max(1 - height / end, 0) ** 2);
    };
    darken(this.#seen, BODY);
    darken(this.#touched, CONTACT);
  }

  /** Average neighbouring cells along one axis and transpose; two calls blur along both axes. */
  #blur() {
    for (let turn = 0; turn < 2; turn += 1) {
      const [from, to] = [this.#seen, this.#spare];
      for (let row = 0; row < CELLS; row += 1) {
        let sum = 0;
        for (let k = 0; k < BLUR; k += 1) sum += from[row * CELLS + k];
        for (let column = 0; column < CELLS; column += 1) {
          if (column + BLUR < CELLS) sum += from[row * CELLS + column + BLUR];
          if (column - BLUR > 0) sum -= from[row * CELLS + column - BLUR - 1];
          to[column * CELLS + row] = sum / (2 * BLUR + 1);
        }
      }
      [this.#seen, this.#spare] = [to, from];
    }
  }
}
