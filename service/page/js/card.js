/** The card of a model: what it is, how good it is, and how to call it. */

import * as api from "./api.js";
import { element, find, readable } from "./dom.js";

const rows = (pairs) => pairs.map(([name, value]) => element("div", {},
  element("dt", { textContent: name }), element("dd", { textContent: value })));
const percent = (share) => `${readable(100 * share)} %`;

/** Numbers of a nested object with the path to each, such as ["r2 composite total", 0.99]. */
function flatten(value, path = []) {
  if (typeof value === "number") return [[path.join(" ").replaceAll("_", " "), value]];
  if (value === null || typeof value !== "object") return [];
  return Object.entries(value).flatMap(([key, inner]) => flatten(inner, [...path, key]));
}

export async function openCard(dialog, model) {
  const card = await api.modelCard(model);
  const { r2, vertex_error: error } = card.figures;
  const { generalisation: unseen, draft_error: draft } = card;
  find("h2", dialog).textContent = card.title;
  find(".kind", dialog).textContent = `${card.name} · version ${card.version} · ${card.licence}`;
  find(".description", dialog).textContent = card.description;
  find(".facts", dialog).replaceChildren(...rows([
    ["coordinates", card.latent_dimension],
    ["factors", card.factors.length],
    ["vertices", card.vertices],
    ["faces", card.faces],
    ...(r2?.composite ? [["variance explained (R²)", readable(r2.composite.total, 4)]] : []),
    ...(unseen ? [["unseen shapes, mean distance", percent(unseen.mean)],
      ["as many principal components", percent(unseen.components.mean)]] : []),
    ...(draft ? [["drafts, mean distance", percent(draft.mean)]] : []),
    ...(error?.mean ? [["mean vertex error, of the diagonal", percent(error.mean)]] : []),
  ]));
  const cells = (...texts) => texts.map((textContent) => element("td", { textContent }));
  find(".compared tbody", dialog).replaceChildren(...Object.entries(r2 ?? {}).map(([name, { total, lengths, angles }]) =>
    element("tr", {}, element("th", { scope: "row", textContent: name }),
      ...cells(...[total, lengths, angles].map((value) => (value === undefined ? "" : readable(value, 4)))))));
  find(".compared", dialog).hidden = !r2;
  find(".figures tbody", dialog).replaceChildren(...flatten(card.figures).map(([name, value]) =>
    element("tr", {}, element("th", { scope: "row", textContent: name }), ...cells(readable(value, 4)))));
  find(".digest", dialog).textContent = card.digest;
  dialog.showModal();
}
