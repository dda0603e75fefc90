/** Groups the events of one movement of a slider into one step: a drag, or several keys in a row. */

const REST = 700; // ms without a key until a movement by keys ends

export class Hand {
  #held = false;
  #timer = 0;

  /** @param {import("./store.js").Page} store whose `moving` is true during a movement */
  constructor(store) {
    this.store = store;
    // A drag may end anywhere in the window.
    for (const end of ["pointerup", "pointercancel", "blur"]) addEventListener(end, () => this.#let());
    // Before a pull begins: the slider loses the focus only after that.
    addEventListener("pointerdown", () => this.#timer && this.#let(), { capture: true });
  }

  /** Watch a slider. */
  on(slider) {
    slider.addEventListener("pointerdown", () => this.#take());
    slider.addEventListener("keydown", (event) => this.#typed(event));
    slider.addEventListener("blur", () => this.#let());
  }

  /** A shortcut such as undo ends a movement. */
  #typed({ key, ctrlKey, metaKey }) {
    if (ctrlKey || metaKey) this.#let();
    else if (/^(Arrow|Page|Home|End)/.test(key)) {
      this.#take();
      clearTimeout(this.#timer);
      this.#timer = setTimeout(() => this.#let(), REST);
    }
  }

  #take() {
    this.#held = true;
    this.store.set({ moving: true });
  }

  #let() {
    clearTimeout(this.#timer);
    this.#timer = 0;
    if (!this.#held) return;
    this.#held = false;
    this.store.set({ moving: false });
  }
}
