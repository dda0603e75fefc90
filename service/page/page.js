// Fills the page from the models' cards. Text only ever goes in as text.

const main = document.querySelector("#models");
const here = new URL(".", location.href).href.replace(/\/$/, "");

const clone = (name) => document.querySelector(`template#${name}`).content.cloneNode(true);
const element = (name, text) => Object.assign(document.createElement(name), { textContent: text });
const number = (value) => (value === null ? "" : Number(value.toPrecision(5)).toString());

async function get(path) {
  const response = await fetch(here + path);
  const answer = await response.json();
  if (!response.ok) throw new Error(answer.detail);
  return answer;
}

/** Numbers of a nested object with the path to each, such as ["r2 composite total", 0.99]. */
function flatten(value, path = []) {
  if (typeof value === "number") return [[path.join(" ").replaceAll("_", " "), value]];
  if (value === null || typeof value !== "object") return [];
  return Object.entries(value).flatMap(([key, inner]) => flatten(inner, [...path, key]));
}

function row(...cells) {
  const tr = document.createElement("tr");
  tr.append(...cells.map((text) => element("td", text)));
  return tr;
}

function call(caption, command) {
  const figure = clone("call");
  figure.querySelector("figcaption").textContent = caption;
  figure.querySelector("code").textContent = command;
  figure.querySelector("button").addEventListener("click", async ({ target }) => {
    await navigator.clipboard.writeText(command);
    target.textContent = "copied";
    setTimeout(() => { target.textContent = "copy"; }, 1500);
  });
  return figure;
}

function calls(card) {
  const middle = card.lower.map((low, k) => Number((low + 0.7 * (card.upper[k] - low)).toFixed(2)));
  const rest = card.lower.map((low, k) => Number((low + 0.3 * (card.upper[k] - low)).toFixed(2)));
  const [a, b] = [middle, rest].map((code) => JSON.stringify(code));
  const model = here + card.links.self;
  const post = `-H 'content-type: application/json' -d`;
  return [
    call("A shape as GLB", `curl -X POST ${model}/mesh ${post} '{"latent":${a}}' -o shape.glb`),
    call("The same as OBJ, by a link", `curl '${model}/mesh?latent=${middle}&format=obj' -o shape.obj`),
    call("Positions of two shapes", `curl -X POST ${model}/vertices ${post} '{"latents":[${a},${b}]}'`),
    call("Lengths and angles", `curl -X POST ${model}/nric ${post} '{"latents":[${a}]}'`),
    call("An animation: the answer holds its address", `curl -X POST ${model}/interpolations ${post} '{"keyframes":[${b},${a}],"frames":30,"loop":true}'`),
  ];
}

function article(card) {
  const part = clone("model");
  const title = part.querySelector("h2");
  title.append(card.title, " ", element("small", `${card.name} · version ${card.version} · ${card.licence}`));
  part.querySelector(".description").textContent = card.description;
  const facts = { latents: card.latent_dimension, factors: card.factors.length, vertices: card.vertices, edges: card.edges, faces: card.faces };
  part.querySelector(".facts").append(...Object.entries(facts).map(([name, value]) => {
    const div = document.createElement("div");
    div.append(element("dt", name), element("dd", value));
    return div;
  }));
  for (const factor of card.factors) {
    for (let k = factor.start; k < factor.stop; k += 1) {
      part.querySelector(".factors tbody").append(
        row(card.latent_names[k], factor.name, number(card.lower[k]), number(card.upper[k]), number(card.period[k])));
    }
  }
  part.querySelector(".figures tbody").append(...flatten(card.figures).map(([name, value]) => row(name, number(value))));
  part.querySelector(".calls").append(...calls(card));
  return part;
}

try {
  const { models } = await get("/v1/models");
  const cards = await Promise.all(models.map((model) => get(model.links.self)));
  main.replaceChildren(...cards.map(article));
  if (cards.length === 0) main.append(Object.assign(element("p", "No model is served."), { className: "note" }));
} catch (error) {
  main.replaceChildren(Object.assign(element("p", error.message), { className: "note" }));
}
