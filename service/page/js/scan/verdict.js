/**
 * The box with the result for a file and the possible actions; it also shows progress.
 */

import { gradient } from "../view/colours.js";
import { element, find } from "../dom.js";

export class Verdict {
  #timer = 0;

  /** `leave` is called when the box is closed by hand. */
  constructor(box, leave) {
    this.box = box;
    find(".scale", box).style.backgroundImage = gradient;
    find("[data-do=close]", box).addEventListener("click", () => {
      this.close();
      leave();
    });
  }

  close() {
    clearInterval(this.#timer);
    this.box.hidden = true;
  }

  /** Show the share of the work that is done. */
  progress(share) {
    find("progress", this.box).value = share;
  }

  /** Say that something is under way, with a button to cancel. */
  await(title, cancel) {
    this.say({ how: "busy", title, words: [], more: [] }, [["Cancel", cancel]]);
    const began = performance.now();
    const tell = () => {
      find("output", this.box).textContent = `${Math.round((performance.now() - began) / 1000)} s`;
    };
    tell();
    this.#timer = setInterval(tell, 1000);
  }

  /** Show a verdict, with actions as pairs of a label and a function. */
  say({ how, title, words, more }, actions) {
    clearInterval(this.#timer);
    this.box.hidden = false;
    this.box.className = how;
    find(".waiting", this.box).hidden = how !== "busy";
    find("progress", this.box).removeAttribute("value"); // unknown
    find("h2", this.box).textContent = title;
    find(".words", this.box).replaceChildren(...words.map((textContent) => element("p", { textContent })));
    find("details", this.box).hidden = more.length === 0;
    find("details div", this.box).replaceChildren(
      ...more.map((textContent) => element("p", { textContent })),
    );
    this.offer(actions);
    this.scale(null);
  }

  offer(actions) {
    const buttons = actions.map(([textContent, onclick]) =>
      element("button", { type: "button", textContent, onclick }),
    );
    find(".actions", this.box).replaceChildren(...buttons);
  }

  /** Show the meaning of the scan's colours; null hides it. */
  scale(end) {
    find(".distances", this.box).hidden = end === null;
    find(".distances .high", this.box).textContent = end ?? "";
  }
}
