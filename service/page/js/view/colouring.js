/** Colours of the shape: the region of a factor, a difference, the uncertainty, or none. */

import * as api from "../server/api.js";
import { distant, diverging, gradient, tint } from "./colours.js";
import { element, find, percentile, readable } from "../dom.js";
import { report } from "../messages.js";
import { colourOf } from "./look.js";
import { nearest } from "./modes.js";
import { diagonalOf } from "./scene.js";
import { Surface } from "./surface.js";

/**
 * Quantities and legends as in the server's coloured files, in readable units. `least`: smallest end of a
 * legend. Distances are shares of the diagonal and have no sign.
 */
const KINDS = {
  stretch: {
    shown: (value) => 100 * Math.expm1(value),
    unit: "\u00a0%",
    ends: ["shorter", "longer"],
    title: "Stretch: change of length",
    signed: true,
    least: 0.01,
    paint: diverging,
  },
  bending: {
    shown: (value) => (180 / Math.PI) * value,
    unit: "°",
    ends: ["concave", "convex"],
    title: "Bending: change of angle",
    signed: true,
    least: 0.01,
    paint: diverging,
  },
  distance: {
    shown: (value) => 100 * value,
    unit: "\u00a0%",
    ends: ["", ""],
    title: "Distance, of the diagonal",
    signed: false,
    least: 0.001,
    paint: distant,
  },
  spread: {
    shown: (value) => 100 * value,
    unit: "\u00a0%",
    ends: ["", ""],
    title: "May be off by, of the diagonal",
    signed: false,
    least: 0.001,
    paint: distant,
  },
};

/** Index of the shape beside among the shapes that colours compare with. */
export const OTHER = -2;
/** Return the code that colours compare with; undefined for the mean. */
export const baseOf = ({ against, keyframes, other }) => (against === OTHER ? other : keyframes[against]);

const SMOOTHED = 4; // smoothing steps, about the distance between coarse vertices

export class Colouring {
  #surfaces = new Map();
  #answers = new Map(); // answers of the server; null until they arrive
  #nearest = null;
  #limit = 0;

  /** @param {import("../store.js").Page} store */
  constructor(store, { legend, against }) {
    this.store = store;
    this.legend = legend;
    this.against = against;
    find(".scale", legend).style.backgroundImage = gradient;
    store.on(["model"], () => {
      this.#surfaces.clear();
      this.#answers = new Map();
      this.#nearest = null;
    });
    store.on(["found"], () => {
      this.#answers = new Map();
    });
    store.on(["model", "colour", "against", "other", "found"], () => {
      this.#limit = 0;
    });
    store.on(["keyframes", "against", "other", "model"], () => this.#choices());
    against.addEventListener("change", () => store.set({ against: Number(against.value) }));
  }

  /** Return colours (3V) for the shown shape, or null, and fill the legend. */
  of({ mesh, positions }) {
    const { colour, highlight, regions } = this.store;
    const region = highlight !== null && regions?.[highlight];
    const kind = KINDS[colour];
    const values = kind && this.#values(kind, mesh, positions);
    this.legend.hidden = !kind || (colour === "spread" && !values);
    if (region) return tint(mesh === "fine" ? this.#onFine(region) : region, colourOf(this.store.material));
    return values ? kind.paint(values, this.#limit) : null;
  }

  #values(kind, mesh, positions) {
    const { colour, moving, playing } = this.store;
    const [measured, values] =
      (colour === "spread" ? this.#spread(mesh) : this.#change(mesh, positions)) ?? [];
    if (!values) return null;
    const most = nice(Math.max(kind.least, percentile(values.map(Math.abs), 0.98)));
    // During a movement the scale only grows, because colours with a changing scale cannot be read.
    this.#limit = moving || playing ? Math.max(this.#limit, most) : most;
    this.#tell(kind, measured);
    return values;
  }

  /** Return the difference, at edges or vertices where it is measured, and at vertices. */
  #change(mesh, positions) {
    const { colour, references } = this.store;
    const surface = this.#surface(mesh);
    const base = this.#base(mesh, surface);
    if (!base) return null;
    if (colour === "distance") {
      const far = apart(base.positions, positions, diagonalOf(references[mesh].vertices));
      return [far, far];
    }
    const measured = surface[colour](base, surface.measure(positions));
    return [measured, surface.atVertices(measured, base, colour === "bending")];
  }

  /** Return the uncertainty of the vertices of a file's shape. */
  #spread(mesh) {
    const { model, found, references } = this.store;
    const diagonal = diagonalOf(references[mesh].vertices);
    const values = this.#asked(`spread ${mesh} ${found.code}`, async () =>
      (await api.spread(model, found, mesh)).map((value) => value / diagonal),
    );
    return values && [values, values];
  }

