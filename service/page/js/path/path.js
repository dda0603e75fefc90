/** Keyframes, the path through them, and its player. */

import * as api from "../server/api.js";
import { clone, find, readable, sharp } from "../dom.js";
import { report, reporting } from "../messages.js";
import { eased, Reel } from "./reel.js";
import { meshOf } from "../server/shape-loop.js";

const PICTURE = 64;
const SEGMENT = 24; // frames between two keyframes
const LONGEST = 120; // most frames of a path
const MOST_VERTICES = 2 ** 21; // of all frames together; above, the player shows the coarse mesh
const MOST_NUMBERS = 2400; // of all keyframes in an address
const PACE = 1.8; // seconds for a segment, unless the user sets the length of the path

export class Path {
  /** @type {Reel | null} frames of the path as it is now */
  #reel = null;
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
      seconds.disabled = store.keyframes.length < 2;
      seconds.value = seconds.disabled ? "" : readable(this.seconds);
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
    store.on(["model"], () => {
      this.#t = 0;
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

  /**
   * Return the request for a file that moves as the player does. The server moves evenly between keyframes.
   * If the player does not, each frame becomes a keyframe, up to the limit of an address.
   */
  get request() {
    const { easing, keyframes, loop, model } = this.store;
    const frames = this.#frames;
    const [start, stop] = this.#ends;
    if (easing === "even") return { keyframes, frames, start, stop, loop };
    const held = Math.floor(MOST_NUMBERS / model.latent_dimension);
    const knots = Math.min(frames, Math.max(held, 4 * this.#segments + 1));
    const times = this.#times(knots).map((t) => this.#slowed(t));
    const codes = this.#codes(times).map((code) => code.map((value) => Number(value.toPrecision(5))));
    return { keyframes: codes, frames, loop };
  }

  /** Number of frames. */
  get #frames() {
    const [start, stop] = this.#ends;
    return Math.min(Math.ceil(SEGMENT * this.#segments * (stop - start)) + 1, LONGEST);
  }

  /** Seconds from start to end. */
  get seconds() {
    const [start, stop] = this.#ends;
    return this.store.seconds ?? PACE * this.#segments * (stop - start);
  }

  /** Frames per second of the player. */
  get fps() {
    return (this.#frames - 1) / this.seconds;
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
    this.#forget();
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
    this.status.textContent = ready ? "" : "Add two or more shapes to make a path.";
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

  /** Let the user move an item of the list, by dragging and by keys. */
  #carry(item, i) {
    item.draggable = true;
    item.addEventListener("dragstart", ({ dataTransfer }) => {
      this.#carried = i;
      dataTransfer.setData("text/plain", `keyframe ${i + 1}`); // some browsers drag nothing without data
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
      event.preventDefault(); // the browser would leave the page
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

  /** Return the times of all frames, in segments. A loop omits its end, which equals its start. */
  #times(frames) {
    const [start, stop] = this.#ends;
    const length = frames - Number(this.store.loop);
    return Array.from({ length }, (_, k) => start + (k * (stop - start)) / (frames - 1));
  }

  /** Return the codes at times of the path. */
  #codes(times) {
    const { keyframes, loop, space } = this.store;
    const closed = loop ? [...keyframes, keyframes[0]] : keyframes;
    return space.along(
      closed,
      times.map((t) => t * this.#segments),
    );
  }

  #ask() {
    const { store } = this;
    const frames = this.#frames;
    const codes = this.#codes(this.#times(frames));
    const wanted = meshOf(store);
    const large = codes.length * store.references[wanted].vertices.length > 3 * MOST_VERTICES;
    const mesh = large ? "coarse" : wanted;
    const tell = (there) => {
      const { length } = codes;
      this.status.textContent = there < length ? `Computing frames: ${there} of ${length} …` : "";
    };
    tell(0);
    return new Reel(store, codes, mesh, { loop: store.loop, tell });
  }

  /** Return the frames of the path, once all frames up to a share of it are loaded. */
  async #load(share) {
    this.#reel ??= this.#ask();
    const reel = this.#reel;
    try {
      await reel.reach(share);
    } catch (error) {
      if (this.#reel === reel) this.#forget();
      throw error;
    }
    return reel;
  }

  #forget() {
    this.#reel?.stop();
    this.#reel = null;
    this.status.textContent = "";
  }

  /**
   * Return the path for a video: its length, and a function that shows the shape at a share of it until the
   * user plays again.
   */
  async film() {
    this.pause();
    await this.#load(1);
    const [start, stop] = this.#ends;
    this.store.set({ playing: true });
    const show = (share) => {
      if (!this.store.playing) return false;
      this.#show(start + share * (stop - start));
      return true;
    };
    return { seconds: this.seconds, show };
  }

  /** Play the loaded frames, and further frames as they arrive. */
  async #play() {
    const [start, stop] = this.#ends;
    const reel = await this.#load(0);
    if (this.store.playing) return; // an earlier click waited for the same frames
    this.store.set({ playing: true });
    let before = performance.now();
    const step = (now) => {
      if (!this.store.playing) return;
      let t = this.#t + (Math.max(now - before, 0) / (1000 * this.seconds)) * (stop - start);
      before = now;
      if (t > stop && this.store.loop) t = start + ((t - start) % (stop - start));
      t = Math.min(t, stop);
      if (reel.has(this.#share(t))) this.#show(t);
      if (this.#t >= stop) this.pause();
      else this.#clock = requestAnimationFrame(step);
    };
    if (this.#t >= stop - 1e-6) this.#t = start;
    this.#clock = requestAnimationFrame(step);
    try {
      await this.#load(1);
    } catch (error) {
      this.pause();
      throw error;
    }
  }

  /** Stop at the nearest frame, and give its code to the sliders. */
  pause() {
    cancelAnimationFrame(this.#clock);
    if (!this.store.playing) return;
    this.store.set({ playing: false, code: [...this.store.code] });
  }

  async #scrub(t) {
    cancelAnimationFrame(this.#clock);
    this.#t = t;
    this.#tell();
    await this.#load(this.#share(t));
    if (this.#t !== t) return; // the path has moved on
    this.store.set({ playing: true });
    this.#show(t);
    if (document.activeElement !== this.timeline || !this.timeline.matches(":active")) this.pause();
  }

  /** Show the shape at a time. */
  #show(t) {
    this.#t = t;
    this.#reel.show(this.#share(t));
    this.timeline.value = t;
    this.#tell();
  }

  /** Return the share of the frames at a time. */
  #share(t) {
    const [start, stop] = this.#ends;
    return ((this.store.easing === "soft" ? this.#slowed(t) : t) - start) / (stop - start);
  }

  /** Map time t of an even path to a path that is slow at its keyframes and ends. */
  #slowed(t) {
    const [start, stop] = this.#ends;
    const before = Math.floor(t * this.#segments) / this.#segments;
    let [low, high] = [before, before + 1 / this.#segments];
    if (t < 0) [low, high] = [start, 0];
    if (t > 1) [low, high] = [1, stop];
    return low + (high - low) * eased((t - low) / (high - low));
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
