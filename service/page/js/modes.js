/** Pictures of each coordinate, and the region that each factor moves: both from the same few shapes. */

import * as api from "./api.js";
import { report } from "./messages.js";

/** Fetches the shapes of a model factor by factor, while nothing else is wanted of the server. */
export class Modes {
  #abort = new AbortController();
  #regions = [];

  constructor(store, sliders, pictures) {
    Object.assign(this, { store, sliders, pictures });
    store.on(["model"], () => { this.#abort.abort(); this.#regions = []; });
  }

  /** Draw every coordinate's pictures; the home shape is in all of them. */
  async draw() {
    const { model, space } = this.store;
    this.#abort = new AbortController();
    const { signal } = this.#abort;
    try {
      const { shapes: [home] } = await api.shapes(model, [space.home], "coarse", { signal });
      for (const [j, factor] of model.factors.entries()) {
        const changes = [];
        for (let k = factor.start; k < factor.stop; k += 1) {
          const [down, , up] = space.stations(k);
          changes.push({ [k]: down }, { [k]: up });
        }
        const { shapes } = await api.shapes(model, changes.map((change) => space.homeBut(change)), "coarse", { signal });
        for (let k = factor.start; k < factor.stop; k += 1) {
          const [down, up] = shapes.splice(0, 2);
          this.#draw(k, [down, home, up]);
          this.#grow(j, home, [down, up]);
        }
      }
      this.store.set({ regions: this.#regions.map(smooth) });
    } catch (error) {
      report(error);
    }
  }

  #draw(k, shapes) {
    this.sliders.pictures(k).forEach((canvas, i) => this.pictures.draw(canvas, shapes[i]));
  }

  /** Take how far each vertex moves into a factor's region. */
  #grow(j, home, shapes) {
    const region = (this.#regions[j] ??= new Float32Array(home.length / 3));
    for (const shape of shapes) {
      for (let v = 0; v < region.length; v += 1) {
        const i = 3 * v;
        const moved = Math.hypot(shape[i] - home[i], shape[i + 1] - home[i + 1], shape[i + 2] - home[i + 2]);
        region[v] = Math.max(region[v], moved);
      }
    }
  }
}

/** Movement to weights between 0 and 1. Alignment moves everything a little: that doesn't count. */
function smooth(region) {
  const most = region.reduce((a, b) => Math.max(a, b), 1e-9);
  return region.map((moved) => {
    const share = Math.min(Math.max((moved / most - 0.12) / 0.38, 0), 1);
    return share * share * (3 - 2 * share);
  });
}

/** For each vertex of `fine` the nearest one of `coarse` (positions of one shape). */
export function nearest(fine, coarse) {
  const found = new Uint32Array(fine.length / 3);
  for (let v = 0; v < found.length; v += 1) {
    let least = Infinity;
    for (let i = 0; i < coarse.length; i += 3) {
      const d = (fine[3 * v] - coarse[i]) ** 2 + (fine[3 * v + 1] - coarse[i + 1]) ** 2 + (fine[3 * v + 2] - coarse[i + 2]) ** 2;
      if (d < least) [least, found[v]] = [d, i / 3];
    }
  }
  return found;
}
