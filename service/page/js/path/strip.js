/** Pictures along a path: rows for the whole shape and for each factor alone. */

import * as api from "../server/api.js";
import { element, find, sharp } from "../dom.js";
import { reporting } from "../messages.js";

const COLUMNS = 5;
const PICTURE = 72;

export class Strip {
  /** @param {import("../store.js").Page} store */
  constructor(store, pictures, { button, table }) {
    this.store = store;
    this.pictures = pictures;
    this.table = table;
    button.addEventListener(
      "click",
      reporting(() => this.#draw()),
    );
    // The page may learn names of sliders while the strip is there.
    store.on(["names"], () => {
      table.querySelectorAll("tbody th").forEach((head, row) => {
        if (row > 0) head.textContent = store.names.factors[row - 1] ?? "";
      });
    });
    store.on(["keyframes", "model"], () => {
      table.hidden = true;
      button.disabled = store.keyframes.length < 2;
    });
  }

  async #draw() {
    const { keyframes, model, names, space } = this.store;
    const t = Array.from({ length: COLUMNS }, (_, i) => i / (COLUMNS - 1));
    const codes = space.along(
      keyframes,
      t.map((share) => share * (keyframes.length - 1)),
    );
    const rows = [["all factors", null], ...model.factors.map((factor, j) => [names.factors[j], factor])];
    find("thead tr", this.table).replaceChildren(
      ...t.map((time) => element("th", { scope: "col", textContent: time.toFixed(2) })),
    );
    // Each name stands above its pictures, which have the whole width.
    const made = rows.map(([name]) =>
      element(
        "tbody",
        {},
        element("tr", {}, element("th", { scope: "rowgroup", colSpan: COLUMNS, textContent: name })),
        element("tr", {}, ...t.map(() => element("td", {}, sharp(element("canvas"), PICTURE)))),
      ),
    );
    for (const body of [...this.table.tBodies]) body.remove();
    this.table.append(...made);
    this.table.hidden = false;
    for (const [i, [, factor]] of rows.entries()) {
      const alone = factor ? codes.map((code) => space.alone(factor, code)) : codes;
      const { shapes } = await api.shapes(model, alone, "coarse", { quality: "draft" });
      if (this.store.keyframes !== keyframes || this.store.model !== model) return;
      made[i].querySelectorAll("canvas").forEach((canvas, k) => this.pictures.draw(canvas, shapes[k]));
    }
  }
}
