/** Files to keep, and calls to copy. */

import * as api from "./api.js";
import { element, find } from "./dom.js";
import { reporting, say } from "./messages.js";

/** What the server offers for one shape. */
export const SHAPE_FORMATS = ["glb", "gltf", "obj", "ply", "stl", "npz", "zip", "json"];

/** Animations that say how long a frame is shown; the server takes one frame a second or more. */
const TIMED = ["glb", "usd", "usdz"];

const rounded = (code) => code.map((value) => Number(value.toFixed(6)));

export async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    say(`Copied ${what}.`);
  } catch {
    say(`The browser does not let the page copy. Here is ${what}: ${text}`, { kind: "error" });
  }
}

function keep(blob, name) {
  const link = element("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

export class Files {
  constructor(store, path, root) {
    Object.assign(this, { store, path });
    this.format = find("#format", root);
    this.format.append(...SHAPE_FORMATS.map((name) => element("option", { textContent: name })));
    this.curl = find("#curl", root);
    this.animation = find("#animation-format");
    store.on(["code", "model", "fine", "colour", "against", "keyframes"], () => this.#tell());
    this.format.addEventListener("change", () => this.#tell());
    find("#download", root).addEventListener("click", reporting(() => this.#shape()));
    find("#download-animation").addEventListener("click", reporting(() => this.#animation()));
    store.on(["keyframes"], reporting(() => this.#animationFormats()));
    find("#copy-curl", root).addEventListener("click", () => copy(this.curl.textContent, "the call"));
  }

  /** Path and body of the call that answers the shape as a file. */
  get #call() {
    const { model, code, fine, colour, against, keyframes } = this.store;
    const query = new URLSearchParams({ format: this.format.value });
    if (colour !== "none" && this.format.value !== "stl") { // which has no place for colours
      query.set("color", colour);
      if (keyframes[against]) query.set("against", rounded(keyframes[against]));
    }
    const latent = rounded(code);
    return { path: `${model.links.mesh}?${query}`, body: fine ? { latent } : { latent, mesh: "coarse" } };
  }

  #tell() {
    if (!this.store.model) return;
    const { path, body } = this.#call;
    this.curl.textContent = `curl '${api.origin}${path}' -H 'content-type: application/json' `
      + `-d '${JSON.stringify(body)}' -o ${this.store.model.name}.${this.format.value}`;
  }

  async #shape() {
    const { path, body } = this.#call;
    keep(await api.file(path, body), `${this.store.model.name}.${this.format.value}`);
  }

  /** Offer what the server has for a path: that depends on what is installed with it. */
  async #animationFormats() {
    const { keyframes, model } = this.store;
    find("#download-animation").disabled = keyframes.length < 2;
    if (keyframes.length < 2 || this.animation.options.length) return;
    const { links } = await api.interpolation(model, { keyframes });
    const names = Object.keys(links).filter((name) => !["self", "frames"].includes(name));
    this.animation.replaceChildren(...names.map((name) => element("option", { textContent: name })));
  }

  async #animation() {
    const { model, fine } = this.store;
    say("The server makes the animation …", { key: "animation" });
    try {
      await this.#animationFormats(); // they are not there yet where the server was away
      const format = this.animation.value;
      const { links } = await api.interpolation(model, { ...this.path.request, mesh: fine ? "fine" : "coarse" });
      const speed = TIMED.includes(format) ? `&fps=${Math.max(this.path.fps, 1)}` : "";
      keep(await api.file(links[format] + speed), `${model.name}-animation.${format}`);
      say("The animation is saved.", { key: "animation" });
    } catch (error) {
      say(error.message, { kind: "error", key: "animation" });
    }
  }
}
