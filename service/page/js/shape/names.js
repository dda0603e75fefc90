/**
 * Names of factors and coordinates: from the model, or from the user, who can rename them in this browser.
 */

import { element, find } from "../dom.js";
import { always } from "../memory.js";
import { keptMotions } from "./motions.js";

const LONGEST = 60;
const place = (model) => `names:${model.name}`;

/** Return the user's names by the model's names; names for other versions of a model are ignored. */
function own(model) {
  try {
    const kept = JSON.parse(always.kept(place(model)) ?? "{}");
    return Object.fromEntries(Object.entries(kept ?? {}).filter(([, name]) => typeof name === "string"));
  } catch {
    return {};
  }
}

/**
 * Return the names to show.
 * @param {object} model as the server lists it
 * @param {Record<string, string>} said the user's names of factors and coordinates
 * @param {import("./motions.js").Motion[]} motions what both ends of each coordinate look like, where known
 * @returns {import("../store.js").Names}
 */
export function namesOf(model, said = own(model), motions = keptMotions(model)) {
  const factors = model.factors.map(({ name }) => said[`factor ${name}`] ?? name);
  const plain = labels(model);
  const short = plain.map((label, k) => said[`coordinate ${model.latent_names[k]}`] ?? label);
  // A number says nothing about a coordinate, and a word of the model's author says more than its motion.
  const ends = short.map((label, k) => (/^\d*$/.test(label) ? motions?.[k] : null) ?? null);
  const coordinates = model.factors.flatMap(({ name, start, stop }, j) =>
    short.slice(start, stop).map((label, i) => {
      if (ends[start + i]) return `${factors[j]}, ${ends[start + i].join(" to ")}`;
      const same = factors[j] === name && label === plain[start + i];
      return same ? model.latent_names[start + i] : [factors[j], label].filter(Boolean).join(", ");
    }),
  );
  return { factors, labels: short.map((label, k) => ends[k]?.join(" ↔ ") ?? label), coordinates, ends };
}

/** Return the names of coordinates without the name of their factor, which stands above. */
function labels({ factors, latent_names: names }) {
  return factors.flatMap((factor) =>
    names
      .slice(factor.start, factor.stop)
      .map((name) =>
        name.startsWith(factor.name) ? name.slice(factor.name.length).replace(/^[\s,]+/, "") : name,
      ),
  );
}

/** The dialog in which the user renames factors and coordinates; its result is `store.names`. */
export class Names {
  /** @param {import("../store.js").Page} store */
  constructor(store, { dialog, button }) {
    this.store = store;
    this.dialog = dialog;
    store.on(["motions"], () => {
      const { model, motions } = store;
      if (motions) store.set({ names: namesOf(model, own(model), motions) });
    });
    button.addEventListener("click", () => this.#open());
    find("form", dialog).addEventListener("submit", () => this.#keep(true));
    find("[data-do=forget]", dialog).addEventListener("click", () => {
      this.#keep(false);
      dialog.close();
    });
    find("[data-do=close]", dialog).addEventListener("click", () => dialog.close());
  }

  #open() {
    const { model } = this.store;
    const said = own(model);
    const short = labels(model);
    const theirs = namesOf(model, {}, this.store.motions ?? undefined);
    const line = (key, name, shown, placeholder = shown) => {
      const input = element("input", {
        type: "text",
        maxLength: LONGEST,
        placeholder,
        value: said[key] ?? "",
      });
      input.dataset.key = key;
      input.setAttribute("aria-label", `Name for ${name}`);
      return element("label", { className: "line" }, shown, input);
    };
    find(".list", this.dialog).replaceChildren(
      ...model.factors.map((factor) => {
        const ks = model.latent_names
          .slice(factor.start, factor.stop)
          .map((name, i) => [name, short[factor.start + i], factor.start + i]);
        // A factor with one coordinate shares its name, and has one field.
        const parts = ks
          .filter(([, label]) => label)
          .map(([name, , k]) => line(`coordinate ${name}`, theirs.coordinates[k], theirs.labels[k]));
        return element(
          "fieldset",
          {},
          element("legend", { textContent: factor.name }),
          line(`factor ${factor.name}`, `the factor ${factor.name}`, "the factor", factor.name),
          ...parts,
        );
      }),
    );
    this.dialog.showModal();
  }

  #keep(typed) {
    const { model } = this.store;
    const inputs = typed ? [...this.dialog.querySelectorAll("input")] : [];
    const typedIn = inputs.map(({ dataset, value }) => [dataset.key, value.trim()]);
    const said = Object.fromEntries(typedIn.filter(([, name]) => name));
    always.keep(place(model), JSON.stringify(said));
    this.store.set({ names: namesOf(model, said, this.store.motions ?? undefined) });
  }
}
