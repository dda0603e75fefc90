/** The card of a model: its description, its measured figures, and example calls. */

import * as api from "../server/api.js";
import { element, find, readable } from "../dom.js";

const rows = (facts) =>
  facts.map(([name, value, meaning = ""]) =>
    element(
      "div",
      {},
      element("dt", { textContent: name }),
      element("dd", { textContent: value }),
      ...(meaning ? [element("dd", { className: "hint", textContent: meaning })] : []),
    ),
  );
const percent = (share) => `${readable(100 * share)} %`;

/** Explanations of the figures. */
const MEANINGS = {
  r2: "How much of the change of lengths and angles the networks get right: 1 is all of it.",
  unseen: "From shapes that training has not seen, in shares of the diagonal.",
  components: "The same by a linear model with as many numbers.",
  random: "From random shapes to the nearest of training, in shares of the diagonal: how far they stray.",
  draft: "From what is shown while something moves to the full shape.",
  error: "From the networks’ shapes to exact ones, in shares of the diagonal.",
};

/** Return the numbers of a nested object with their paths, such as ["r2 composite total", 0.99]. */
function flatten(value, path = []) {
  if (typeof value === "number") return [[path.join(" ").replaceAll("_", " "), value]];
  if (value === null || typeof value !== "object") return [];
  return Object.entries(value).flatMap(([key, inner]) => flatten(inner, [...path, key]));
}

export async function openCard(dialog, model) {
  const card = await api.modelCard(model);
  const { r2, vertex_error: error } = card.figures;
  const { generalisation: unseen, specificity: random, draft_error: draft } = card;
  find("h2", dialog).textContent = card.title;
  find(".kind", dialog).textContent = `${card.name} · version ${card.version} · ${card.licence}`;
  find(".description", dialog).textContent = card.description;
  find(".facts", dialog).replaceChildren(
    ...rows([
      ["coordinates", card.latent_dimension],
      ["factors", card.factors.length],
      ["vertices", card.vertices],
      ["faces", card.faces],
      ...(r2?.composite ? [["variance explained (R²)", readable(r2.composite.total, 4), MEANINGS.r2]] : []),
      ...(unseen
        ? [
            ["unseen shapes, mean distance", percent(unseen.mean), MEANINGS.unseen],
            ["as many principal components", percent(unseen.components.mean), MEANINGS.components],
          ]
        : []),
      ...(random
        ? [
            ["random shapes, to the nearest trained on", percent(random.modes), MEANINGS.random],
            ["of as many principal components", percent(random.components), MEANINGS.components],
          ]
        : []),
      ...(draft ? [["drafts, mean distance", percent(draft.mean), MEANINGS.draft]] : []),
      ...(error?.mean ? [["mean vertex error", percent(error.mean), MEANINGS.error]] : []),
    ]),
  );
  const cells = (...texts) => texts.map((textContent) => element("td", { textContent }));
  find(".compared tbody", dialog).replaceChildren(
    ...Object.entries(r2 ?? {}).map(([name, { total, lengths, angles }]) =>
      element(
        "tr",
        {},
        element("th", { scope: "row", textContent: name }),
        ...cells(...[total, lengths, angles].map((value) => (value === undefined ? "" : readable(value, 4)))),
      ),
    ),
  );
  find(".compared", dialog).hidden = !r2;
  find(".figures tbody", dialog).replaceChildren(
    ...flatten(card.figures).map(([name, value]) =>
      element("tr", {}, element("th", { scope: "row", textContent: name }), ...cells(readable(value, 4))),
    ),
  );
  find(".digest", dialog).textContent = card.digest;
  dialog.showModal();
}
