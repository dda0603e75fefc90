/** A slider for each coordinate, grouped by factor. */

import { clone, find, readable, sharp } from "../dom.js";

const PICTURE = 44;
const FEW = 8; // most coordinates for which all factors are open at first
const LEAST = 3; // sliders that are open at first, whatever the number of coordinates

export class Sliders {
  #rows = [];

  /** @param {import("../store.js").Page} store */
  constructor(store, hand, list) {
    this.store = store;
    this.hand = hand;
    this.list = list;
    this.all = find("#reset-all");
    this.all.addEventListener("click", () => {
      this.#change(store.space.home);
      find("#undo").focus(); // the button has gone
    });
    store.on(["moving"], () => {
      if (store.moving) store.set({ highlight: null }); // a shape that moves keeps its colour
    });
    store.on(["space"], () => this.#build());
    store.on(["names"], () => this.#label());
    store.on(["code", "locked"], () => this.#show());
  }

  /** Return the canvases of coordinate k for the pictures of its two ends. */
  pictures(k) {
    return [...this.#rows[k].root.querySelectorAll("canvas")];
  }

  /** Return the canvas of factor j, for its region. */
  picture(j) {
    return find("summary canvas", this.list.children[j]);
  }

  #build() {
    const { model, space } = this.store;
    this.#rows = [];
    this.list.replaceChildren(
      ...model.factors.map((factor, j) => {
        const group = clone("factor");
        const rows = [];
        for (let k = factor.start; k < factor.stop; k += 1) rows.push(this.#row(k));
        find(".rows", group).append(...rows);
        find("details", group).open = factor.start < LEAST || model.latent_dimension <= FEW;
        sharp(find("summary canvas", group), PICTURE);
        find(":scope > [data-do=reset]", group).addEventListener("click", () => {
          this.#change(
            this.store.code.map((value, k) => (k >= factor.start && k < factor.stop ? space.home[k] : value)),
          );
          find("summary", group).focus(); // the button has gone
        });
        const light = (on) => () => {
          if (!this.store.moving) this.store.set({ highlight: on ? j : null });
        };
        group.addEventListener("pointerenter", light(true));
        group.addEventListener("pointerleave", light(false));
        group.addEventListener("focusin", light(true));
        group.addEventListener("focusout", light(false));
        return group;
      }),
    );
    this.#show();
  }

  /** Show all names. */
  #label() {
    const {
      names: { factors, labels, coordinates, ends },
      space,
    } = this.store;
    this.list.querySelectorAll(".factor").forEach((group, j) => {
      find("h2", group).textContent = factors[j];
      find(":scope > [data-do=reset]", group).setAttribute("aria-label", `Reset all of ${factors[j]}`);
    });
    this.#rows.forEach(({ root, slider, box, lock, reset, ways }, k) => {
      const name = coordinates[k];
      find(".name", root).textContent = labels[k];
      find(".name", root).title = name;
      slider.setAttribute("aria-label", name);
      box.setAttribute("aria-label", `${name}, number`);
      lock.setAttribute("aria-label", `Lock ${name}`);
      reset.setAttribute("aria-label", `Reset ${name}`);
      ways.forEach((button, i) => {
        const to = ends[k]?.[i] ?? ["lower end", "upper end"][i];
        button.title = `To the ${ends[k] ? `end “${to}”` : to}: ${readable(space.ends(k)[i])}`;
        button.setAttribute("aria-label", `${name}: ${to}`);
      });
    });
  }

  #row(k) {
    const { space } = this.store;
    const root = clone("coordinate");
    const slider = find("input[type=range]", root);
    const box = find("input[type=number]", root);
    const lock = find("[data-do=lock]", root);
    const reset = find("[data-do=reset]", root);
    const [low, high] = space.range(k);
    const percent = (value) => `${(100 * (value - low)) / (high - low)}%`;

    Object.assign(slider, { min: low, max: high, id: `z${k}` });
    Object.assign(find(".bound", root), { id: `bound${k}` });
    box.setAttribute("aria-describedby", `bound${k}`);
    slider.style.setProperty("--low", percent(space.lower[k]));
    slider.style.setProperty("--high", percent(space.upper[k]));
    slider.style.setProperty("--home", percent(space.home[k]));
    slider.title =
      `Training data from ${readable(space.lower[k])} to ${readable(space.upper[k])}` +
      (space.period[k] ? `, period ${readable(space.period[k])}` : "");

