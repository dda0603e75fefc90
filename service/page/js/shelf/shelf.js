/** Shapes that the user keeps by name in this browser, for each model. */

import * as api from "../server/api.js";
import { OTHER } from "../view/colouring.js";
import { clone, find, sharp } from "../dom.js";
import { always } from "../memory.js";
import { report, say } from "../messages.js";
import { sameCode } from "../server/space.js";

const PICTURE = 64;
const MOST = 50;
const LONGEST = 60; // most characters of a name
const place = (model) => `shelf:${model.name}`;

/** Return the shapes on a model's shelf, without codes of versions with other coordinates. */
function kept(model) {
  const isCode = (code) => code?.length === model.latent_dimension && code.every(Number.isFinite);
  try {
    const found = JSON.parse(always.kept(place(model)) ?? "[]");
    return found.filter(({ name, code }) => typeof name === "string" && isCode(code)).slice(0, MOST);
  } catch {
    return [];
  }
}

export class Shelf {
  /** @type {{name: string, code: number[]}[]} */
  #shapes = [];

  /** @param {import("../store.js").Page} store */
  constructor(store, pictures, { list, add }) {
    this.store = store;
    this.pictures = pictures;
    this.list = list;
    this.add = add;
    add.addEventListener("click", () => {
      const numbers = this.#shapes.map(({ name }) => Number(/^Shape (\d+)$/.exec(name)?.[1] ?? 0));
      this.#put([...this.#shapes, { name: `Shape ${Math.max(0, ...numbers) + 1}`, code: store.code }]);
      const input = find("li:last-child input", list);
      input.focus(); // a selection does not have to focus
      input.select();
    });
    store.on(["model"], () => {
      this.#shapes = kept(store.model);
      this.#list();
    });
    store.on(["other"], () => this.#mark());
    // Another window has changed the shelf, and later changes here must not undo this.
    addEventListener("storage", ({ key }) => {
      if (!store.model || key !== place(store.model)) return;
      this.#shapes = kept(store.model);
      this.#list();
    });
  }

  #put(shapes) {
    this.#keep(shapes);
    this.#list();
  }

  #keep(shapes) {
    this.#shapes = shapes;
    if (always.keep(place(this.store.model), JSON.stringify(shapes))) return;
    const advice = "Share copies an address that has the shape.";
    const lost = `This browser lets the page keep nothing: the shelf is gone when the page closes. ${advice}`;
    say(lost, { kind: "error", key: "shelf" });
  }

  #list() {
    const { model } = this.store;
    const shapes = this.#shapes;
    this.add.disabled = shapes.length >= MOST;
    this.list.replaceChildren(...shapes.map((shape, i) => this.#item(shape, i)));
    this.#mark();
    if (shapes.length === 0) return;
    const canvases = [...this.list.querySelectorAll("canvas")];
    api
      .shapes(
        model,
        shapes.map(({ code }) => code),
        "coarse",
      )
      .then(({ shapes: drawn }) => {
        // A list that is made anew has other canvases; a new name leaves them.
        if (!canvases[0].isConnected) return;
        canvases.forEach((canvas, i) => this.pictures.draw(canvas, drawn[i]));
      })
      .catch(report);
  }

  #item({ name, code }, i) {
    const item = clone("kept");
    const part = (what) => find(`[data-do=${what}]`, item);
    part("go").addEventListener("click", () => this.store.set({ code: [...code] }));
    part("compare").addEventListener("click", () => {
      const { other } = this.store;
      const off = other && sameCode(other, code);
      this.store.set(off ? { other: null } : { other: code, against: OTHER });
    });
    part("remove").addEventListener("click", () => {
      this.#put(this.#shapes.toSpliced(i, 1));
      const next = `li:nth-child(${Math.min(i + 1, this.#shapes.length)}) [data-do=go]`;
      (find(next, this.list) ?? this.add).focus();
    });
    const input = part("rename");
    input.maxLength = LONGEST;
    input.addEventListener("change", () => {
      const said = input.value.trim();
      if (said) this.#keep(this.#shapes.with(i, { name: said, code }));
      label(item, this.#shapes[i].name); // in its place, because the focus is on it or next to it
    });
    label(item, name);
    sharp(find("canvas", item), PICTURE);
    return item;
  }

  #mark() {
    const { other } = this.store;
    this.list.querySelectorAll("[data-do=compare]").forEach((button, i) => {
      button.setAttribute("aria-pressed", String(Boolean(other) && sameCode(other, this.#shapes[i].code)));
    });
  }
}

/** Name a shape. */
function label(item, name) {
  const says = { go: "Go to", compare: "Compare with", remove: "Remove", rename: "Name of" };
  for (const [what, words] of Object.entries(says)) {
    find(`[data-do=${what}]`, item).setAttribute("aria-label", `${words} ${name}`);
  }
  Object.assign(find("input", item), { value: name, title: name });
}
