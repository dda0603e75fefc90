/** A slider from the present shape to the shape beside it. */

import { find } from "../dom.js";

export class Blend {
  #from = null; // the code at its start
  #own = null; // its last code

  /** @param {import("../store.js").Page} store */
  constructor(store, hand, box) {
    this.store = store;
    this.slider = find("input", box);
    hand.on(this.slider);
    this.slider.addEventListener("input", () => this.#move(this.slider.valueAsNumber));
    store.on(["other"], () => {
      box.hidden = !store.other;
      this.#start();
    });
    store.on(["code"], () => {
      if (store.code !== this.#own) this.#start();
    });
  }

  /** Start again, at the present shape. */
  #start() {
    this.#from = this.#own = null;
    this.slider.value = 0;
    this.#tell();
  }

  #move(share) {
    const { code, locked, other, space } = this.store;
    this.#from ??= code;
    const [there] = space.along([this.#from, other], [share]);
    this.#own = there.map((value, k) => (locked[k] ? code[k] : value));
    this.store.set({ code: this.#own });
    this.#tell();
  }

  #tell() {
    this.slider.setAttribute("aria-valuetext", `${Math.round(100 * this.slider.valueAsNumber)} %`);
  }
}
