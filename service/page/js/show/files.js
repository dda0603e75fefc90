/** Files, pictures and videos to save, and calls to copy. */

import { toHash } from "../address.js";
import * as api from "../server/api.js";
import { baseOf } from "../view/colouring.js";
import { element, find, readable } from "../dom.js";
import { reporting, say } from "../messages.js";
import { CODE, FRAME } from "./code.js";
import { picture, record, turntable, videoFormats } from "./video.js";

/** Formats of one shape. */
export const SHAPE_FORMATS = ["glb", "gltf", "obj", "ply", "stl", "npz", "zip", "json"];

/** Animation formats with the time of a frame; the server accepts one frame per second or more. */
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
  /** @param {import("../store.js").Page} store */
  constructor(store, path, viewer, root) {
    this.store = store;
    this.path = path;
    this.viewer = viewer;
    this.format = find("#format", root);
    const formats = api.answersCalls ? SHAPE_FORMATS : ["glb"];
    this.format.append(...formats.map((name) => element("option", { textContent: name })));
    this.code = find("#code", root);
    this.language = find("#language", root);
    const languages = Object.keys(CODE).filter((name) => api.answersCalls || name === FRAME);
    this.language.append(...languages.map((name) => element("option", { textContent: name })));
    this.language.addEventListener("change", () => this.#tell());
    this.seconds = find("#turntable-seconds", root);
    this.animation = find("#animation-format");
    /** @type {NodeListOf<any>} one menu beside each button that records */
    const menus = document.querySelectorAll(".video-format");
    this.video = [...menus];
    for (const menu of this.video) {
      menu.append(
        ...videoFormats().map((value) => element("option", { value, textContent: value.toUpperCase() })),
      );
      menu.addEventListener("change", () => {
        for (const each of this.video) each.value = menu.value;
      });
    }
    this.ar = find("#ar", root);
    store.on(["code", "model", "fine", "colour", "against", "keyframes", "other", "placement"], () =>
      this.#tell(),
    );
    if (this.ar.relList.supports("ar"))
      store.on(
        ["model"],
        reporting(() => this.#offerAR()),
      );
    viewer.canvas.addEventListener("turned", () => this.#tell());
    this.format.addEventListener("change", () => this.#tell());
    find("#download", root).addEventListener(
      "click",
      reporting(() => this.#shape()),
    );
    find("#download-animation").addEventListener(
      "click",
      reporting(() => this.#animation()),
    );
    store.on(
      ["keyframes"],
      reporting(() => this.#animationFormats()),
    );
    find("#copy-code", root).addEventListener("click", () => copy(this.code.textContent, "the call"));
    find("#picture", root).addEventListener(
      "click",
      reporting(() => this.#picture()),
    );
    find("#turntable", root).addEventListener(
      "click",
      reporting(() => this.#turntable()),
    );
    find("#film").addEventListener(
      "click",
      reporting(() => this.#film()),
    );
  }

  /** Return path and body of the call that answers the shape as a file. */
  get #call() {
    const { model, code, fine, colour } = this.store;
    const base = baseOf(this.store);
    const query = new URLSearchParams({ format: this.format.value });
    // STL holds no colours, and the server writes no distances.
    if (["stretch", "bending"].includes(colour) && this.format.value !== "stl") {
      query.set("color", colour);
      if (base) query.set("against", rounded(base));
    }
    const latent = rounded(code);
    const path = `${model.links.mesh}?${query}`.replaceAll("%2C", ",");
    return { path, body: fine ? { latent } : { latent, mesh: "coarse" } };
  }

  #tell() {
    if (!this.store.model) return;
    const { path, body } = this.#call;
    const {
      model: { name, title },
    } = this.store;
    const view = this.viewer.turned ? this.viewer.view : null;
    this.ar.href = this.#usdz;
    const embed = `${api.origin}/?embed${toHash(this.store, view)}`;
    const file = `${name}.${this.format.value}`;
    this.code.textContent = CODE[this.language.value]({ url: api.origin + path, body, file, embed, title });
  }

  /** Return the address of the shape as USDZ, which phones place in the room. */
  get #usdz() {
    const { model, code, fine } = this.store;
    const query = { latent: rounded(code).join(","), format: "usdz", mesh: fine ? "fine" : "coarse" };
    return `${api.origin}${model.links.mesh}?${new URLSearchParams({ ...query, version: model.version })}`;
  }

  /** Offer the shape in the room where the browser can show it and the server writes USDZ. */
  async #offerAR() {
    const room = find("#room");
    room.hidden = true;
    room.hidden = !(await api.writesUsdz(this.store.model));
  }

  async #shape() {
    const { path, body } = this.#call;
    const { name, version } = this.store.model;
    keep(await api.file(`${path}&version=${version}`, body), `${name}.${this.format.value}`);
  }

  async #picture() {
    const { name } = this.store.model;
    keep(await picture(this.viewer), `${name}.png`);
  }

  #turntable() {
    const {
      seconds: { value, valueAsNumber: seconds, validity },
    } = this;
    if (!validity.valid || value === "") throw new Error("Say how many seconds a turn takes, from 1 to 60.");
    return this.#video("turntable", (tell) => {
      tell(seconds);
      return turntable(this.viewer, seconds, this.video[0].value);
    });
  }

  #film() {
    return this.#video("animation", async (tell) => {
      const { seconds, show } = await this.path.film();
      tell(seconds);
      try {
        return await record(this.viewer, seconds, show, this.video[0].value);
      } finally {
        this.path.pause();
      }
    });
  }

  /** Record a video, in real time, and save it. */
  async #video(what, make) {
    if (this.recording) return;
    this.recording = true;
    const { name } = this.store.model;
    try {
      const isGif = this.video[0].value === "gif"; // which takes another time than it lasts
      const tell = (seconds) =>
        say(isGif ? "Making a GIF …" : `Recording, for ${readable(seconds)} s …`, { key: "video" });
      const { blob, extension } = await make(tell);
      keep(blob, `${name}-${what}.${extension}`);
      say(isGif ? "The GIF is saved." : "The video is saved.", { key: "video" });
    } catch (error) {
      // Otherwise the path has changed.
      if (error.name !== "AbortError") say(error.message, { kind: "error", key: "video" });
    } finally {
      this.recording = false;
    }
  }

  /** Offer the formats of a path, which depend on the packages of the server. */
  async #animationFormats() {
    const { keyframes, model } = this.store;
    for (const button of ["#download-animation", "#film"]) find(button).disabled = keyframes.length < 2;
    if (keyframes.length < 2 || this.animation.options.length) return;
    const { links } = await api.interpolation(model, { keyframes });
    if (this.animation.options.length) return; // a later answer keeps the user's choice
    const names = Object.keys(links).filter((name) => !["self", "frames"].includes(name));
    this.animation.replaceChildren(...names.map((name) => element("option", { textContent: name })));
  }

  async #animation() {
    const { model, fine } = this.store;
    const { fps, request } = this.path; // before the user may change it
    const name = find("#path-name").value.trim();
    say("The server makes the animation …", { key: "animation" });
    try {
      await this.#animationFormats(); // they are missing if the server did not answer
      const format = this.animation.value;
      const { links } = await api.interpolation(model, {
        ...request,
        ...(name && { name }),
        mesh: fine ? "fine" : "coarse",
      });
      const speed = TIMED.includes(format) ? `&fps=${Math.max(fps, 1)}` : "";
      keep(await api.file(links[format] + speed), `${name || `${model.name}-animation`}.${format}`);
      say("The animation is saved.", { key: "animation" });
    } catch (error) {
      say(error.message, { kind: "error", key: "animation" });
    }
  }
}
