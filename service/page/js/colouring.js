/** What colours the shape: the region of a factor, stretch, bending, or nothing. */

import * as api from "./api.js";
import { diverging, gradient, tint } from "./colours.js";
import { element, find, percentile, readable } from "./dom.js";
import { report } from "./messages.js";
import { nearest } from "./modes.js";
import { Surface } from "./surface.js";

/** The measures and the legend are those of the server's coloured files; here they are told in units for people. */
const KINDS = {
  stretch: {
    shown: (value) => 100 * Math.expm1(value),
    unit: " %",
    ends: ["shorter", "longer"],
    title: "Stretch: change of length",
  },
  bending: {
    shown: (value) => (180 / Math.PI) * value,
    unit: "°",
    ends: ["concave", "convex"],
    title: "Bending: change of angle",
  },
};

const SMOOTHED = 4; // times, about as far as coarse vertices lie apart
const SMALLEST = 0.01; // end of the legend, in either measure

export class Colouring {
  #surfaces = new Map();
  #bases = new Map();
  #nearest = null;
  #limit = 0;

  /** @param {import("./store.js").Page} store */
  constructor(store, { legend, against }) {
    this.store = store;
    this.legend = legend;
    this.against = against;
    find(".scale", legend).style.backgroundImage = gradient;
    store.on(["model"], () => { this.#surfaces.clear(); this.#bases.clear(); this.#nearest = null; });
    store.on(["model", "colour", "against"], () => { this.#limit = 0; });
    store.on(["keyframes", "against", "model"], () => this.#choices());
    against.addEventListener("change", () => store.set({ against: Number(against.value) }));
  }

  /** Colours (3V) for the shape shown, or null; fills the legend. */
  of({ mesh, positions }) {
    const { colour, highlight, regions, moving } = this.store;
    const region = highlight !== null && !(moving && colour !== "none") && regions?.[highlight];
    const kind = KINDS[colour];
    this.legend.hidden = !kind;
    const values = kind && this.#values(kind, mesh, positions);
    if (region) return tint(mesh === "fine" ? this.#onFine(region) : region);
    return values ? diverging(values, this.#limit) : null;
  }

  #values(kind, mesh, positions) {
    const surface = this.#surface(mesh);
    const base = this.#base(mesh, surface);
    if (!base) return null;
    const edges = surface[this.store.colour](base, surface.measure(positions));
    const values = surface.atVertices(edges, base, this.store.colour === "bending");
    const most = nice(Math.max(SMALLEST, percentile(values.map(Math.abs), 0.98)));
    // While something moves the scale only grows: colours that change their meaning can't be read.
    this.#limit = this.store.moving || this.store.playing ? Math.max(this.#limit, most) : most;
    this.#tell(kind, edges);
    return values;
  }

  #surface(mesh) {
    if (!this.#surfaces.has(mesh)) {
      const { faces, vertices } = this.store.references[mesh];
      this.#surfaces.set(mesh, new Surface(faces, vertices.length / 3));
    }
    return this.#surfaces.get(mesh);
  }

  /** Lengths and angles to compare with; null until they have come from the server. */
  #base(mesh, surface) {
    const { against, keyframes, model, references } = this.store;
    const code = keyframes[against];
    const key = `${mesh} ${code ?? "mean"}`;
    if (!this.#bases.has(key)) {
      this.#bases.set(key, null);
      const shape = code ? api.shapes(model, [code], mesh).then(({ shapes }) => shapes[0]) : references[mesh].vertices;
      Promise.resolve(shape).then((positions) => {
        this.#bases.set(key, surface.measure(positions));
        this.store.set({ repaint: {} });
      }).catch((error) => { this.#bases.delete(key); report(error); });
    }
    return this.#bases.get(key);
  }

  /** A region's weights at fine vertices: those of the nearest coarse ones, with its rim smoothed. */
  #onFine(region) {
    const { coarse, fine } = this.store.references;
    this.#nearest ??= nearest(fine.vertices, coarse.vertices);
    const surface = this.#surface("fine");
    let weights = Float32Array.from(this.#nearest, (vertex) => region[vertex]);
    for (let times = 0; times < SMOOTHED; times += 1) weights = surface.smooth(weights);
    return weights;
  }

  #tell({ shown, unit, ends, title }, edges) {
    const size = edges.reduce((sum, value) => sum + Math.abs(value), 0) / edges.length;
    const [low, high] = [edges.reduce((a, b) => Math.min(a, b)), edges.reduce((a, b) => Math.max(a, b))];
    const text = (value) => readable(shown(value), 2).replace("-", "−");
    const signed = (value) => `${value > 0 ? "+" : ""}${text(value)}`;
    find(".title", this.legend).textContent = title;
    find(".low", this.legend).textContent = `${signed(-this.#limit)}${unit} ${ends[0]}`;
    find(".high", this.legend).textContent = `${signed(this.#limit)}${unit} ${ends[1]}`;
    find(".numbers", this.legend).textContent =
      `On average ${text(size)}${unit}, from ${signed(low)} to ${signed(high)}${unit}`;
  }

  #choices() {
    const { against, keyframes } = this.store;
    this.against.replaceChildren(
      element("option", { value: -1, textContent: "the mean" }),
      ...keyframes.map((_, i) => element("option", { value: i, textContent: `keyframe ${i + 1}` })),
    );
    if (against >= keyframes.length) this.store.set({ against: -1 });
    this.against.value = this.store.against;
  }
}

/** The next of 1, 2, 5, 10, … times a power of ten. */
function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 2, 5, 10].find((step) => step * power >= value * 0.999);
}
