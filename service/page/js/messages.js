/** Messages to the user: visible in the page and announced by screen readers, never only in the console. */

const box = document.querySelector("#messages");

/**
 * Show a message. One with a `key` replaces the last message with this key, and stays until it is removed.
 * @param {string} text
 * @param {{kind?: "note" | "error", key?: string}} [how]
 */
export function say(text, { kind = "note", key } = {}) {
  takeBack(key);
  // What is said again is not there twice.
  for (const old of [...box.children]) if (old.firstChild.textContent === text) old.remove();
  const line = document.createElement("div");
  line.className = `message ${kind}`;
  line.dataset.key = key ?? "";
  const close = Object.assign(document.createElement("button"), { type: "button", textContent: "×" });
  close.setAttribute("aria-label", "Close this message");
  close.addEventListener("click", () => line.remove());
  line.append(Object.assign(document.createElement("p"), { textContent: text }), close);
  box.append(line);
  /** @type {NodeListOf<HTMLElement>} */
  const shown = box.querySelectorAll(":scope > :not([hidden])");
  for (const old of [...shown].slice(0, -3)) old.hidden = true;
  // A log keeps past messages invisibly.
  if (kind === "note")
    setTimeout(() => {
      line.hidden = true;
    }, 6000);
  while (box.children.length > 30) box.firstChild.remove();
}

export function takeBack(key) {
  if (key) box.querySelectorAll(`[data-key="${key}"]`).forEach((line) => line.remove());
}

/** Show an error, unless the request was only superseded. */
export function report(error) {
  if (error.name === "AbortError") return;
  if (error.offline)
    say(`${error.message} Is it running? Then try again.`, { kind: "error", key: "offline" });
  else say(error.message, { kind: "error" });
}

/** Return a handler that reports its errors. */
export const reporting =
  (work) =>
  async (...parameters) => {
    try {
      await work(...parameters);
    } catch (error) {
      report(error);
    }
  };
