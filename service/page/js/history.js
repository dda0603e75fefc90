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
      this.#add(); // although something may move as a model opens
    });
    store.on(["code", "moving", "playing", "pins"], () => this.#record());
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
    const { code, pins, moving, playing } = this.store;
    if (!code || moving || playing) return;
    if (sameCode(code, this.#steps[this.#at].code))
      this.#steps[this.#at].pins = pins; // added or removed alone
    else this.#add();
    this.#show();
  }

  #add() {
    const { code, placement, pins } = this.store;
    this.#steps = [...this.#steps.slice(0, this.#at + 1), { code, placement, pins }].slice(-LONGEST);
    this.#at = this.#steps.length - 1;
    this.#show();
  }

  #go(by) {
    const to = this.#at + (by < 0 && this.store.moving ? 0 : by); // what still moves is undone first
    const step = this.#steps[to];
    if (!step || this.store.playing) return;
    this.#at = to;
    this.store.set({ ...step, code: [...step.code] }); // as a change, which ends a pull
    this.#show();
  }

  #show() {
    this.undo.disabled = this.#at <= 0;
    this.redo.disabled = this.#at >= this.#steps.length - 1;
    this.undo.title = `Undo (Ctrl+Z), ${this.#at} ${this.#at === 1 ? "step" : "steps"}`;
  }
}
