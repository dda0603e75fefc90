/** Computes shapes in the browser, without a server. */

import { LatentSpace } from "../server/space.js";

const RUNTIME = new URL("../../vendor/onnxruntime/", import.meta.url).href;

/** Return positions of some codes, and a summary of their diagnostics, as the server answers them. */
export function answer(model, latents, found, quality) {
  const space = new LatentSpace(model);
  const inside = latents.every((code) => code.every((value, k) => space.inside(k, space.wrap(k, value))));
  const residual = Math.max(...found.map(({ misfit }) => misfit));
  return {
    shapes: found.map(({ positions }) => positions),
    diagnostics: { quality, residual, inside_bounds: inside },
  };
}

/**
 * A model's `decoder.onnx` in a worker, which computes one code at a time. Codes of the shape on the screen
 * go before codes of pictures.
 */
export class Decoder {
  #worker = new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
  #waiting = [];
  #current = null;

  /**
   * @param {string} decoder address of the file
   * @param {Record<string, string>} [headers] of the request for it
   */
  constructor(decoder, headers = {}) {
    /** @type {Promise<void>} settles when shapes can be computed, or never will */
    this.ready = new Promise((resolve, reject) => {
      this.#current = { resolve, reject };
    });
    this.#worker.addEventListener("message", ({ data }) => this.#answered(data));
    this.#worker.addEventListener("error", (event) => {
      event.preventDefault();
      this.#answered({ failed: event.message ?? "The worker did not start." });
    });
    this.#worker.postMessage({ runtime: RUNTIME, decoder, headers });
  }

  /**
   * Return positions (3V numbers) and misfit of a code.
   * @param {number[]} code
   * @param {{urgent?: boolean, signal?: AbortSignal}} [how]
   * @returns {Promise<{positions: Float32Array, misfit: number}>}
   */
  async shape(code, { urgent = false, signal } = {}) {
    await this.ready;
    signal?.throwIfAborted();
    return new Promise((resolve, reject) => {
      const asked = { code, resolve, reject };
      if (urgent) this.#waiting.splice(this.#waiting.findLastIndex((each) => each.urgent) + 1, 0, asked);
      else this.#waiting.push(asked);
      Object.assign(asked, { urgent });
      signal?.addEventListener("abort", () => {
        this.#waiting = this.#waiting.filter((each) => each !== asked);
        reject(signal.reason);
      });
      this.#next();
    });
  }

  /** End the worker; whoever waits for a shape gets an error. */
  close() {
    this.#worker.terminate();
    const closed = new DOMException("The decoder is closed.", "AbortError");
    for (const { reject } of [this.#current, ...this.#waiting].filter(Boolean)) reject(closed);
  }

  #next() {
    if (this.#current || this.#waiting.length === 0) return;
    this.#current = this.#waiting.shift();
    this.#worker.postMessage({ code: this.#current.code });
  }

  #answered({ failed, ...answer }) {
    const { resolve, reject } = this.#current ?? { reject: console.error };
    this.#current = null;
    if (failed) reject(new Error(failed));
    else resolve(answer);
    this.#next();
  }
}
