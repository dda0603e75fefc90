/**
 * The first seconds: what this is, in a line, and moves of the shape along single coordinates until a hand
 * comes.
 */

import { find } from "../dom.js";
import { always } from "../memory.js";
import { eased, Reel } from "../path/reel.js";
import { meshOf } from "../server/shape-loop.js";

const MOVES = 3; // one in each of the first factors, which are the strongest
const REACH = 0.8; // of the way to the bound
const FRAMES = 8; // of the way there, and as many back
const PACE = 1.2; // seconds of the same
const TOUCHES = ["pointerdown", "click", "keydown", "wheel", "focusin", "drop", "hashchange"];

export class Welcome {
  #touched = null; // its signal says when anything has been
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

  /** Say what this is; the moves wait for the model. */
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

  /** Whether the moves play, or are to: nothing of that is anybody's doing. */
  get alone() {
    return this.#touched?.signal.aborted === false;
  }

  /** Play the moves, as often as they are let, and come back to the shape before. */
  async play() {
    if (!this.alone || this.#begun) return;
    this.#begun = true;
    const { store } = this;
    const { signal } = this.#touched;
    const { code: home } = store;
    const keyframes = this.#keyframes();
    const ways = keyframes.length - 1;
    try {
      const times = Array.from({ length: FRAMES * ways + 1 }, (_, k) => k / FRAMES);
      const reel = new Reel(store, store.space.along(keyframes, times), meshOf(store));
      signal.addEventListener("abort", () => reel.stop());
      await reel.reach(1);
      signal.throwIfAborted();
      signal.addEventListener("abort", () => store.set({ playing: false, code: home }));
      store.set({ playing: true });
      const began = performance.now();
      const step = (now) => {
        if (signal.aborted) return;
        const way = (Math.max(now - began, 0) / (1000 * PACE)) % ways;
        reel.show((Math.floor(way) + eased(way % 1)) / ways);
        requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    } catch {
      // Nobody has asked for it, and what is asked for next says what is wrong.
    }
  }

  /** From home along one coordinate and back, then along the next. */
  #keyframes() {
    const { code: home, model, space } = this.store;
    const ends = model.factors.slice(0, MOVES).map(({ start: k }) => {
      const way = space.period[k] ? space.period[k] / 4 : space.upper[k] - home[k];
      return home.with(k, space.wrap(k, home[k] + REACH * way));
    });
    return [home, ...ends.flatMap((end) => [end, home])];
  }
}
