/** Keyframes, the path through them, and its player. */

import * as api from "../server/api.js";
import { clone, find, readable, sharp } from "../dom.js";
import { report, reporting } from "../messages.js";
import { eased, showAt } from "./reel.js";
import { meshOf } from "../server/shape-loop.js";

const PICTURE = 64;
const SEGMENT = 24; // frames
const LONGEST = 120; // frames
const MOST_VERTICES = 2 ** 21; // of all frames: where they would be more, the coarse mesh plays
const PACE = 1.8; // seconds for a segment, where nobody says how long the path takes

export class Path {
  #frames = null; // of the path as it is now
  #coming = null; // the promise of these frames
  #loading = null;
  #t = 0;
  #clock = 0;
  #carried = null; // index of the keyframe that is dragged

  /** @param {import("../store.js").Page} store */
  constructor(store, pictures, { list, add, play, loop, beyond, seconds, easing, timeline, time, status }) {
    this.store = store;
    this.pictures = pictures;
    this.list = list;
    this.play = play;
    this.beyond = beyond;
    this.timeline = timeline;
    this.time = time;
    this.status = status;
    const tell = () => {
      seconds.value = store.keyframes.length > 1 ? readable(this.seconds) : "";
    };
    store.on(["seconds", "keyframes", "loop", "beyond", "model"], tell);
    seconds.addEventListener("change", () => {
      const said = seconds.validity.valid && seconds.value !== "";
      store.set({ seconds: said ? seconds.valueAsNumber : null });
      tell();
    });
    easing.addEventListener("change", () => store.set({ easing: easing.value }));
    store.on(["easing"], () => {
      easing.value = store.easing;
    });
    store.on(["keyframes", "loop", "beyond", "model", "fine", "hasFine"], () => this.#changed());
    store.on(["keyframes", "model"], () => this.#list());
    store.on(["playing"], () => this.#showPlaying());
    add.addEventListener("click", () => store.set({ keyframes: [...store.keyframes, store.code] }));
    play.addEventListener(
      "click",
      reporting(() => (store.playing ? this.pause() : this.#play())),
    );
    loop.addEventListener("change", () => store.set({ loop: loop.checked }));
    store.on(["loop"], () => {
      loop.checked = store.loop;
    });
    beyond.addEventListener("change", () => store.set({ beyond: Number(beyond.value) }));
    timeline.addEventListener(
      "input",
      reporting(() => this.#scrub(Number(timeline.value))),
    );
    timeline.addEventListener("change", () => this.pause());
  }

  /** What the server is asked for; the same for the file to keep. */
  get request() {
    const { keyframes, loop } = this.store;
    const [start, stop] = this.#ends;
    const frames = Math.min(Math.ceil(SEGMENT * this.#segments * (stop - start)) + 1, LONGEST);
    return { keyframes, frames, start, stop, loop };
  }

  /** How long it takes from its start to its end. */
  get seconds() {
    const [start, stop] = this.#ends;
    return this.store.seconds ?? PACE * this.#segments * (stop - start);
  }

  /** How many of its frames the player shows in a second. */
  get fps() {
    return (this.request.frames - 1) / this.seconds;
  }

  get #segments() {
    return this.store.keyframes.length - (this.store.loop ? 0 : 1);
  }

  get #ends() {
    const { beyond, loop } = this.store;
    return loop ? [0, 1] : [-beyond, 1 + beyond];
  }

  #changed() {
    if (this.store.playing) this.pause();
    this.#frames = null;
    this.#loading?.abort();
    this.#loading = this.#coming = null;
    const { keyframes, loop } = this.store;
    const ready = keyframes.length > 1;
    const [start, stop] = this.#ends;
    const percent = (t) => `${(100 * (t - start)) / (stop - start)}%`;
    Object.assign(this.timeline, { min: start, max: stop, disabled: !ready });
    this.timeline.style.setProperty("--low", percent(0));
    this.timeline.style.setProperty("--high", percent(1));
    this.#t = Math.min(Math.max(this.#t, start), stop);
    this.timeline.value = this.#t;
    this.play.disabled = !ready;
    this.beyond.disabled = loop;
    this.beyond.value = this.store.beyond;
    this.status.textContent = ready ? "" : "Add two or more keyframes: each takes the shape as it is.";
    this.#tell();
  }

  #list() {
    const { keyframes, model } = this.store;
    this.list.replaceChildren(
      ...keyframes.map((code, i) => {
        const item = clone("keyframe");
        const name = `keyframe ${i + 1}`;
        find(".number", item).textContent = i + 1;
        const go = find("[data-do=go]", item);
        go.setAttribute("aria-label", `Go to ${name}`);
        go.addEventListener("click", () => this.store.set({ code: [...code] }));
        const replace = find("[data-do=replace]", item);
        replace.setAttribute("aria-label", `Take the shape as it is for ${name}`);
        replace.addEventListener("click", () =>
          this.store.set({ keyframes: keyframes.with(i, this.store.code) }),
        );
        const remove = find("[data-do=remove]", item);
        remove.setAttribute("aria-label", `Remove ${name}`);
        remove.addEventListener("click", () => this.store.set({ keyframes: keyframes.toSpliced(i, 1) }));
        sharp(find("canvas", item), PICTURE);
        this.#carry(item, i);
        return item;
      }),
    );
    if (keyframes.length === 0) return;
    api
      .shapes(model, keyframes, "coarse")
      .then(({ shapes }) => {
        if (this.store.keyframes !== keyframes) return;
        this.list.querySelectorAll("canvas").forEach((canvas, i) => this.pictures.draw(canvas, shapes[i]));
      })
      .catch(report);
  }

  /** Have an item of the list go to another place, by hand and by keys. */
  #carry(item, i) {
    item.draggable = true;
    item.addEventListener("dragstart", ({ dataTransfer }) => {
      this.#carried = i;
      dataTransfer.setData("text/plain", `keyframe ${i + 1}`); // or some browsers drag nothing
    });
    item.addEventListener("dragend", () => {
      this.#carried = null;
    });
    item.addEventListener("dragover", (event) => {
      if (this.#carried !== null) event.preventDefault();
    });
    item.addEventListener("drop", () => {
      if (this.#carried !== null) this.#move(this.#carried, i);
    });
    item.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!event.altKey || !by) return;
      event.preventDefault(); // which would leave the page
      this.#move(i, i + by);
    });
  }

  #move(from, to) {
    const { against, keyframes } = this.store;
    if (!keyframes[to] || from === to) return;
    const order = [...keyframes.keys()].toSpliced(from, 1).toSpliced(to, 0, from);
    this.store.set({
      keyframes: order.map((i) => keyframes[i]),
      against: against < 0 ? against : order.indexOf(against),
    });
    find(`li:nth-child(${to + 1}) [data-do=go]`, this.list).focus();
  }

  #load() {
    this.#coming ??= this.#fetch();
    return this.#coming;
  }

