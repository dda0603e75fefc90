/**
 * The page's calls of the server. Every failure becomes a Problem with a sentence for the user.
 */

import { here } from "../memory.js";
import { readNpz } from "./npz.js";
import { inWords } from "./problems.js";

export const origin = new URL(".", document.baseURI).href.replace(/\/$/, "");
/** Whether there is a server that answers calls, see `static/api.js`. @type {boolean} */
export const answersCalls = true;
const PATIENCE = 3;
const KEY = "shapespace-key";

/** A problem in the page's words; status 0 means that the server did not answer. */
export class Problem extends Error {
  /**
   * @param {string} message
   * @param {number} status
   * @param {{type?: string, detail?: string}} [said] the server's problem (RFC 9457)
   */
  constructor(message, status, { type = "", detail = "" } = {}) {
    super(message);
    this.status = status;
    this.type = type;
    this.detail = detail;
  }

  get offline() {
    return this.status === 0;
  }
}

const wait = (seconds) =>
  new Promise((resolve) => {
    setTimeout(resolve, 1000 * seconds);
  });

/** Send a key with every further call, while the tab is open. */
export const useKey = (key) => here.keep(KEY, key);

async function call(path, options = {}) {
  for (let tries = 1; ; tries += 1) {
    let response;
    try {
      const key = here.kept(KEY);
      const headers = { ...options.headers, ...(key && { "X-API-Key": key }) };
      response = await fetch(origin + path, { ...options, headers });
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw new Problem("The server does not answer.", 0);
    }
    if (response.ok) return response;
    const seconds = Number(response.headers.get("Retry-After") ?? 1);
    if (response.status === 503 && tries < PATIENCE && seconds <= 5) {
      await wait(seconds);
      continue;
    }
    const problem = await response.json().catch(() => ({}));
    options.signal?.throwIfAborted();
    throw new Problem(inWords(problem, response.status), response.status, problem);
  }
}

const post = (path, body, signal) =>
  call(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
    signal,
  });
const json = async (response) => (await response).json();

/** Answers that were requested before the scripts that want them had arrived; the first call takes each. */
const early = new Map();
const taken = (name) => {
  const answer = early.get(name);
  early.delete(name);
  return answer;
};
const nameOf = (model, ...what) => [model.name, model.version, ...what].join(" ");

/** Request the coarse reference of a model and the draft of a code, both at once, for later calls. */
export function ask(model, code) {
  early.clear();
  const draft = { quality: /** @type {const} */ ("draft") };
  const answers = [
    [nameOf(model, "coarse"), reference(model, "coarse")],
    [nameOf(model, code, "coarse", "draft"), shapes(model, [code], "coarse", draft)],
  ];
  for (const [name, answer] of /** @type {[string, Promise<any>][]} */ (answers)) {
    answer.catch(() => {}); // the call that takes it reports the error
    early.set(name, answer);
  }
}

/**
 * Return the address of a call of a model, in the version that the page has listed.
 * Codes of another version mean other shapes.
 */
const at = (model, name, query = {}) =>
  `${model.links.self}${name && "/"}${name}?${new URLSearchParams({ ...query, version: model.version })}`;

/** Return the address of a drawing of the reference, which is there before the page can draw. */
export const posterOf = (model) =>
  `${origin}/poster/${model.name}.svg?${new URLSearchParams({ version: model.version })}`;

export const models = async () => (await json(call("/v1/models"))).models;
export const modelCard = (model) => json(call(at(model, "")));
export const ready = () =>
  call("/v2/health/ready").then(
    () => true,
    () => false,
  );

const diagnosticsOf = (response) => JSON.parse(response.headers.get("Shape-Diagnostics") ?? "{}");

/** Phones compute drafts themselves, because each answer takes a round trip. */
const isPhone =
  matchMedia("(pointer: coarse)").matches && !(/** @type {any} */ (navigator).connection?.saveData);
const MISFIT = 0.2; // above it the server solves the shape instead
let near = { model: null, decoder: null, isReady: false };

/** Return the decoder of a model if it is there. The first call begins to load it. */
function decoderOf(model, mesh) {
  if (!isPhone || mesh !== "fine" || !model.links.decoder) return null;
  if (near.model !== model) {
    near.decoder?.close();
    const mine = { model, decoder: null, isReady: false };
    near = mine;
    const open = async () => {
      const { Decoder } = await import("../decoder/decoder.js");
      if (near !== mine) return;
      const key = here.kept(KEY);
      mine.decoder = new Decoder(origin + at(model, "decoder.onnx"), key ? { "X-API-Key": key } : {});
      await mine.decoder.ready;
      mine.isReady = true;
    };
    open().catch(() => {}); // the server computes drafts too
  }
  return near.isReady ? near.decoder : null;
}

