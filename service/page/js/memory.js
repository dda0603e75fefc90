/** Storage of the browser. `keep` returns whether a value was stored, because a browser may refuse. */

const memory = (storage) => ({
  keep(name, value) {
    try {
      storage().setItem(name, value);
      return true;
    } catch {
      return false; // even reading throws if storage is blocked
    }
  },
  kept(name) {
    try {
      return storage().getItem(name);
    } catch {
      return null;
    }
  },
});

/** Kept from one visit to the next. */
export const always = memory(() => localStorage);
/** Kept while the tab is open. */
export const here = memory(() => sessionStorage);
