/**
 * The welcome: one line about the page, and movements along single coordinates until the user does something.
 */

import { find } from "../dom.js";
import { always } from "../memory.js";
import { eased, Reel } from "../path/reel.js";
import { meshOf } from "../server/shape-loop.js";

const MOVES = 3; // movements, one in each of the first factors, which are the strongest
const REACH = 0.8; // share of the way to the bound
const FRAMES = 8; // frames of the way there, and the same number back
const PACE = 1.2; // seconds of one way
const TOUCHES = ["pointerdown", "click", "keydown", "wheel", "focusin", "drop", "hashchange"];

export class Welcome {
  #touched = null; // aborted by any action of the user
  #begun = false;

  /** @param {import("../store.js").Page} store */
  constructor(store, box) {
    this.store = store;
    this.box = box;
    find("[data-do=close]", box).addEventListener("click", () => {
      box.hidden = true;
      always.keep("welcomed", "yes");
    });
  }

  /** Show the line; the movements wait for the model. */
  open() {
    if (always.kept("welcomed")) return;
    this.box.hidden = false;
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    const touched = new AbortController();
    this.#touched = touched;
    for (const touch of TOUCHES) {
      addEventListener(touch, () => touched.abort(), {
        capture: true,
        passive: true,
        signal: touched.signal,
      });
    }
  }

  /** Return whether movements play or will play, which are no actions of the user. */
  get alone() {
    return this.#touched?.signal.aborted === false;
  }

  /** Play the movements until the user acts, and return to the shape before. */
  async play() {
    if (!this.alone || this.#begun) return;
    this.#begun = true;
    const { store } = this;
    const { signal } = this.#touched;
    const { code: home, space } = store;
    const keyframes = this.#keyframes();
    const ways = keyframes.length - 1;
    try {
      const times = Array.from({ length: FRAMES * ways + 1 }, (_, k) => k / FRAMES);
      const reel = new Reel(store, space.along(keyframes, times), meshOf(store));
      signal.addEventListener("abort", () => reel.stop());
      await reel.reach(1);
      signal.throwIfAborted();
      if (store.space !== space) return; // an address has opened another model
      signal.addEventListener("abort", () => {
        if (store.space === space) store.set({ playing: false, code: home });
      });
      store.set({ playing: true });
      const began = performance.now();
      const step = (now) => {
        if (signal.aborted || store.space !== space) return;
        const way = (Math.max(now - began, 0) / (1000 * PACE)) % ways;
        reel.show((Math.floor(way) + eased(way % 1)) / ways);
        requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    } catch {
      // The user did not ask for it, and the next request reports the fault.
    }
  }

  /** Return codes from home along one coordinate and back, then along the next. */
  #keyframes() {
    const { code: home, model, space } = this.store;
    const ends = model.factors.slice(0, MOVES).map(({ start: k }) => {
      const way = space.period[k] ? space.period[k] / 4 : space.upper[k] - home[k];
      return home.with(k, space.wrap(k, home[k] + REACH * way));
    });
    return [home, ...ends.flatMap((end) => [end, home])];
  }
}
