/** Describes the answers of `encode` and `fit` in words. */

import { readable } from "../dom.js";

const percent = (share) => `${readable(100 * share, 2)} %`;

/** Largest mean distances, as shares of the diagonal, for each verdict on a mesh in correspondence. */
const GOOD = 0.01;
const FAIR = 0.03;
/** Shares of the diagonal below which a movement is none. */
const SMALL = 1e-3;
/** Share of the scan on the shape below which the page doubts that the model fits. */
const MOST = 0.5;
const KEPT = "Your shape stays as it was.";

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
    good: `The shape of ${file}`,
    fair: `The closest shape to ${file}`,
    poor: `${file} is not a shape of this model`,
  }[how];
  return {
    how,
    title,
    words: [
      `Mean vertex error: ${percent(off)} of the diagonal (${readable(error.mean)} units). ` +
        `Largest: ${percent(error.max / diagonal)}.`,
      ...(status === "poor" ? [reason] : []),
      ...(how === "poor" ? [`No shape of ${model} is closer, vertex by vertex. ${KEPT}`] : []),
    ],
    more: [`Error of lengths and angles: ${percent(residual)}.`],
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
    converged: ["good", `${model} fits ${file}`],
    ambiguous: ["fair", `${model} fits ${file}, but another shape may fit as well`],
    stalled: ["fair", `${model} fits ${file}. The search stopped early`],
    poor: ["poor", `${file} is not a shape of this model, or the search failed`],
    deadline: ["fair", `The time limit is reached. This is the best fit to ${file} so far`],
  };
  const [how, title] = titles[status] ?? ["fair", `The fit to ${file} ended: ${status}`];
  const words = [
    `Mean distance of the scan from the shape: ${percent(scan.mean / size)} of the diagonal ` +
      `(${readable(scan.mean)} units). 95 % of the points are closer than ${percent(scan.p95 / size)}.`,
    `${percent(explained)} of the scan lies on the shape. The scan covers ${percent(seen)} of the shape.`,
  ];
  if (status === "deadline")
    words.push(
      explained < MOST
        ? "Most of the scan lies off the shape. Perhaps it is no shape of this model."
        : "For a better fit, use fewer points: a few thousand are enough.",
    );
  if (status === "ambiguous") words.push(`${sentence(answer.reason)} If you can, scan more sides.`);
  if (typeof mirrored === "number" && mirrored < 0.5) {
    words.push("The mirror image fits much better. Perhaps one axis of the file has the wrong sign.");
  }
  if (how === "poor") words.push(KEPT);
  return { how, title, words, more: [place(placement, size), ...rest(back, size, noise)] };
}

const rest = (back, size, noise) => [
  `Mean distance of the shape from the scan: ${percent(back.mean / size)} of the diagonal.`,
  `The noise of the scan is about ${readable(noise, 2)} units.`,
];

/** Return the first sentence of a reason; the others are for programs. */
const sentence = (reason) => `${reason.split(/\.\s/)[0].replace(/\.$/, "")}.`;

function place({ rotation: [[a], [, b], [, , c]], translation, scale }, size) {
  const angle = (180 / Math.PI) * Math.acos(Math.min(Math.max((a + b + c - 1) / 2, -1), 1));
  const seen = (value) => (Math.abs(value) < SMALL * size ? 0 : value);
  const to = translation.map((value) => readable(seen(value)).replace("-", "−")).join(", ");
  const times =
    Math.abs(scale - 1) < 1e-6 ? "in the model's units" : `${readable(scale)} times the model's size`;
  return `The file has it turned by ${angle.toFixed(0)}°, moved by (${to}), ${times}.`;
}
