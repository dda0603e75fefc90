/** The page's state and who wants to know when it changes. */
export class Store {
  #listeners = [];

  constructor(values) {
    Object.assign(this, values);
  }

  /** Call `listener` after each change of one of the `keys`. */
  on(keys, listener) {
    this.#listeners.push([new Set(keys), listener]);
  }

  /** Change some values at once; who listens to several of them is called once. */
  set(patch) {
    const changed = Object.keys(patch).filter((key) => !Object.is(this[key], patch[key]));
    Object.assign(this, patch);
    if (changed.length === 0) return;
    for (const [keys, listener] of this.#listeners) {
      if (changed.some((key) => keys.has(key))) listener();
    }
  }
}
