/** What the browser keeps of the page; `keep` answers whether it does, as some let pages keep nothing. */

const memory = (storage) => ({
  keep(name, value) {
    try {
      storage().setItem(name, value);
      return true;
    } catch {
      return false; // reading the storage throws already where it is blocked
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
