/** Edits the shape by pulling at a vertex: the server finds the code that follows best. */

import * as THREE from "three";
import * as api from "./api.js";
import { readable } from "./dom.js";
import { report, say } from "./messages.js";
import { matrixOf } from "./pose.js";
import { fixedBy } from "./space.js";

export class Pull {
  #held = null; // what is pulled, from where, since when
  #wanted = null;
  #busy = false;

  constructor(store, viewer) {
    Object.assign(this, { store, viewer });
    const dot = new THREE.MeshBasicMaterial({ color: 0xe08a2c, depthTest: false });
    this.dot = new THREE.Mesh(new THREE.SphereGeometry(1, 16, 12), dot);
    this.dot.renderOrder = 1;
    this.dot.visible = false;
    viewer.scene.add(this.dot);
    const { canvas } = viewer;
    store.on(["pull"], () => canvas.classList.toggle("pulling", store.pull));
    // Before the controls see it, which would turn the view.
    canvas.addEventListener("pointerdown", (event) => this.#take(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.#drag(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => this.#let());
  }

  #take(event) {
    if (!this.store.pull || event.button !== 0 || this.store.playing || !this.store.shape) return;
    const hit = this.viewer.pick(event);
    if (!hit) return;
    event.stopImmediatePropagation();
    this.viewer.canvas.setPointerCapture(event.pointerId);
    const { mesh, motion, placement } = this.store.shape;
    const there = (placement ?? new THREE.Matrix4()).clone().multiply(motion); // from where the server has the shape
    this.#held = { ...hit, mesh, motion, there, pointer: event.pointerId, code: this.store.code };
    this.store.set({ moving: true });
    this.dot.scale.setScalar(0.018 * this.viewer.sphere.radius);
    this.#mark(hit.position);
  }

  #mark(position) {
    this.dot.visible = Boolean(position);
    if (position) this.dot.position.copy(position);
    this.viewer.draw();
  }

  #drag(event) {
    if (!this.#held || event.pointerId !== this.#held.pointer) return;
    const target = this.viewer.unproject(event, this.#held.position);
    this.#mark(target);
    this.#wanted = target;
    if (!this.#busy) this.#solve();
  }

  /** Only the newest target counts; it waits until the one before is answered. */
  async #solve() {
    this.#busy = true;
    while (this.#wanted) {
      const { code, vertex, mesh, motion, there } = this.#held ?? this.last;
      const position = this.#wanted.clone().applyMatrix4(there.clone().invert()).toArray();
      this.#wanted = null;
      const { model, locked } = this.store;
      try {
        const targets = [{ vertex, position }];
        const answer = await api.edit(model, { latent: code, mesh, targets, fixed: fixedBy(locked, code) });
        if (this.store.model !== model) break;
        // What isn't pulled stays where it is; the coarse shape lies beside the fine one as before.
        const placement = there.clone().multiply(matrixOf(answer.placement)).multiply(motion.clone().invert());
        this.store.set({ code: answer.latent.map((value, k) => (locked[k] ? code[k] : value)), placement });
        this.answer = answer;
      } catch (error) {
        report(error);
        break;
      }
    }
    this.#busy = false;
    if (!this.#held) this.#done();
  }

  #let() {
    if (!this.#held) return;
    this.last = this.#held;
    this.#held = null;
    this.#mark(null);
    if (!this.#busy) this.#done();
  }

  #done() {
    this.store.set({ moving: false });
    if (!this.answer) return;
    const { residual } = this.answer;
    this.answer = null;
    if (typeof residual === "number") say(`The shape follows as far as the model can: ${readable(residual)} from where you pulled.`, { key: "pull" });
  }
}
