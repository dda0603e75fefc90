/**
 * The pins of pulls as buttons over the shape: dragging one pulls further, pressing one removes it. A line
 * joins each pin to its vertex, and a ring marks the vertex under the pointer.
 */

import { element, find } from "../dom.js";
import { isStill, vertexOf } from "./pull.js";

export class Pins {
  #buttons = [];

  /** @param {import("../store.js").Page} store */
  constructor(store, viewer, pull, { layer, threads, hover, clear }) {
    this.store = store;
    this.viewer = viewer;
    this.pull = pull;
    this.layer = layer;
    this.threads = threads;
    this.hover = hover;
    this.clear = clear;
    store.on(["pins", "solving"], () => this.#show());
    store.on(["hover"], () => this.#place());
    viewer.canvas.addEventListener("drawn", () => this.#place());
    clear.addEventListener("click", () => {
      store.set({ pins: [] });
      find("#pull").focus();
    });
  }

  #show() {
    const { pins, solving } = this.store;
    this.clear.hidden = pins.length === 0;
    while (this.#buttons.length > pins.length) this.#buttons.pop().remove();
    while (this.#buttons.length < pins.length) this.#add(this.#buttons.length);
    this.#buttons.forEach((button, i) => button.classList.toggle("busy", pins[i].vertex === solving));
    const line = () => document.createElementNS("http://www.w3.org/2000/svg", "line");
    this.threads.replaceChildren(...pins.map(line));
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
      // Without detail, a key caused the click.
      const moved = event.detail > 0 && from && !isStill(from, event);
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
    const { pins, hover, shape, references } = this.store;
    const { picker } = this.viewer;
    this.#buttons.forEach((button, i) => {
      const { x, y } = picker.project(pins[i].position);
      button.style.translate = `${x}px ${y}px`;
      const line = this.threads.children[i];
      const vertex = shape && vertexOf(pins[i], shape.mesh, references);
      const end = shape ? picker.project(picker.at(vertex)) : { x, y };
      for (const [name, value] of Object.entries({ x1: x, y1: y, x2: end.x, y2: end.y }))
        line.setAttribute(name, String(value));
    });
    this.hover.hidden = hover === null || !shape;
    if (this.hover.hidden) return;
    const { x, y } = picker.project(picker.at(hover));
    this.hover.style.translate = `${x}px ${y}px`;
  }
}
