/** Undo and redo of codes, placements of pulled shapes, and pins. Each finished movement is a step. */

import { sameCode } from "./server/space.js";

const LONGEST = 200;
const TYPED = "input:not([type=range], [type=checkbox], [type=radio])";

export class History {
  #steps = [];
  #at = -1;

  /** @param {import("./store.js").Page} store */
  constructor(store, { undo, redo }) {
    this.store = store;
    this.undo = undo;
    this.redo = redo;
    store.on(["space"], () => {
      this.#steps = [];
      this.#at = -1;
    });
    store.on(["space", "code", "moving", "playing", "pins"], () => this.#record());
    undo.addEventListener("click", () => this.#go(-1));
    redo.addEventListener("click", () => this.#go(1));
    addEventListener("keydown", (event) => {
      if (!(event.ctrlKey || event.metaKey) || event.altKey) return;
      const { target } = /** @type {{target: any}} */ (event);
      if (target.matches?.(TYPED)) return; // the browser undoes the typing
      const key = event.key.toLowerCase();
      if (key !== "z" && key !== "y") return;
      event.preventDefault();
      this.#go(key === "y" || event.shiftKey ? 1 : -1);
    });
  }

  #record() {
    const { code, placement, pins, moving, playing } = this.store;
    if (!code || moving || playing) return;
    if (this.#at < 0 || !sameCode(code, this.#steps[this.#at].code)) {
      this.#steps = [...this.#steps.slice(0, this.#at + 1), { code, placement, pins }].slice(-LONGEST);
      this.#at = this.#steps.length - 1;
    } else this.#steps[this.#at].pins = pins; // pins were added or removed without a change of shape
    this.#show();
  }

  #go(by) {
    const step = this.#steps[this.#at + by];
    if (!step || this.store.playing) return;
    this.#at += by;
    this.store.set(step);
    this.#show();
  }

  #show() {
    this.undo.disabled = this.#at <= 0;
    this.redo.disabled = this.#at >= this.#steps.length - 1;
    this.undo.title = `Undo (Ctrl+Z), ${this.#at} ${this.#at === 1 ? "step" : "steps"}`;
  }
}
