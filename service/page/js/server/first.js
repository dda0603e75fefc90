/**
 * Sends the requests for the first shape. This script and its imports arrive before all others, so that the
 * server's answers and the other scripts arrive together.
 */

import { find } from "../dom.js";
import * as api from "./api.js";
import { LatentSpace, codeIn } from "./space.js";

const PREFERRED = "figure";
const SLOW = 4000; // ms without a shape after which the ring turns

/** Return the model that is shown unless the address names another. */
export const preferred = (models) => models.find(({ name }) => name === PREFERRED) ?? models[0];

/** The models that the server lists. */
export const listed = api.models();

async function begin() {
  const models = await listed;
  const asked = new URLSearchParams(location.hash.slice(1));
  const named = models.find(({ name }) => name === asked.get("model"));
  const model = named ?? preferred(models);
  if (!model) return;
  const space = new LatentSpace(model);
  const code = named && codeIn(asked.get("z"), model.latent_dimension);
  api.ask(model, space.wrapAll(code ?? space.home));
  find("#poster").src = api.posterOf(model);
}

setTimeout(() => find(".stage").classList.add("slow"), SLOW);
begin().catch(() => {}); // the page reports it when its scripts have arrived