  async #fetch() {
    const { request } = this;
    const loading = new AbortController();
    this.#loading = loading;
    this.status.textContent = `Computing ${request.frames} frames …`;
    try {
      const { model, references } = this.store;
      let mesh = meshOf(this.store);
      if (request.frames * references[mesh].vertices.length > 3 * MOST_VERTICES) mesh = "coarse";
      const frames = await api.frames(model, { ...request, mesh }, loading.signal);
      loading.signal.throwIfAborted();
      this.#frames = frames;
    } catch (error) {
      if (this.#loading === loading) this.#coming = null;
      throw error;
    } finally {
      if (this.#loading === loading) this.status.textContent = "";
    }
  }

  /**
   * The path for a video: how long it takes, and what shows the shape at a share of it until somebody else
   * plays.
   */
  async film() {
    this.pause();
    await this.#load();
    const [start, stop] = this.#ends;
    this.store.set({ playing: true });
    const show = (share) => {
      if (!this.store.playing) return false;
      this.#t = start + share * (stop - start);
      this.#show();
      return true;
    };
    return { seconds: this.seconds, show };
  }

  async #play() {
    await this.#load();
    if (this.store.playing) return; // another click waited for the same frames
    const [start, stop] = this.#ends;
    if (this.#t >= stop - 1e-6) this.#t = start;
    this.store.set({ playing: true });
    let before = performance.now();
    const step = (now) => {
      if (!this.store.playing) return;
      this.#t += (Math.max(now - before, 0) / (1000 * this.seconds)) * (stop - start);
      before = now;
      if (this.#t > stop && this.store.loop) this.#t = start + ((this.#t - start) % (stop - start));
      this.#t = Math.min(this.#t, stop);
      this.#show();
      if (this.#t >= stop) this.pause();
      else this.#clock = requestAnimationFrame(step);
    };
    this.#clock = requestAnimationFrame(step);
  }

  /** Rest at the nearest frame: the sliders take its code. */
  pause() {
    cancelAnimationFrame(this.#clock);
    if (!this.store.playing) return;
    this.store.set({ playing: false, code: [...this.store.code] });
  }

  async #scrub(t) {
    cancelAnimationFrame(this.#clock);
    this.#t = t;
    this.#tell();
    if (!this.#frames && this.#coming) return;
    await this.#load();
    this.store.set({ playing: true });
    this.#show();
    if (document.activeElement !== this.timeline || !this.timeline.matches(":active")) this.pause();
  }

  /** The shape at the time it is. */
  #show() {
    const [start, stop] = this.#ends;
    const t = this.store.easing === "soft" ? this.#slowed(this.#t) : this.#t;
    showAt(this.store, this.#frames, (t - start) / (stop - start), this.store.loop);
    this.timeline.value = this.#t;
    this.#tell();
  }

  /** A time of the path at which the shape comes to each keyframe slowly, and leaves it slowly. */
  #slowed(t) {
    const along = t * this.#segments;
    const keyframe = Math.floor(along);
    return (keyframe + eased(along - keyframe)) / this.#segments;
  }

  #tell() {
    this.time.textContent = `t = ${this.#t.toFixed(2)}`.replace("-", "−");
    this.timeline.setAttribute("aria-valuetext", this.time.textContent);
  }

  #showPlaying() {
    find("span", this.play).textContent = this.store.playing ? "Pause" : "Play";
    this.play.classList.toggle("playing", this.store.playing);
  }
}