    this.hand.on(slider);
    slider.addEventListener("input", () => this.#set(k, Number(slider.value)));
    slider.addEventListener("keydown", (event) => this.#wrapAtTheEnd(event, k, slider));
    box.addEventListener("input", () => this.#typed(k, box, false));
    box.addEventListener("change", () => this.#typed(k, box, true));
    reset.addEventListener("click", () => {
      this.#set(k, space.home[k]);
      slider.focus(); // the button has gone
    });
    lock.addEventListener("click", () => {
      this.store.set({ locked: this.store.locked.map((is, i) => (i === k ? !is : is)) });
    });
    const ways = [...root.querySelectorAll(".end")];
    ways.forEach((button, i) => {
      sharp(find("canvas", button), PICTURE);
      button.addEventListener("click", () => this.#set(k, space.ends(k)[i]));
    });
    const controls = [slider, box, reset, ...ways];
    this.#rows[k] = { root, slider, box, lock, reset, ways, controls };
    return root;
  }

  #set(k, value) {
    this.#warn(k, false);
    this.#change(this.store.code.map((old, i) => (i === k ? this.store.space.wrap(k, value) : old)));
  }

  /**
   * Take a number that the user types. A number beyond the slider is refused with its bound, because it may
   * be the beginning of another; when the user has finished it, the bound takes its place.
   */
  #typed(k, box, finished) {
    const { space } = this.store;
    const value = box.valueAsNumber;
    if (Number.isNaN(value)) return finished && this.#show(); // incomplete
    const [low, high] = space.range(k).map((end) => Number(end.toFixed(4)));
    const end = Math.min(Math.max(value, low), high);
    const beyond = end !== value && !space.period[k];
    const taken = space.wrap(k, beyond ? end : value);
    if ((!beyond || finished) && taken !== this.store.code[k]) this.#set(k, taken);
    this.#warn(k, beyond && `The ${value < low ? "smallest" : "largest"} value here is ${readable(end, 4)}.`);
    box.setAttribute("aria-invalid", String(beyond && !finished));
    if (finished) this.#show();
  }

  /** Show a sentence about a coordinate below its field; false removes it. */
  #warn(k, text) {
    find(".bound", this.#rows[k].root).textContent = text || "";
  }

  /** Set a code, except locked coordinates. */
  #change(code) {
    this.store.set({ code: code.map((value, k) => (this.store.locked[k] ? this.store.code[k] : value)) });
  }

  /** Let an angle that a key moves past one end continue at the other. */
  #wrapAtTheEnd(event, k, slider) {
    const up = ["ArrowRight", "ArrowUp"].includes(event.key);
    const down = ["ArrowLeft", "ArrowDown"].includes(event.key);
    if (!this.store.space.period[k] || !(up || down)) return;
    event.preventDefault();
    this.#set(k, Number(slider.value) + ((up ? 1 : -1) * this.store.space.period[k]) / 100);
  }

  #show() {
    const { code, locked, model, space } = this.store;
    if (!code || code.length !== this.#rows.length) return;
    const moved = code.map((value, k) => Math.abs(value - space.home[k]) > 1e-4);
    this.all.hidden = !moved.some((is, k) => is && !locked[k]);
    this.#rows.forEach(({ root, slider, box, lock, controls }, k) => {
      if (Number(slider.value) !== code[k]) slider.value = code[k];
      if (document.activeElement !== box || (Number(box.value) !== code[k] && box.ariaInvalid !== "true")) {
        box.value = Number(code[k].toFixed(4));
        box.ariaInvalid = "false";
      }
      root.classList.toggle("outside", !space.inside(k, code[k]));
      root.classList.toggle("locked", locked[k]);
      root.classList.toggle("moved", moved[k] && !locked[k]);
      lock.setAttribute("aria-pressed", String(locked[k]));
      for (const control of controls) control.disabled = locked[k];
    });
    model.factors.forEach(({ start, stop }, j) => {
      this.list.children[j].classList.toggle("moved", moved.slice(start, stop).some(Boolean));
    });
  }
}