  #surface(mesh) {
    if (!this.#surfaces.has(mesh)) {
      const { faces, vertices } = this.store.references[mesh];
      this.#surfaces.set(mesh, new Surface(faces, vertices.length / 3));
    }
    return this.#surfaces.get(mesh);
  }

  /** Return lengths and angles to compare with; null until the server has answered. */
  #base(mesh, surface) {
    const { model, references } = this.store;
    const code = baseOf(this.store);
    return this.#asked(`${mesh} ${code ?? "mean"}`, async () => {
      const positions = code ? (await api.shapes(model, [code], mesh)).shapes[0] : references[mesh].vertices;
      return { positions, ...surface.measure(positions) };
    });
  }

  /** Return an answer of the server by name; null until it arrives. */
  #asked(name, ask) {
    const answers = this.#answers; // a late answer goes into a map that is no longer used
    if (!answers.has(name)) {
      answers.set(name, null);
      ask()
        .then((answer) => {
          answers.set(name, answer);
          this.store.set({ repaint: {} });
        })
        .catch((error) => {
          answers.delete(name);
          report(error);
        });
    }
    return answers.get(name);
  }

  /** Return a region's weights at fine vertices: weights of the nearest coarse vertices, smoothed. */
  #onFine(region) {
    const { coarse, fine } = this.store.references;
    this.#nearest ??= nearest(fine.vertices, coarse.vertices);
    const surface = this.#surface("fine");
    let weights = Float32Array.from(this.#nearest, (vertex) => region[vertex]);
    for (let times = 0; times < SMOOTHED; times += 1) weights = surface.smooth(weights);
    return weights;
  }

  /** Fill the legend by values at edges or vertices. */
  #tell({ shown, unit, ends, title, signed }, values) {
    const mean = values.reduce((sum, value) => sum + Math.abs(value), 0) / values.length;
    const [low, high] = [Math.min, Math.max].map((end) => values.reduce((a, b) => end(a, b)));
    const text = (value) => readable(shown(value), 2).replace("-", "−");
    const both = (value) => `${signed && value > 0 ? "+" : ""}${text(value)}`;
    const at = (value) => (value === 0 ? "0" : `${both(value)}${unit}`);
    const [least, middle, most] = [-1, 0, 1].map((k) => this.#limit * (signed ? k : (k + 1) / 2));
    find(".title", this.legend).textContent = title;
    find(".low", this.legend).textContent = `${at(least)} ${ends[0]}`;
    find(".middle", this.legend).textContent = at(middle);
    find(".high", this.legend).textContent = `${at(most)} ${ends[1]}`;
    find(".numbers", this.legend).textContent =
      `Mean ${text(mean)}${unit}, from ${both(low)} to ${both(high)}${unit}`;
  }

  #choices() {
    const { against, keyframes, other } = this.store;
    this.against.replaceChildren(
      element("option", { value: -1, textContent: "the mean" }),
      ...(other ? [element("option", { value: OTHER, textContent: "the shape beside" })] : []),
      ...keyframes.map((_, i) => element("option", { value: i, textContent: `keyframe ${i + 1}` })),
    );
    if (against >= keyframes.length || (against === OTHER && !other)) this.store.set({ against: -1 });
    this.against.value = this.store.against;
  }
}

/** Return the distances of vertices between two shapes, as shares of a diagonal. */
const apart = (from, to, diagonal) =>
  Float32Array.from({ length: to.length / 3 }, (_, v) => {
    const [x, y, z] = [3 * v, 3 * v + 1, 3 * v + 2].map((i) => to[i] - from[i]);
    return Math.hypot(x, y, z) / diagonal;
  });

/** Round up to 1, 2 or 5 times a power of ten. */
function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 2, 5, 10].find((step) => step * power >= value * 0.999);
}
