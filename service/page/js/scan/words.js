/** Describes the answers of `encode` and `fit` in words. */

import { readable } from "../dom.js";

const percent = (share) => `${readable(100 * share, 2)} %`;

/** Largest mean distances, as shares of the diagonal, for each verdict on a mesh in correspondence. */
const GOOD = 0.01;
const FAIR = 0.03;

/**
 * @typedef {object} Verdict
 * @property {"good" | "fair" | "poor"} how
 * @property {string} title
 * @property {string[]} words the main sentences
 * @property {string[]} more details
 */

/**
 * Describe a mesh in correspondence.
 * @param {{residual: number, vertex_error: {mean: number, max: number}, status: string,
 *   reason: string}} answer of `encode`
 * @param {{file: string, model: string, diagonal: number}} about names of the file and the model, and
 *   the model's diagonal
 * @returns {Verdict}
 */
export function encodeInWords({ residual, vertex_error: error, status, reason }, { file, model, diagonal }) {
  const off = error.mean / diagonal;
  const how = status === "poor" || off >= FAIR ? "poor" : off < GOOD ? "good" : "fair";
  const title = {
    good: `This is the code of ${file}`,
    fair: `This is the code that comes closest to ${file}`,
    poor: `${file} is no such shape`,
  }[how];
  return {
    how,
    title,
    words: [
      `Its vertices are off by ${percent(off)} of the diagonal on average (${readable(error.mean)} units),` +
        ` by ${percent(error.max / diagonal)} at most.`,
      ...(status === "poor" ? [reason] : []),
      ...(how === "poor"
        ? [`${model} has nothing nearer that matches vertex by vertex. Your shape was left as it was.`]
        : []),
    ],
    more: [`Lengths and angles are off by ${percent(residual)}.`],
  };
}

/**
 * Describe a scan without correspondence.
 * @param {object} answer of `fit`
 * @param {{file: string, model: string, diagonal: number}} about names of the file and the model, and
 *   the model's diagonal
 * @returns {Verdict}
 */
export function fitInWords(answer, { file, model, diagonal }) {
  const {
    status,
    distances: { scan, model: back },
    explained,
    seen,
    placement,
    mirrored,
    noise,
  } = answer;
  const size = diagonal * placement.scale; // in the scan's units, like the distances
  const titles = {
    converged: ["good", `${model} explains ${file}`],
    ambiguous: ["fair", `${file} fits, but another shape fits nearly as well`],
    stalled: ["fair", `${file} fits, though the search had not quite come to rest`],
    poor: ["poor", `${file} is no such shape, or the search went astray`],
    deadline: ["fair", `The time was over: this is the best fit to ${file} so far`],
  };
  const [how, title] = titles[status] ?? ["fair", `The fit of ${file} ended as “${status}”`];
  const words = [
    `Its points lie ${percent(scan.mean / size)} of the diagonal (${readable(scan.mean)} units) from the ` +
      `shape on average, 95 % of them within ${percent(scan.p95 / size)}.`,
    `${percent(explained)} of the scan lie at the shape; the scan covers ${percent(seen)} of the shape.`,
  ];
  if (status === "ambiguous") words.push(`The server says: ${sentence(answer.reason)}`);
  if (typeof mirrored === "number" && mirrored < 0.5) {
    words.push("Its mirror image fits much better: the sign of one coordinate may be wrong.");
  }
  if (how === "poor") words.push("Your shape was left as it was.");
  return { how, title, words, more: [place(placement), ...rest(back, size, noise)] };
}

const rest = (back, size, noise) => [
  `The shape's vertices lie ${percent(back.mean / size)} of the diagonal from the scan on average.`,
  `The scan's noise is about ${readable(noise, 2)} units.`,
];

/** Return the first sentence of a reason; the others are for programs. */
const sentence = (reason) => `${reason.split(/\.\s/)[0].replace(/\.$/, "")}.`;

function place({ rotation: [[a], [, b], [, , c]], translation, scale }) {
  const angle = (180 / Math.PI) * Math.acos(Math.min(Math.max((a + b + c - 1) / 2, -1), 1));
  const to = translation.map((value) => readable(value).replace("-", "−")).join(", ");
  const times =
    Math.abs(scale - 1) < 1e-6 ? "in the model's units" : `${readable(scale)} times the model's size`;
  return `In the file it is turned by ${angle.toFixed(0)}°, moved by (${to}), ${times}.`;
}
