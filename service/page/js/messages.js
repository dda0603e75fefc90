/** What the page has to say to people: in the page, read out by screen readers, never only in the console. */

const box = document.querySelector("#messages");

/**
 * Say something; a message with a `key` replaces the one before, and stays until it is taken back.
 * @param {string} text
 * @param {{kind?: "note" | "error", key?: string}} [how]
 */
export function say(text, { kind = "note", key } = {}) {
  takeBack(key);
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
  // A log keeps what it has said, out of sight.
  if (kind === "note")
    setTimeout(() => {
      line.hidden = true;
    }, 6000);
  while (box.children.length > 30) box.firstChild.remove();
}

export function takeBack(key) {
  if (key) box.querySelectorAll(`[data-key="${key}"]`).forEach((line) => line.remove());
}

/** Tell of an error; what was merely superseded is none. */
export function report(error) {
  if (error.name === "AbortError") return;
  if (error.offline)
    say(`${error.message} Is it running? Then try again.`, { kind: "error", key: "offline" });
  else say(error.message, { kind: "error" });
}

/** A handler that reports what goes wrong in it. */
export const reporting =
  (work) =>
  async (...parameters) => {
    try {
      await work(...parameters);
    } catch (error) {
      report(error);
    }
  };
