/**
 * Keeps the shown shape up to date with the code: a draft while the code moves, the full shape when it rests,
 * both on one mesh.
 *
 * One request runs at a time. A newer request replaces a waiting one, so there is no queue. When the code
 * moves on, the loop cancels a request for a full shape, and a draft that takes too long. It lets a quick
 * draft finish: cancelling it for each pixel of a drag would show nothing until the end of the drag. If the
 * server answers a draft with the full shape, the loop requests no more. From a draft to its full shape,
 * vertices move in steps of a pixel, so that nothing jumps.
 */

import { Matrix4 } from "three";
import * as api from "./api.js";
import { report, say, takeBack } from "../messages.js";

const REST = 160; // ms without movement until the full shape is requested
const TOO_LONG = 400; // ms after which a newer draft cancels a draft

const LINES = 1080; // pixels of a screen that the shape fills; a step is one pixel
const MOST = 24; // steps

/**
 * Return the mesh, by the switch and the model.
 * @returns {"coarse" | "fine"}
 */
export const meshOf = ({ fine, hasFine }) => (fine && hasFine ? "fine" : "coarse");

/**
 * Return the motion (Matrix4) from the server's position of a shape to its shown position. The server aligns
 * each mesh over its own vertices, so the fine and the coarse shape of one code lie a few degrees apart. Fine
 * shapes are shown as they are. Coarse ones are moved to them, as far as known when the mesh was changed.
 */
export function motionOf({ shape, pose }, mesh, code, positions) {
  if (mesh === "fine" || !shape?.motion || !pose) return new Matrix4();
  if (shape.mesh === mesh) return shape.motion;
  return shape.code === code ? pose.motion(shape.positions, positions).invert() : new Matrix4();
}

/** Return positions between a draft and the full shape, without both ends. */
export function* between(draft, full) {
  let [farthest, low, high] = [0, Infinity, -Infinity];
  full.forEach((x, i) => {
    farthest = Math.max(farthest, Math.abs(x - draft[i]));
    low = Math.min(low, x);
    high = Math.max(high, x);
  });
  const steps = Math.min(Math.ceil((farthest / (high - low)) * LINES), MOST);
  for (let k = 1; k < steps; k += 1) yield draft.map((x, i) => x + (k / steps) * (full[i] - x));
}

const nextPicture = () =>
  new Promise((resolve) => {
    requestAnimationFrame(resolve);
  });

export class ShapeLoop {
  #wanted = null;
  #current = null;
  #timer = 0;

  /** @param {import("../store.js").Page} store */
  constructor(store) {
    this.store = store;
    store.on(["code", "model"], () => this.#moved());
    store.on(["fine", "hasFine"], () => {
      if (this.store.shape?.mesh !== meshOf(this.store)) this.#moved();
    });
  }

  #moved() {
    if (this.store.playing || !this.store.model) return;
    const current = this.#current;
    if (current && (current.quality === "full" || performance.now() - current.began > TOO_LONG))
      current.abort.abort();
    clearTimeout(this.#timer);
    this.#want("draft");
  }

  /** Request the full shape once a draft has been shown for a while. */
  #rest() {
    clearTimeout(this.#timer);
    if (this.store.playing || !this.store.model) return;
    this.#timer = setTimeout(() => {
      if (!this.#wanted && !this.#current) this.#want("full");
    }, REST);
  }

  #want(quality) {
    const { model, space, code, placement } = this.store;
    const began = performance.now();
    this.#wanted = { mesh: meshOf(this.store), quality, model, space, code, placement, began };
    if (!this.#current) this.#run();
  }

  async #run() {
    while (this.#wanted) {
      const asked = this.#wanted;
      this.#wanted = null;
      this.#current = { ...asked, abort: new AbortController() };
      try {
        const { model, code, mesh, quality: wanted } = asked;
        const { signal } = this.#current.abort;
        const { shapes, diagnostics } = await api.shapes(model, [code], mesh, { quality: wanted, signal });
        const { quality } = diagnostics;
        if (asked.space === this.store.space && !this.store.playing) {
          const motion = motionOf(this.store, mesh, code, shapes[0]);
          await this.#show({ ...asked, quality, positions: shapes[0], motion, diagnostics });
        }
        if (quality === "draft") this.#rest();
      } catch (error) {
        if (error.offline) await this.#untilReady(asked);
        else {
          if (error.name !== "AbortError") {
            clearTimeout(this.#timer); // the full shape would fail too
            this.store.set({ failed: asked.code });
          }
          report(error);
        }
      }
      this.#current = null;
    }
  }

  async #show(shape) {
    const { shape: before } = this.store;
    const arrived = performance.now();
    const sameCode = before?.code === shape.code && before.mesh === shape.mesh;
    if (shape.quality === "full" && before?.quality === "draft" && sameCode) {
      for (const positions of between(before.positions, shape.positions)) {
        this.store.set({ shape: { ...before, positions } });
        await nextPicture();
        if (this.store.code !== shape.code || this.store.playing || this.store.shape?.mesh !== shape.mesh)
          return;
      }
    }
    // The time of an answer does not include the transition.
    this.store.set({ shape: { ...shape, began: shape.began + performance.now() - arrived } });
  }

  async #untilReady(asked) {
    say("The server does not answer. The shape comes back as soon as it does.", {
      kind: "error",
      key: "offline",
    });
    do
      await new Promise((resolve) => {
        setTimeout(resolve, 500);
      });
    while (!(await api.ready()));
    takeBack("offline");
    say("The server is back.");
    this.#wanted ??= { ...asked, began: performance.now() };
  }
}
