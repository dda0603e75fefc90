/** What the browser keeps of the page; nothing, and without a word, where it lets pages keep nothing. */

const memory = (storage) => ({
  keep(name, value) {
    try {
      storage().setItem(name, value);
    } catch {
      // Reading the storage throws already where it is blocked.
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

/** From one visit to the next. */
export const always = memory(() => localStorage);
/** As long as the tab is open. */
export const here = memory(() => sessionStorage);
