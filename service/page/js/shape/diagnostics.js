/** Describes the diagnostics of a shape in words. */

import { readable } from "../dom.js";

const FITS = 0.01; // residual below which no detail is shown
const HARDLY = 0.05;
const MUCH = 2; // factor of the model's usual residual
const TOO_MUCH = 5;

/** @typedef {["good" | "fair" | "poor", string, string]} News */

/**
 * Describe diagnostics: for each a level, a word, and a sentence.
 * @param {object} diagnostics
 * @param {number | null} usual the model's median residual at codes inside the bounds; null while it is
 *   unknown
 * @returns {News[]}
 */
export function inWords(diagnostics, usual) {
  const { status, residual, inside_bounds: inside, flipped_faces: flipped, plausibility } = diagnostics;
  if (residual === undefined) return [];
  const words = [fits(residual, usual ?? HARDLY)];
  words.push(
    inside
      ? ["good", "inside", "Inside the range of the training data."]
      : ["fair", "outside", "Outside the range of the training data: extrapolated."],
  );
  if (typeof plausibility === "number") words.push(plausible(plausibility));
  if (flipped > 0)
    words.push(["poor", "folded", `${flipped} ${flipped === 1 ? "face is" : "faces are"} folded over.`]);
  if (status && status !== "converged") {
    words.push(["poor", "unfinished", `The solver did not finish (${status.replace("_", " ")}).`]);
  }
  return words;
}

/** Return the worst level, and one line: the faults if there are any. */
export function inShort(words) {
  const how = ["poor", "fair"].find((each) => words.some(([is]) => is === each)) ?? "good";
  if (how === "good") return { how, line: "Looks right" };
  const line = words
    .filter(([is]) => is !== "good")
    .map(([, word]) => word)
    .join(", ");
  return { how, line: line.charAt(0).toUpperCase() + line.slice(1) };
}

/**
 * Describe the residual. A residual that is usual for the model is no fault of the shape.
 * @returns {News}
 */
function fits(residual, usual) {
  const off = `Lengths and angles are off by ${percent(residual)}`;
  if (residual < Math.max(FITS, MUCH * usual)) {
    const all = residual < FITS ? "" : ", as is usual for this model";
    return ["good", "fits", `Fits its lengths and angles to ${percent(residual)}${all}.`];
  }
  if (residual < Math.max(HARDLY, TOO_MUCH * usual)) return ["fair", "fits less well", `${off}.`];
  return ["poor", "hardly exists", `${off}: this shape hardly exists.`];
}

/**
 * Describe the distance to the nearest training shape, in multiples of the training shapes' typical distance.
 * @returns {News}
 */
function plausible(distance) {
  if (distance < 1.05) return ["good", "usual", "As near to the training shapes as these are to each other."];
  const times = `${readable(distance, 2)} times as far from the training shapes as these lie apart`;
  return distance <= 2
    ? ["fair", "unusual", `Unusual: ${times}.`]
    : ["poor", "implausible", `Hardly plausible: ${times}.`];
}

const percent = (share) => `${readable(100 * share, 2)} %`;
