/**
 * Edits the shape by pulling vertices. Pulled vertices stay pinned, and the server finds the closest code.
 */

import { Matrix4, Vector3 } from "three";
import * as api from "../server/api.js";
import { readable } from "../dom.js";
import { report, say, takeBack } from "../messages.js";
import { nearest } from "../view/modes.js";
import { matrixOf } from "../view/pose.js";
import { diagonalOf } from "../view/scene.js";
import { fixedBy } from "../server/space.js";

const MET = 0.01; // distance from a pin, as a share of the diagonal, at which it counts as reached
const REACH = { mouse: 12, touch: 24 }; // pixels beside the shape at which a press means its nearest vertex
const STILL = 4; // pixels that the pointer may move during a press
const NEARER = 0.9; // a code that leaves more than this share of the distance does not change the shape

/**
 * @typedef {object} Pin
 * @property {string} mesh the mesh of its vertex
 * @property {number} vertex
 * @property {Vector3} position target of the vertex, in the scene
 */

export class Pull {
  #held = null; // the current pull: its pin, and the shape at its start
  #last = null; // the last pull, also after its end
  #wanted = false;
  #busy = false;
  #answer = null;
  #own = null; // the code at the start of the pull, or its last one
  #abort = new AbortController();

  /** @param {import("../store.js").Page} store */
  constructor(store, viewer) {
    this.store = store;
    this.viewer = viewer;
    const { canvas } = viewer;
    store.on(["pull"], () => {
      if (store.pull && !api.answersCalls) {
        store.set({ pull: false });
        api.edit(store.model, {}).catch(report); // which says why
      }
      canvas.classList.toggle("pulling", store.pull);
      store.set({ hover: null });
    });
    store.on(["code"], () => {
      if ((this.#held || this.#busy) && store.code !== this.#own) this.#leave();
    });
    // Before the controls get the event and turn the view.
    canvas.addEventListener("pointerdown", (event) => this.#pick(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.#hover(event));
    canvas.addEventListener("pointerleave", () => store.set({ hover: null }));
    // Two quick presses are two pulls, not a wish to see all of the shape.
    canvas.addEventListener("dblclick", (event) => store.pull && event.stopImmediatePropagation(), {
      capture: true,
    });
    addEventListener("pointermove", (event) => this.#drag(event));
    for (const end of ["pointerup", "pointercancel"]) addEventListener(end, (event) => this.#let(event));
  }

  /** Return the vertex that a press at this event would pull, or null. */
  #meant(event) {
    if (!this.store.pull || this.store.playing || !this.store.shape) return null;
    return this.viewer.picker.pick(event, REACH[event.pointerType] ?? REACH.mouse);
  }

  /** Mark the vertex that a press would pull; a finger hides it, so only for the mouse and the pen. */
  #hover(event) {
    if (!this.store.pull || this.#held || event.buttons || event.pointerType === "touch") return;
    this.store.set({ hover: this.#meant(event)?.vertex ?? null });
  }

  #pick(event) {
    if (this.#held) event.stopImmediatePropagation(); // a second finger during a pull
    if (event.button !== 0 || this.#held) return;
    const hit = this.#meant(event);
    if (!hit) return;
    event.stopImmediatePropagation();
    this.viewer.canvas.setPointerCapture(event.pointerId);
    const { pins, shape } = this.store;
    const there = pins.find(({ mesh, vertex }) => mesh === shape.mesh && vertex === hit.vertex);
    const pin = there ?? { mesh: shape.mesh, ...hit };
    this.take(pin, event); // first, so that changes during the pull belong to its step in the history
    this.store.set({ pins: there ? pins : [...pins, pin], hover: null });
  }

  /** Begin to drag a pin with the pointer of this event. */
  take(pin, event) {
    const { shape, code, playing } = this.store;
    if (playing || !shape) return;
    const { mesh, motion, placement, positions } = shape;
    // From the server's position of the shape
    const there = (placement ?? new Matrix4()).clone().multiply(motion);
    const before = { code, placement: this.store.placement };
    const { pointerId: pointer, clientX, clientY } = event;
    this.#held = { pin, mesh, motion, there, positions, pointer, before, from: { clientX, clientY } };
    this.#last = this.#held;
    this.#own = code;
    this.store.set({ moving: true });
  }

  #drag(event) {
    if (!this.#held || event.pointerId !== this.#held.pointer) return;
    const { pin, from } = this.#held;
    if (from && isStill(from, event)) return;
    this.#held.from = null; // it is a drag from here on, also back to its start
    const moved = { ...pin, position: this.viewer.picker.unproject(event, pin.position) };
    this.#held.pin = moved;
    this.store.set({ pins: this.store.pins.map((each) => (each === pin ? moved : each)) });
    this.#wanted = true;
    if (!this.#busy) this.#solve();
  }

  /** Send the newest targets, once the last request is answered. */
  async #solve() {
    const { signal } = (this.#abort = new AbortController());
    this.#busy = true;
    this.store.set({ solving: this.#last.pin.vertex });
    while (this.#wanted) {
      this.#wanted = false;
      const { before, mesh, motion, there, positions } = this.#last;
      const { code } = before;
      const { model, locked, pins } = this.store;
      const targets = this.#targets(pins, mesh, there);
      const began = awayFrom(targets, positions);
      try {
        const body = { latent: code, mesh, targets, anchored: true, fixed: fixedBy(locked, code) };
        const { latent, placement: place, residual, distances } = await api.edit(model, body, signal);
        signal.throwIfAborted(); // the pull may have ended after the answer had arrived
        const follows = residual < NEARER * rootMeanSquare(began);
        // The rest of the shape stays, and the coarse shape keeps its position relative to the fine one.
        const placement = there.clone().multiply(matrixOf(place)).multiply(motion.clone().invert());
        const kept = latent.map((value, k) => (locked[k] ? code[k] : value));
        this.#own = follows ? kept : code;
        this.#answer = { distances: follows ? distances : began, follows };
        this.store.set(follows ? { code: kept, placement } : before);
      } catch (error) {
        if (signal.aborted) return;
        report(error);
        break;
      }
    }
    this.#busy = false;
    this.store.set({ solving: null });
    if (!this.#held) this.#done();
  }

  /** Give up, because something else has changed the shape or the model. */
  #leave() {
    this.#abort.abort();
    this.#held = this.#answer = null;
    this.#busy = this.#wanted = false;
    this.store.set({ moving: false, solving: null });
  }

  /** Return the pins as targets for the server, in the frame of the shape at the start of the pull. */
  #targets(pins, mesh, there) {
    const back = there.clone().invert();
    const { references } = this.store;
    const found = new Map(
      pins.map((pin) => [vertexOf(pin, mesh, references), pin.position.clone().applyMatrix4(back).toArray()]),
    );
    return [...found].map(([vertex, position]) => ({ vertex, position }));
  }

  #let(event) {
    if (event.pointerId !== this.#held?.pointer) return;
    this.#held = null;
    if (!this.#busy) this.#done();
  }

  #done() {
    this.store.set({ moving: false });
    if (!this.#answer) return;
    const { distances, follows } = this.#answer;
    const {
      references: { coarse },
      locked,
    } = this.store;
    this.#answer = null;
    const shares = distances.map((distance) => distance / diagonalOf(coarse.vertices));
    const missed = shares.filter((share) => share > MET);
    const far = `${readable(100 * Math.max(...shares), 2)} % of the diagonal`;
    takeBack("pull");
    if (missed.length === 0) {
      say(`The shape has followed. It is ${far} from the place where you pulled it.`, { key: "pull" });
      return;
    }
    const which =
      shares.length === 1
        ? "The shape does not reach the pin"
        : `The shape does not reach ${missed.length} of ${shares.length} pins`;
    const stays = follows ? "" : " The shape stays as it was.";
    const why = locked.some(Boolean)
      ? "Unlock coordinates that move this place, or pull less."
      : "Pull less, or remove a pin.";
    say(`${which}. The distance is ${far}.${stays} ${why}`, { key: "pull" });
  }
}

/** Return whether the pointer is where it was at its press, so that this is no drag. */
export const isStill = (from, { clientX, clientY }) =>
  Math.hypot(clientX - from.clientX, clientY - from.clientY) <= STILL;

/** Return the vertex of a pin on one of the meshes: its own, or the nearest one. */
export function vertexOf(pin, mesh, references) {
  if (pin.mesh === mesh || !references.fine) return pin.vertex;
  const { vertices } = references[pin.mesh];
  return nearest(vertices.subarray(3 * pin.vertex, 3 * pin.vertex + 3), references[mesh].vertices)[0];
}

/** Return the distance of each target from its vertex, given positions (3V numbers). */
const awayFrom = (targets, positions) =>
  targets.map(({ vertex, position }) =>
    new Vector3().fromArray(positions, 3 * vertex).distanceTo(new Vector3(...position)),
  );

const rootMeanSquare = (values) => Math.hypot(...values) / Math.sqrt(values.length);
