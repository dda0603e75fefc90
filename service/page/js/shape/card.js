/** The card of a model: its description, and how good it is, in sentences, bars and a table. */

import * as api from "../server/api.js";
import { almost, element, find, readable } from "../dom.js";

const percent = (share) => `${readable(100 * share)}\u00a0%`;

/** Rows of the table, named as in a run's report; the card as JSON has figures without a name here. */
const ROWS = {
  composite: "This model",
  monolithic: "The same recipe with one factor",
  kernel: "Kernel ridge regression on the codes",
  monolithic_paper: "The paper’s monolithic network",
  paper: "The paper’s composite network",
  affine: "Affine sum of exact factors",
  "affine of learned factors": "Affine sum of learned factors",
};

/** Return what the figures mean, as sentences. */
function sentences(card) {
  const { latent_dimension: m, factors, vertices, faces, specificity: random, draft_error: draft } = card;
  const { r2, vertex_error: error } = card.figures;
  const parts = factors.length === 1 ? "one factor" : `${factors.length} factors`;
  return [
    `A code has ${m} ${m === 1 ? "number" : "numbers"} in ${parts}. Each shape has ${vertices} vertices ` +
      `and ${faces} faces.`,
    r2?.composite &&
      `On test shapes, the networks explain ${almost(r2.composite.total)}\u00a0% of the variance of ` +
        "lengths and angles.",
    error?.mean &&
      `Their vertices are off by ${percent(error.mean)} of the shape’s diagonal on average, compared ` +
        "with exact shapes.",
    draft && `While something moves, the page shows drafts, which are off by ${percent(draft.mean)}.`,
    random &&
      `A random shape is ${percent(random.modes)} of the diagonal away from the nearest training shape. ` +
        `With as many principal components, it is ${percent(random.components)}.`,
  ].filter(Boolean);
}

/** Return a bar for each value, as long as its share of the largest. */
function bars(values) {
  const most = Math.max(...values.map(([, value]) => value));
  return values.flatMap(([name, value]) => {
    const bar = element(
      "dd",
      {},
      element("span", { className: "bar" }),
      element("span", { textContent: percent(value) }),
    );
    bar.style.setProperty("--share", String(value / most));
    return [element("dt", { textContent: name }), bar];
  });
}

export async function openCard(dialog, model) {
  const card = await api.modelCard(model);
  const { generalisation: unseen, figures } = card;
  find("h2", dialog).textContent = card.title;
  find(".kind", dialog).textContent = `${card.name} · version ${card.version} · ${card.licence}`;
  find(".description", dialog).textContent = card.description;
  find(".sentences", dialog).replaceChildren(
    ...sentences(card).map((textContent) => element("p", { textContent })),
  );
  find(".unseen", dialog).hidden = !unseen;
  if (unseen) {
    find(".unseen dl", dialog).replaceChildren(
      ...bars([
        ["This model", unseen.mean],
        ["Principal components", unseen.components.mean],
      ]),
    );
  }
  const rows = Object.entries(figures.r2 ?? {}).filter(([name]) => name in ROWS);
  const cell = (value) =>
    element("td", { textContent: value === undefined ? "" : `${almost(value)}\u00a0%` });
  find(".compared tbody", dialog).replaceChildren(
    ...rows.map(([name, { total, lengths, angles }]) =>
      element(
        "tr",
        {},
        element("th", { scope: "row", textContent: ROWS[name] }),
        ...[total, lengths, angles].map(cell),
      ),
    ),
  );
  find(".compared", dialog).hidden = rows.length === 0;
  find(".all", dialog).href = card.links.self;
  find(".digest", dialog).textContent = card.digest;
  dialog.showModal();
}
