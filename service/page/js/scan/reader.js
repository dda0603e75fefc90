/**
 * Reads files as shapes. A file with the model's vertices in their order is encoded. Any other is a scan,
 * and is fitted. A poor fit never replaces the user's shape, and the user can always return to that shape.
 */

import * as api from "../server/api.js";
import { find, readable } from "../dom.js";
import { report, say } from "../messages.js";
import { diagonalOf } from "../view/scene.js";
import { TEXTS } from "../server/problems.js";
import { fixedBy, sameCode } from "../server/space.js";
import { encodeInWords, fitInWords } from "./words.js";
import { Verdict } from "./verdict.js";

const POINTS_ONLY = ["xyz", "pts", "csv", "txt", "pcd"];
const UNITS = "scale=free"; // the server suggests this for a scan in other units

export class Reader {
  #abort = new AbortController();
  #found = null; // the shape of the file, and the shape before

  /** @param {import("../store.js").Page} store */
  constructor(store, { box, input, readAs, ownScale, stage }) {
    this.store = store;
    this.formats = input.accept.split(",");
    this.readAs = readAs;
    this.ownScale = ownScale;
    this.verdict = new Verdict(box, () => this.#leave());
    this.shown = find("#ghost", box);
    this.shown.addEventListener("change", () => store.set({ ghost: this.shown.checked }));
    store.on(["ghost"], () => {
      this.shown.checked = store.ghost;
    });
    store.on(["model"], () => {
      this.verdict.close();
      this.#leave();
    });
    store.on(["code"], () => this.#offer());
    input.addEventListener("change", () => {
      if (input.files[0]) this.read(input.files[0]);
      input.value = "";
    });
    addEventListener("dragover", (event) => {
      if (!event.dataTransfer.types.includes("Files")) return;
      event.preventDefault();
      stage.classList.add("dropping");
    });
    addEventListener("dragleave", (event) => {
      if (!event.relatedTarget) stage.classList.remove("dropping");
    });
    addEventListener("drop", (event) => {
      event.preventDefault();
      stage.classList.remove("dropping");
      if (event.dataTransfer.files[0]) this.read(event.dataTransfer.files[0]);
    });
  }

  /** Encode or fit a file, and show its shape. */
  async read(file) {
    const { model, locked } = this.store;
    const refuse = (why) => say(why, { kind: "error", key: "scan" });
    if (!model) {
      refuse("No model is loaded yet. Drop the file again when you see a shape.");
    } else if (locked.every(Boolean)) {
      refuse("All coordinates are locked. Unlock at least one, then choose the file again.");
    } else if (
      this.readAs.value === "auto" &&
      !this.ownScale.checked &&
      !POINTS_ONLY.includes(this.#format(file).format)
    ) {
      await this.#encode(file);
    } else await this.#fit(file, this.#asked);
  }

  /** Return a file's format by a known ending of its name; otherwise the server finds it out. */
  #format({ name }) {
    const ending = name.split(".").pop().toLowerCase();
    return this.formats.includes(`.${ending}`) ? { format: ending } : {};
  }

  get #asked() {
    return { scale: this.ownScale.checked ? "free" : "fixed", partial: this.readAs.value === "part" };
  }

  get #about() {
    const {
      model,
      references: { fine, coarse },
    } = this.store;
    return { model: model.title, diagonal: diagonalOf((fine ?? coarse).vertices) };
  }

  async #encode(file) {
    const { model, locked, code } = this.store;
    const signal = this.#begin(`Looking for the code of ${file.name} …`);
    try {
      const answer = await api.encode(model, file, this.#format(file), fixedBy(locked, code), signal);
      this.#tell(file, answer, encodeInWords(answer, { file: file.name, ...this.#about }), {});
    } catch (error) {
      // Other vertices than the model's, other units, or points alone: try it as a scan.
      if (/(invalid-mesh|unsupported-media-type)$/.test(error.type)) await this.#fit(file, this.#asked);
      else this.#fail(file, error);
    }
  }

