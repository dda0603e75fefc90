/**
 * The page's calls where there is no server: answers from the files of `shapespace page`. In such
 * a page this module takes the place of `server/api.js`.
 */

import { origin, Problem } from "../server/api.js";
import { readNpz } from "../server/npz.js";
import { LatentSpace, sameCode } from "../server/space.js";
import { answer, Decoder } from "../decoder/decoder.js";

export * from "../server/api.js";

/** There is no server that answers calls. */
export const answersCalls = false;

const place = (name) => `${origin}/model/${name}`;

/** Return a function that computes its value once; after an error it tries again. */
function once(compute) {
  let value = null;
  return () => {
    value ??= compute().catch((error) => {
      value = null;
      throw error;
    });
    return value;
  };
}

async function content(name) {
  const response = await fetch(place(name)).catch(() => null);
  if (!response?.ok) throw new Problem(`The file model/${name} did not arrive. Load the page again.`, 404);
  return response;
}

const card = once(async () => (await content("card.json")).json());
const archive = (name, ...arrays) =>
  once(async () => readNpz(await (await content(name)).arrayBuffer(), arrays));
const meshes = archive("meshes.npz", "vertices", "faces", "home");
const codes = archive("codes.npz", "population", "uniform");
const decoder = once(async () => {
  const opened = new Decoder(place("decoder.onnx"));
  try {
    await opened.ready;
  } catch (error) {
    opened.close();
    throw new Problem(`This browser can't compute shapes. ${error.message} Load the page again.`, 500);
  }
  return opened;
});

export const posterOf = () => place("poster.svg");
export const models = async () => [await card()];
export const modelCard = card;

/** Load what the first shape needs. */
export function ask(model, code) {
  const needed = [meshes(), ...(sameCode(code, new LatentSpace(model).home) ? [] : [decoder()])];
  for (const each of needed) each.catch(() => {}); // the first shape reports it
}

/** Return positions and faces of the reference, which has one mesh here. */
export async function reference() {
  const { vertices, faces } = await meshes();
  return { vertices: vertices.data, faces: faces.data };
}

export const textured = async () => (await content("reference.glb")).arrayBuffer();

/**
 * Return the positions (3V numbers each) of some codes, and a summary of their diagnostics. There is one
 * quality. The home shape is in a file, so that it is there before the decoder.
 * @param {object} model
 * @param {number[][]} latents
 * @param {string} _mesh
 * @param {{quality?: "draft" | "full", signal?: AbortSignal}} [options]
 */
export async function shapes(model, latents, _mesh, { quality = "full", signal } = {}) {
  const space = new LatentSpace(model);
  const { home } = await meshes();
  const compute = async (code) => {
    if (sameCode(code, space.home)) return { positions: home.data.slice(), misfit: 0 };
    return (await decoder()).shape(code, { urgent: quality === "draft", signal });
  };
  // There is nothing better to ask for.
  return answer(model, latents, await Promise.all(latents.map(compute)), "full");
}

/** Return the random code of a seed. The file has codes of the first seeds; then they begin again. */
export async function sample(_model, seed, distribution) {
  const {
    shape: [count, m],
    data,
  } = (await codes())[distribution];
  return [...data.subarray((seed % count) * m, (seed % count) * m + m)];
}

/** Return the shape of a call as GLB, with the polygons, names and materials of the reference. */
export async function file(path, body) {
  if (!path || !body) return refuse("An animation file");
  const { shapes: found } = await shapes(await card(), [body.latent], "fine", { quality: "draft" });
  // With three.js, for which the first requests don't wait.
  const { withPositions } = await import("./glb.js");
  return new Blob([withPositions(await textured(), found[0])], { type: "model/gltf-binary" });
}

async function refuse(what) {
  throw new Problem(
    `${what} needs a server, and this page has none: install shapespace and serve the model.`,
    501,
  );
}

export const interpolation = async () => ({ links: {} });
export const edit = () => refuse("Pulling the shape");
export const encode = () => refuse("Finding the shape of a file");
export const fit = encode;
export const spread = () => refuse("The uncertainty of a file’s shape");
export const writesUsdz = async () => false;