/** Return drafts that this device has computed, or null. */
async function ownDrafts(model, latents, mesh, signal) {
  const decoder = decoderOf(model, mesh);
  if (!decoder) return null;
  try {
    const found = await Promise.all(latents.map((code) => decoder.shape(code, { urgent: true, signal })));
    const { answer } = await import("../decoder/decoder.js");
    const drafts = answer(model, latents, found, "draft");
    return drafts.diagnostics.residual > MISFIT ? null : drafts;
  } catch {
    signal?.throwIfAborted();
    return null;
  }
}

/** Return positions and faces of the reference. */
export async function reference(model, mesh) {
  const asked = taken(nameOf(model, mesh));
  if (asked) return asked;
  const response = await call(at(model, "mesh", { mesh, format: "npz" }));
  const { vertices, faces } = await readNpz(await response.arrayBuffer(), ["vertices", "faces"]);
  return { vertices: vertices.data, faces: faces.data };
}

/** Return the reference as GLB, with the materials and textures of the training files. */
export const textured = async (model) => (await call(at(model, "mesh", { format: "glb" }))).arrayBuffer();

/**
 * Return the positions (3V numbers each) of some codes, and a summary of their diagnostics.
 * @param {object} model as the server lists it
 * @param {number[][]} latents
 * @param {"coarse" | "fine"} mesh
 * @param {{quality?: "draft" | "full", signal?: AbortSignal}} [options]
 */
export async function shapes(model, latents, mesh, { quality = "full", signal } = {}) {
  const asked = taken(nameOf(model, latents, mesh, quality));
  if (asked) return asked;
  const own = quality === "draft" ? await ownDrafts(model, latents, mesh, signal) : null;
  if (own) return own;
  const body = { latents, mesh, quality, faces: false };
  const response = await post(at(model, "vertices", { format: "npz" }), body, signal);
  const { vertices } = await readNpz(await response.arrayBuffer(), ["vertices"]);
  return { shapes: split(vertices), diagnostics: diagnosticsOf(response) };
}

/** Return the id and links of an animation. */
export const interpolation = (model, path) => json(post(at(model, "interpolations"), path));

let drawing = new AbortController();
/** Return the random code of a seed, from the population or uniform in the bounds; cancels the last call. */
export async function sample(model, seed, distribution) {
  drawing.abort(); // its answer may come later, and would replace this one
  drawing = new AbortController();
  const body = { count: 1, seed, distribution };
  const { latents } = await json(post(at(model, "sample"), body, drawing.signal));
  return latents[0];
}

/** Return the code whose shape is closest to the targets of some vertices. */
export const edit = (model, body, signal) => json(post(at(model, "edit"), body, signal));

/** Return the code of a mesh file, with some fixed coordinates. */
export const encode = (model, file, format, fixed, signal) => {
  const path = at(model, "encode", { ...format, fixed: JSON.stringify(fixed) });
  return json(call(path, { method: "POST", body: file, signal }));
};

/** Return the standard deviation of each vertex (V) for the covariance of a code, in the model's units. */
export async function spread(model, { code, covariance }, mesh) {
  const response = await post(at(model, "mesh", { color: "spread", format: "npz" }), {
    latent: code,
    covariance,
    mesh,
  });
  return (await readNpz(await response.arrayBuffer(), ["color_values"])).color_values.data;
}

/** Fit a scan: return its code and placement. `tell` is called with the share of the search that is done. */
export async function fit(model, file, format, options, signal, tell) {
  const path = at(model, "fit", { ...format, ...options });
  const headers = { Accept: "text/event-stream" };
  const response = await call(path, { method: "POST", body: file, headers, signal });
  for await (const event of events(response)) {
    if (event.problem)
      throw new Problem(inWords(event.problem, event.problem.status), event.problem.status, event.problem);
    if ("progress" in event) tell(event.progress);
    else return event;
  }
  throw new Problem("The connection ended before the answer. Try again in a moment.", 502);
}

/** Return the events of a stream (text/event-stream) with JSON as their data. */
async function* events(response) {
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { done, value } = await reader.read().catch((error) => {
      throw error.name === "AbortError" ? error : new Problem("The server does not answer.", 0);
    });
    if (done) return;
    const parts = (text + value).split("\n\n");
    text = parts.pop();
    for (const part of parts) yield JSON.parse(part.replace(/^data: /, ""));
  }
}

/** Return whether a link without a key can have shapes as USDZ, for which the server needs a package. */
export const writesUsdz = async (model) =>
  !here.kept(KEY) &&
  call(at(model, "mesh", { format: "usdz", mesh: "coarse" })).then(
    () => true,
    () => false,
  );

/** Return a file to save, as a blob. */
export const file = async (path, body) => (await (body ? post(path, body) : call(path))).blob();

/** Return the rows of an array of two or more dimensions. */
function split({ shape, data }) {
  const size = data.length / shape[0];
  return Array.from({ length: shape[0] }, (_, i) => data.subarray(i * size, (i + 1) * size));
}
