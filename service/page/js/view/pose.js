/** The position of a fine shape relative to the coarse shape of the same code. */

import { Matrix4, Vector3 } from "three";
import { nearest } from "./modes.js";

const at = (positions, vertex) => new Vector3().fromArray(positions, 3 * vertex);

/**
 * The server aligns every mesh to its own reference over its own vertices, whose density differs. Without a
 * correction, the shape would jump between the coarse and the fine mesh of one code.
 */
export class Pose {
  #coarse;
  #fine;

  /** Choose three distant vertices from the positions of both references; they determine the pose. */
  constructor(coarse, fine) {
    const farthest = (distance) => {
      let best = 0;
      for (let v = 1; v < coarse.length / 3; v += 1)
        if (distance(at(coarse, v)) > distance(at(coarse, best))) best = v;
      return best;
    };
    const a = farthest((x) => x.distanceTo(at(coarse, 0)));
    const b = farthest((x) => x.distanceTo(at(coarse, a)));
    const side = at(coarse, b).sub(at(coarse, a));
    const c = farthest((x) => x.sub(at(coarse, a)).cross(side).length());
    this.#coarse = [a, b, c];
    const corners = new Float32Array(this.#coarse.flatMap((v) => at(coarse, v).toArray()));
    this.#fine = nearest(corners, fine);
  }

  /** Return the motion (Matrix4) from a fine shape to the coarse shape of its code. */
  motion(fine, coarse) {
    return frame(coarse, this.#coarse).multiply(frame(fine, this.#fine).invert());
  }
}

function frame(positions, corners) {
  const [a, b, c] = Array.from(corners, (v) => at(positions, v));
  const x = b.sub(a).normalize();
  const z = x.clone().cross(c.sub(a)).normalize();
  return new Matrix4().makeBasis(x, z.clone().cross(x), z).setPosition(a);
}

/**
 * Return a placement of the server as a Matrix4.
 * @typedef {[number, number, number]} Row
 * @param {{rotation: [Row, Row, Row], translation: Row, scale: number}} placement
 */
export function matrixOf({ rotation: [a, b, c], translation: [x, y, z], scale }) {
  const motion = new Matrix4().set(...a, x, ...b, y, ...c, z, 0, 0, 0, 1);
  return motion.multiply(new Matrix4().makeScale(scale, scale, scale));
}
