/**
 * Keeps the shape shown abreast of the code: coarse as it moves, fine when it rests.
 *
 * One request is under way at a time; what is asked for meanwhile supersedes what waited, so nothing queues. A fine
 * shape on its way is dropped as soon as the code moves on, and so is a coarse one that takes too long. A coarse one
 * that is quick is let finish: dropping it for each pixel of a drag would show nothing until the hand rests.
 */

import { Matrix4 } from "three";
import * as api from "./api.js";
import { report, say, takeBack } from "./messages.js";
import { moved } from "./pose.js";

const REST = 160; // ms without movement until the fine mesh is asked for
const TOO_LONG = 400; // ms after which a coarse shape is given up for a newer one

export class ShapeLoop {
  #wanted = null;
  #current = null;
  #timer = 0;

  constructor(store) {
    this.store = store;
    store.on(["code", "model"], () => this.#moved());
    store.on(["fine", "hasFine"], () => this.#rest());
  }

  #moved() {
    if (this.store.playing) return;
    const current = this.#current;
    if (current && (current.mesh === "fine" || performance.now() - current.began > TOO_LONG)) current.abort.abort();
    this.#want("coarse");
    this.#rest();
  }

  /** Ask for the fine mesh once nothing has moved for a while. */
  #rest() {
    clearTimeout(this.#timer);
    if (this.store.playing || !this.store.model) return;
    if (!this.store.fine) {
      if (this.store.shape?.mesh === "fine") this.#want("coarse");
      return;
    }
    this.#timer = setTimeout(() => {
      const onItsWay = this.#current?.mesh === "fine"; // of this code: another would have dropped it
      if (this.store.hasFine && this.store.shape?.mesh !== "fine" && !onItsWay) this.#want("fine");
    }, REST);
  }

  #want(mesh) {
    const { model, code, placement } = this.store;
    this.#wanted = { mesh, model, code, placement, began: performance.now() };
    if (!this.#current) this.#run();
  }

  async #run() {
    while (this.#wanted) {
      const asked = this.#wanted;
      this.#wanted = null;
      this.#current = { ...asked, abort: new AbortController() };
      try {
        const { shapes, diagnostics } = await api.shapes(asked.model, [asked.code], asked.mesh, this.#current.abort.signal);
        if (asked.model === this.store.model && !this.store.playing) {
          this.store.set({ shape: { ...asked, ...this.#placed(shapes[0], asked), diagnostics } });
        }
        if (asked.mesh === "coarse") this.#rest();
      } catch (error) {
        if (error.offline) await this.#untilReady(asked);
        else report(error);
      }
      this.#current = null;
    }
  }

  /** Positions, and the motion that brought them to where the coarse shape of the same code is. */
  #placed(positions, { mesh, code }) {
    const { shape, pose } = this.store;
    if (mesh === "coarse" || shape?.mesh !== "coarse" || shape.code !== code) return { positions, motion: new Matrix4() };
    const motion = pose.motion(positions, shape.positions);
    return { positions: moved(positions, motion), motion };
  }

  async #untilReady(asked) {
    say("The server does not answer. The shape comes back as soon as it does.", { kind: "error", key: "offline" });
    do await new Promise((resolve) => { setTimeout(resolve, 500); });
    while (!(await api.ready()));
    takeBack("offline");
    say("The server is back.");
    this.#wanted ??= { ...asked, began: performance.now() };
  }
}
