/**
 * Keeps the shape shown abreast of the code: a draft as it moves, the full shape when it rests, both on one
 * mesh.
 *
 * One request is under way at a time; what is asked for meanwhile supersedes what waited, so nothing queues.
 * A full shape on its way is dropped as soon as the code moves on, and so is a draft that takes too long. A
 * draft that is quick is let finish: dropping it for each pixel of a drag would show nothing until the hand
 * rests. Where the server has answered a draft by the full shape, nothing more is asked for. From a draft to
 * its full shape vertices move in steps of a pixel, so that nothing jumps.
 */

import { Matrix4 } from "three";
import * as api from "./api.js";
import { report, say, takeBack } from "../messages.js";

const REST = 160; // ms without movement until the full shape is asked for
const TOO_LONG = 400; // ms after which a draft is given up for a newer one

const LINES = 1080; // of a screen that a shape fills: a step is as large as one
const MOST = 24; // steps

/**
 * The mesh that the switch and the model give.
 * @returns {"coarse" | "fine"}
 */
export const meshOf = ({ fine, hasFine }) => (fine && hasFine ? "fine" : "coarse");

/**
 * The motion (Matrix4) from where the server has a shape to where it is shown. Each mesh is aligned over its
 * own vertices, so that the fine and the coarse shape of one code lie a few degrees apart: fine ones are
 * shown where they are, and coarse ones in their place, as far as that was known when the mesh was changed.
 */
export function motionOf({ shape, pose }, mesh, code, positions) {
  if (mesh === "fine" || !shape?.motion || !pose) return new Matrix4();
  if (shape.mesh === mesh) return shape.motion;
  return shape.code === code ? pose.motion(shape.positions, positions).invert() : new Matrix4();
}

/** Positions on the way from a draft to the full shape, both ends left out. */
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

  /** Ask for the full shape once a draft has been there for a while. */
  #rest() {
    clearTimeout(this.#timer);
    if (this.store.playing || !this.store.model) return;
    this.#timer = setTimeout(() => {
      if (!this.#wanted && !this.#current) this.#want("full");
    }, REST);
  }

  #want(quality) {
    const { model, code, placement } = this.store;
    this.#wanted = { mesh: meshOf(this.store), quality, model, code, placement, began: performance.now() };
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
        if (model === this.store.model && !this.store.playing) {
          const motion = motionOf(this.store, mesh, code, shapes[0]);
          const told = quality === "full" ? diagnostics : null;
          await this.#show({ ...asked, quality, positions: shapes[0], motion, diagnostics: told });
        }
        if (quality === "draft") this.#rest();
      } catch (error) {
        if (error.offline) await this.#untilReady(asked);
        else {
          if (error.name !== "AbortError") clearTimeout(this.#timer); // the full shape would fail too
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
    // How long it takes to settle is no part of how long it took to come.
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
