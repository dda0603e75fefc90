/** Helpers to build the page. Text is inserted as text, never as HTML. */

/** @type {(selector: string, root?: ParentNode) => any} */
export const find = (selector, root = document) => root.querySelector(selector);
export const clone = (name) => find(`template#${name}`).content.firstElementChild.cloneNode(true);
export const element = (name, properties = {}, ...children) => {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
};

/** Format a number with its meaningful digits. */
export const readable = (value, digits = 3) => Number(value.toPrecision(digits)).toString();

/** Return the whole number in an input, moved into its range, and write it there. */
export function within(input) {
  const whole = Math.round(input.valueAsNumber) || 0;
  input.value = Math.min(Math.max(whole, Number(input.min)), Number(input.max));
  return input.valueAsNumber;
}

/** Format a share as percent. One below the whole never reads 100. */
export function almost(share) {
  const texts = [2, 3, 4, 5].map((digits) => (100 * share).toFixed(digits));
  return share < 1 ? (texts.find((text) => Number(text) < 100) ?? "99.99999") : texts[0].replace(".00", "");
}

/** Return the value below which a share of some numbers lies. */
export const percentile = (values, share) => values.toSorted()[Math.floor(share * (values.length - 1))];

/** Tie a toggle button to a value of the store. */
export function toggle(button, store, key) {
  const show = () => button.setAttribute("aria-pressed", String(store[key]));
  button.addEventListener("click", () => store.set({ [key]: !store[key] }));
  store.on([key], show);
  show();
}

/** Set width and height in device pixels, so that small pictures are sharp. */
export function sharp(canvas, size) {
  canvas.width = canvas.height = size * Math.min(devicePixelRatio, 2);
  return canvas;
}