  async #fit(file, asked) {
    const { model, locked, code } = this.store;
    const signal = this.#begin(`Fitting ${model.title} to ${file.name} …`);
    try {
      const options = { ...asked, used: true, fixed: JSON.stringify(fixedBy(locked, code)) };
      const tell = (share) => this.verdict.progress(share);
      const answer = await api.fit(model, file, this.#format(file), options, signal, tell);
      const {
        distances: {
          scan: { p95 },
        },
        placement,
      } = answer;
      const { diagonal: size } = this.#about;
      answer.limit = Math.max(p95, 1e-3 * size * placement.scale);
      this.#tell(file, answer, fitInWords(answer, { file: file.name, ...this.#about }), asked);
    } catch (error) {
      if (error.detail?.includes(UNITS)) this.#otherUnits(file, error, asked);
      else this.#fail(file, error);
    }
  }

  #begin(what) {
    this.#leave();
    this.verdict.await(what, () => {
      this.verdict.close();
      this.#leave();
    });
    return this.#abort.signal;
  }

  /** Cancel the current request, and remove the scan. */
  #leave() {
    this.#abort.abort();
    this.#abort = new AbortController();
    this.#found = null;
    this.shown.parentElement.hidden = true;
    this.store.set({ scan: null, found: null });
  }

  #fail(file, error) {
    if (error.name === "AbortError") return;
    this.verdict.close();
    const unknown = !this.#format(file).format && error.type?.endsWith("invalid-mesh");
    if (error.offline) report(error);
    else if (unknown) say(`${file.name}: ${TEXTS["unsupported-media-type"]}`, { kind: "error", key: "scan" });
    else say(`${file.name}: ${error.message}`, { kind: "error", key: "scan" });
  }

  #otherUnits(file, error, asked) {
    const [, ratio] = error.detail.match(/about ([\d.e+-]+) times/) ?? [];
    const words = ratio
      ? `It is about ${readable(Number(ratio))} times as large as the shapes of ${this.#about.model}.`
      : "Its size differs from the size of the model’s shapes.";
    this.verdict.say(
      {
        how: "fair",
        title: `${file.name} may be in other units`,
        words: [
          words,
          "Your shape stays as it was. The page can find the size of the scan together with its shape.",
        ],
        more: [],
      },
      [["Fit it with its own scale", () => this.#fit(file, { ...asked, scale: "free" })]],
    );
  }

  #tell(file, answer, words, asked) {
    const { code, placement, locked, space } = this.store;
    answer.latent = space.wrapAll(answer.latent).map((value, k) => (locked[k] ? code[k] : value));
    const scan = answer.used ? answer : null;
    const tries = [];
    const again = (label, change) =>
      tries.push([label, () => this.#fit(file, { ...this.#asked, ...asked, ...change })]);
    if (!scan) again("Fit it as a scan", {});
    if (scan && words.how === "poor" && !asked.partial)
      again("Fit it as a part of a shape", { partial: true });
    if (scan && words.how === "poor" && asked.scale !== "free")
      again("Fit it with its own scale", { scale: "free" });
    const before = { code, placement };
    this.#found = { code: answer.latent, covariance: answer.covariance, before, scan, tries };
    this.verdict.say(words, []);
    if (words.how === "poor") this.#offer();
    else this.#show();
  }

  #show() {
    const { code, covariance, scan } = this.#found;
    const { hasFine, fine } = this.store;
    // The placement of the scan is in the frame of the fine mesh.
    const finer = fine || (hasFine && Boolean(scan));
    this.store.set({
      playing: false,
      code,
      placement: null,
      scan,
      ghost: true,
      fine: finer,
      found: { code, covariance },
    });
    this.#offer();
  }

  #back() {
    this.store.set({ ...this.#found.before, ghost: false });
  }

  /** Return the actions for the shape that is shown. */
  #offer() {
    if (!this.#found || !this.store.code) return;
    const { code, before, scan, tries } = this.#found;
    const [own, mine] = [sameCode(this.store.code, code), sameCode(this.store.code, before.code)];
    this.verdict.offer([
      ...(mine ? [] : [["Back to my shape", () => this.#back()]]),
      ...(own ? [] : [["Show what was found", () => this.#show()]]),
      ...tries,
    ]);
    this.shown.parentElement.hidden = !this.store.scan;
    const far = scan && scan.limit / (this.#about.diagonal * scan.placement.scale);
    this.verdict.scale(this.store.scan && own ? `${readable(100 * far, 2)} % of the diagonal or more` : null);
  }
}
