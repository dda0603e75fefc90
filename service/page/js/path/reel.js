/** The frames of a path: they come from the server a few at a time, and are shown at any time between two. */

import * as api from "../server/api.js";
import { motionOf } from "../server/shape-loop.js";

const AT_ONCE = 12; // frames of a call: the first are there soon, and calls are few

/** From 0 to 1, slow at both ends. */
export const eased = (share) => share * share * (3 - 2 * share);

export class Reel {
  #abort = new AbortController();
  #shapes = []; // positions (3V numbers) of the frames that are there, the first ones
  #parts = []; // promises of what each call brings

  /**
   * Ask for the frames, as drafts.
   * @param {import("../store.js").Page} store
   * @param {number[][]} codes of all frames
   * @param {"coarse" | "fine"} mesh
   * @param {{loop?: boolean, tell?: (there: number) => void}} [how] whether the first frame follows on the
   *   last, and who is told how many have come
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
      last.catch(() => {}); // those who wait for it are told
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

  /** Ask for no more; who waits gets an AbortError. */
  stop() {
    this.#abort.abort();
  }

  /** The later one of the frames that are seen at a share of the path. */
  #after(share) {
    return Math.min(Math.ceil(share * this.steps), this.codes.length - 1);
  }

  /** Wait for what is seen at a share (0 … 1) of the path, and all before it. */
  async reach(share) {
    await this.#parts[Math.floor(this.#after(share) / AT_ONCE)];
  }

  /** Whether that is there. */
  has(share) {
    return this.#after(share) < this.#shapes.length;
  }

  /** Show the shape at a share of the path: between two frames a mixture of both. */
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
