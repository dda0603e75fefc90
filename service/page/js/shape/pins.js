/** The pins of pulls as buttons over the shape: dragging one pulls further, pressing one removes it. */

import { element, find } from "../dom.js";

const STILL = 4; // pixels that the pointer may move during a press

export class Pins {
  #buttons = [];

  /** @param {import("../store.js").Page} store */
  constructor(store, viewer, pull, { layer, clear }) {
    this.store = store;
    this.viewer = viewer;
    this.pull = pull;
    this.layer = layer;
    this.clear = clear;
    store.on(["pins"], () => this.#show());
    viewer.canvas.addEventListener("drawn", () => this.#place());
    clear.addEventListener("click", () => {
      store.set({ pins: [] });
      find("#pull").focus();
    });
  }

  #show() {
    const { pins } = this.store;
    this.clear.hidden = pins.length === 0;
    while (this.#buttons.length > pins.length) this.#buttons.pop().remove();
    while (this.#buttons.length < pins.length) this.#add(this.#buttons.length);
    this.viewer.draw();
  }

  #add(i) {
    const button = element("button", {
      type: "button",
      className: "pin",
      title: "Drag to pull on, press to remove",
    });
    button.setAttribute("aria-label", `Remove pin ${i + 1}`);
    let from = null;
    button.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      from = event;
      button.setPointerCapture(event.pointerId);
      this.pull.take(this.store.pins[i], event);
    });
    button.addEventListener("click", (event) => {
      const { detail, clientX, clientY } = event; // without detail, a key caused the click
      const moved = detail > 0 && from && Math.hypot(clientX - from.clientX, clientY - from.clientY) > STILL;
      if (!moved) this.#remove(i);
    });
    button.addEventListener("keydown", ({ key }) => {
      if (["Delete", "Backspace"].includes(key)) this.#remove(i);
    });
    this.#buttons.push(button);
    this.layer.append(button);
  }

  #remove(i) {
    this.store.set({ pins: this.store.pins.filter((_, k) => k !== i) });
    (this.#buttons[Math.min(i, this.#buttons.length - 1)] ?? this.viewer.canvas).focus();
  }

  #place() {
    this.#buttons.forEach((button, i) => {
      const { x, y } = this.viewer.project(this.store.pins[i].position);
      button.style.translate = `${x}px ${y}px`;
    });
  }
}
