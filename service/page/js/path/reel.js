/** Frames of a path as the server has answered them, shown at any time between them. */

import { motionOf } from "../server/shape-loop.js";

/** From 0 to 1, slow at both ends. */
export const eased = (share) => share * share * (3 - 2 * share);

/**
 * Show the shape at a share (0 … 1) of a path: between two frames a mixture of both.
 * @param {object} store
 * @param {{mesh: string, shapes: Float32Array[], codes: number[][]}} frames as `api.frames` answers them
 * @param {number} share
 * @param {boolean} loop whether the first frame follows on the last
 */
export function showAt(store, { mesh, shapes, codes }, share, loop = false) {
  const steps = loop ? shapes.length : shapes.length - 1;
  const at = share * steps;
  const k = Math.min(Math.floor(at), steps - 1);
  const rest = at - k;
  const next = shapes[(k + 1) % shapes.length];
  const positions = shapes[k].map((x, i) => x + rest * (next[i] - x));
  const code = codes[(rest < 0.5 ? k : k + 1) % codes.length];
  const { model, placement } = store;
  const motion = motionOf(store, mesh, code, positions);
  const began = performance.now();
  store.set({ code, shape: { model, mesh, code, placement, motion, positions, diagnostics: null, began } });
}
