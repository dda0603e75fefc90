/**
 * The state of the page, with listeners for its changes.
 *
 * @typedef {object} Shape the shown shape
 * @property {object} model
 * @property {"coarse" | "fine"} mesh
 * @property {number[]} code
 * @property {Float32Array} positions 3V numbers
 * @property {import("three").Matrix4 | null} placement motion by a pull
 * @property {import("three").Matrix4} motion from the server's position to the shown one
 * @property {object | null} diagnostics null for frames of a path
 * @property {"draft" | "full"} [quality]
 * @property {number} began time of the request
 *
 * @typedef {object} State
 * @property {any} model as the server lists it
 * @property {import("./server/space.js").LatentSpace | null} space
 * @property {Names | null} names
 * @property {import("./shape/motions.js").Motion[] | null} motions by coordinate, once they are computed
 * @property {{coarse?: Reference, fine?: Reference}} references
 * @property {boolean} hasFine
 * @property {import("./view/pose.js").Pose | null} pose if there is a fine mesh
 * @property {number[] | null} code
 * @property {boolean[]} locked by coordinate
 * @property {import("three").Matrix4 | null} placement
 * @property {boolean} moving whether the user moves something; all changes meanwhile are one step
 * @property {boolean} playing
 * @property {Shape | null} shape
 * @property {number[] | null} failed the last code that has no shape
 * @property {number[][]} keyframes
 * @property {boolean} loop
 * @property {number} beyond share of the path that is played before its start and after its end
 * @property {number | null} seconds length of the path, if the user has set it
 * @property {"even" | "soft"} easing
 * @property {number | null} usual residual of the model's own shapes
 * @property {string} colour "none", "stretch", "bending", "distance" or "spread"
 * @property {number} against index of the keyframe that colours compare with; −1 the mean, −2 `other`
 * @property {number[] | null} other code of the shape beside, to compare with
 * @property {number | null} highlight index of the factor under the pointer
 * @property {Float32Array[] | null} regions weights of each factor at coarse vertices
 * @property {object | null} repaint a new object when colours must be computed again
 * @property {string} material "clay", "skin", "metal", "matcap" or "own"
 * @property {boolean} hasOwn whether the file's own material is there
 * @property {string} light "studio", "soft" or "side"
 * @property {boolean} ground
 * @property {boolean} wireframe
 * @property {boolean} normals
 * @property {boolean} fine
 * @property {boolean} pull
 * @property {import("./shape/pull.js").Pin[]} pins
 * @property {number | null} hover the vertex that a press would pull
 * @property {number | null} solving the vertex of the pin that the server is moving
 * @property {any} scan
 * @property {{code: number[], covariance: number[][]} | null} found the shape of a file
 * @property {boolean} ghost
 *
 * @typedef {object} Names
 * @property {string[]} factors
 * @property {string[]} labels of coordinates, shown below the factor's name
 * @property {string[]} coordinates full names
 * @property {import("./shape/motions.js").Motion[]} ends by coordinate, null where it has a name
 *
 * @typedef {{vertices: Float32Array, faces: Int32Array}} Reference
 * @typedef {Store & State} Page the store that all parts of the page use
 */
export class Store {
  #listeners = [];

  /** @param {State} values */
  constructor(values) {
    Object.assign(this, values);
  }

  /**
   * Call `listener` after each change of one of the `keys`.
   * @param {(keyof State)[]} keys
   * @param {() => void} listener
   */
  on(keys, listener) {
    this.#listeners.push([new Set(keys), listener]);
  }

  /**
   * Change some values at once. A listener for several of them is called once.
   * @param {Partial<State>} patch
   */
  set(patch) {
    const changed = Object.keys(patch).filter((key) => !Object.is(this[key], patch[key]));
    Object.assign(this, patch);
    if (changed.length === 0) return;
    for (const [keys, listener] of this.#listeners) {
      if (changed.some((key) => keys.has(key))) listener();
    }
  }
}
