/** The frames of a path, loaded in batches, with interpolation between two frames. */

import * as api from "../server/api.js";
import { motionOf } from "../server/shape-loop.js";

const AT_ONCE = 12; // frames in a call: few enough for a quick start, and many enough for few calls

/** Map 0 … 1 to itself, slow at both ends (smoothstep). */
export const eased = (share) => share * share * (3 - 2 * share);

export class Reel {
  #abort = new AbortController();
  #shapes = []; // positions (3V numbers) of the loaded frames, from the first
  #parts = []; // promises of the frames of each call

  /**
   * Request the frames, as drafts.
   * @param {import("../store.js").Page} store
   * @param {number[][]} codes of all frames
   * @param {"coarse" | "fine"} mesh
   * @param {{loop?: boolean, tell?: (there: number) => void}} [how] whether the first frame follows the
   *   last, and a callback with the number of loaded frames
   */
  constructor(store, codes, mesh, { loop = false, tell = () => {} } = {}) {
    this.store = store;
    this.codes = codes;
    this.mesh = mesh;
    this.steps = loop ? codes.length : codes.length - 1;
    this.tell = tell;
    let last = Promise.resolve();
    for (let k = 0; k < codes.length; k += AT_ONCE) {
      last = last.then(() => this.#fetch(store.model, codes.slice(k, k + AT_ONCE)));
      last.catch(() => {}); // callers that wait for it get the error
      this.#parts.push(last);
    }
  }

  async #fetch(model, codes) {
    const { signal } = this.#abort;
    const { shapes } = await api.shapes(model, codes, this.mesh, { quality: "draft", signal });
    signal.throwIfAborted();
    this.#shapes.push(...shapes);
    this.tell(this.#shapes.length);
  }

  /** Stop loading; callers that wait get an AbortError. */
  stop() {
    this.#abort.abort();
  }

  /** Return the later of the two frames around a share of the path. */
  #after(share) {
    return Math.min(Math.ceil(share * this.steps), this.codes.length - 1);
  }

  /** Wait for all frames up to a share (0 … 1) of the path. */
  async reach(share) {
    await this.#parts[Math.floor(this.#after(share) / AT_ONCE)];
  }

  /** Return whether these frames are loaded. */
  has(share) {
    return this.#after(share) < this.#shapes.length;
  }

  /** Show the shape at a share of the path, interpolated between two frames. */
  show(share) {
    const { codes, mesh, steps, store } = this;
    const at = share * steps;
    const k = Math.min(Math.floor(at), steps - 1);
    const rest = at - k;
    const next = this.#shapes[(k + 1) % codes.length];
    const positions = this.#shapes[k].map((x, i) => x + rest * (next[i] - x));
    const code = codes[(rest < 0.5 ? k : k + 1) % codes.length];
    const { model, placement } = store;
    const motion = motionOf(store, mesh, code, positions);
    const began = performance.now();
    store.set({ code, shape: { model, mesh, code, placement, motion, positions, diagnostics: null, began } });
  }
}
