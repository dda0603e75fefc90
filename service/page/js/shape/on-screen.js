/** Says whether the shape on the screen belongs to the code, and how good this shape is. */

import { element, find } from "../dom.js";
import { sameCode } from "../server/space.js";
import { inShort, inWords } from "./diagnostics.js";

const LATE = 300; // ms without a newer shape after which a shape of another code is greyed

/** The verdict where the shape on the screen is not that of the code. */
const INSTEAD = {
  busy: { how: "busy", line: "Computing this shape …" },
  failed: { how: "busy poor", line: "No shape for these values" },
};

/**
 * While the shape belongs to another code, or there is none yet, the stage is `aria-busy`: its shape is grey
 * below a turning ring. During a drag the newest shape is always a little behind, which is not marked.
 */
export class OnScreen {
  #timer = 0;
  #state = "busy";

  #timed = null; // the last shape that was drawn

  /** `canvas` fires `drawn` after each picture. @param {import("../store.js").Page} store */
  constructor(store, canvas, stage) {
    this.store = store;
    this.stage = stage;
    this.box = find("#diagnostics", stage);
    store.on(["shape"], () => this.#arrived());
    store.on(["code", "failed"], () => this.#moved());
    store.on(["shape", "usual"], () => this.#judge());
    canvas.addEventListener("drawn", () => this.#drawn());
  }

  get #isCurrent() {
    const { shape, code } = this.store;
    return Boolean(shape && code && sameCode(shape.code, code));
  }

  /** Say what is drawn, and how long it took. */
  #drawn() {
    const { shape, playing } = this.store;
    if (!shape || shape === this.#timed) return;
    this.#timed = shape;
    const took = performance.now() - shape.began;
    const frame = playing ? "playing" : `${took.toFixed(0)} ms to the picture`;
    find("#frame-time").textContent = `${shape.positions.length / 3} vertices · ${frame}`;
    this.stage.dataset.shown = shape.mesh;
    if (this.#isCurrent) this.stage.dataset.quality = shape.quality ?? "draft";
  }

  #arrived() {
    if (!this.store.shape) this.stage.removeAttribute("data-shown");
    this.#stop();
    this.#is(this.store.shape ? "" : "busy");
    this.#moved();
  }

  #moved() {
    const { code, failed } = this.store;
    if (!this.#isCurrent) this.stage.removeAttribute("data-quality");
    if (this.#isCurrent || (failed && failed === code)) {
      this.#stop();
      this.#is(this.#isCurrent ? "" : "failed");
    } else this.#timer ||= setTimeout(() => this.#is("busy"), LATE);
  }

  #stop() {
    clearTimeout(this.#timer);
    this.#timer = 0;
  }

  #is(state) {
    if (this.#state === state) return;
    this.#state = state;
    this.stage.ariaBusy = String(state === "busy");
    this.stage.classList.toggle("stale", state !== "");
    this.#judge();
  }

  /** Describe the shape on the screen; say nothing about frames of a path, which have no diagnostics. */
  #judge() {
    const { shape, usual } = this.store;
    const instead = INSTEAD[this.#state];
    const words = instead || !shape?.diagnostics ? [] : inWords(shape.diagnostics, usual);
    const { how, line } = instead ?? inShort(words);
    this.box.className = how;
    find("summary", this.box).textContent = line;
    find("ul", this.box).replaceChildren(
      ...words.map(([is, , textContent]) => element("li", { className: is, textContent })),
    );
  }
}
