/**
 * Pictures of coordinates and factors, regions of factors, and the usual residual of the model, all computed
 * from the same few shapes.
 */

import * as api from "../server/api.js";
import { tint } from "./colours.js";
import { percentile } from "../dom.js";
import { report } from "../messages.js";
import { keepMotions, keptMotions, measure, motionsOf } from "../shape/motions.js";
import { sphereOf } from "./scene.js";
import { Surface } from "./surface.js";

/** Fetches the shapes of a model factor by factor, while there are no other requests. */
export class Modes {
  #abort = new AbortController();
  #regions = [];

  /** @param {import("../store.js").Page} store */
  constructor(store, sliders, pictures) {
    this.store = store;
    this.sliders = sliders;
    this.pictures = pictures;
    store.on(["space"], () => {
      this.#abort.abort();
      this.#regions = [];
      store.set({ motions: keptMotions(store.model) });
    });
  }

  /** Draw the pictures of every coordinate, and name its motion. */
  async draw() {
    const {
      model,
      space,
      references: { coarse },
    } = this.store;
    const surface = new Surface(coarse.faces, coarse.vertices.length / 3);
    this.#abort = new AbortController();
    const { signal } = this.#abort;
    const shapesOf = async (codes) => {
      const answer = await api.shapes(model, codes, "coarse", { signal });
      signal.throwIfAborted(); // the page may have left the model after the answer had arrived
      return answer;
    };
    try {
      const {
        shapes: [home],
      } = await shapesOf([space.home]);
      const rest = surface.measure(home);
      const residuals = [];
      const seen = []; // measures of motions, by coordinate
      const isKnown = Boolean(this.store.motions);
      for (const [j, factor] of model.factors.entries()) {
        const changes = [];
        for (let k = factor.start; k < factor.stop; k += 1) {
          const [down, up] = space.ends(k);
          changes.push({ [k]: down }, { [k]: up });
        }
        const codes = changes.map((change) => space.homeBut(change));
        const { shapes, diagnostics } = await shapesOf(codes);
        residuals.push(diagnostics.residual);
        for (let k = factor.start; k < factor.stop; k += 1) {
          const [down, up] = shapes.splice(0, 2);
          this.#draw(k, [down, up]);
          seen[k] = measure(home, down, up);
          this.#grow(j, surface, rest, [down, up]);
        }
        if (!isKnown) this.store.set({ motions: motionsOf(model.factors.slice(0, j + 1), seen) });
        this.#regions[j] = smooth(this.#regions[j]);
        this.pictures.draw(
          this.sliders.picture(j),
          home,
          tint(this.#regions[j]),
          around(home, this.#regions[j]),
        );
      }
      const motions = motionsOf(model.factors, seen);
      keepMotions(model, motions);
      this.store.set({ regions: this.#regions, usual: percentile(residuals, 0.5), motions });
    } catch (error) {
      report(error);
    }
  }

  #draw(k, shapes) {
    this.sliders.pictures(k).forEach((canvas, i) => this.pictures.draw(canvas, shapes[i]));
  }

  /** Add the changes of lengths and angles at each vertex to a factor's region. */
  #grow(j, surface, rest, shapes) {
    const region = (this.#regions[j] ??= new Float32Array(surface.vertexCount));
    for (const shape of shapes) {
      const now = surface.measure(shape);
      const [stretch, bending] = [surface.stretch(rest, now), surface.bending(rest, now)];
      const change = stretch.map((value, edge) => Math.hypot(value, bending[edge]));
      surface.atVertices(change, rest, false).forEach((value, v) => {
        region[v] = Math.max(region[v], value);
      });
    }
  }
}

/** Return weights between 0 and 1 from changes; small changes, which occur everywhere, give 0. */
function smooth(region) {
  const most = Math.max(percentile(region, 0.99), 1e-9); // one nearly vanishing edge would dim all others
  return region.map((change) => {
    const share = Math.min(Math.max((change / most - 0.15) / 0.35, 0), 1);
    return share * share * (3 - 2 * share);
  });
}

/** Return the sphere around a region in positions (3V numbers). */
function around(positions, region) {
  const inside = [...region.keys()].filter((vertex) => region[vertex] > 0.5);
  const corners = inside.flatMap((vertex) => [...positions.subarray(3 * vertex, 3 * vertex + 3)]);
  return sphereOf(Float32Array.from(corners));
}

/** Return the nearest vertex of `coarse` for each vertex of `fine` (positions of one shape). */
export function nearest(fine, coarse) {
  const found = new Uint32Array(fine.length / 3);
  for (let v = 0; v < found.length; v += 1) {
    let least = Infinity;
    for (let i = 0; i < coarse.length; i += 3) {
      let d = 0;
      for (let axis = 0; axis < 3; axis += 1) d += (fine[3 * v + axis] - coarse[i + axis]) ** 2;
      if (d < least) [least, found[v]] = [d, i / 3];
    }
  }
  return found;
}
