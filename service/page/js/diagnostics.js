/** How well a shape was found, in words. */

import { readable } from "./dom.js";

/** Sentences for what the server says of a shape, each with how good the news is. */
export function inWords(diagnostics) {
  const { status, residual, inside_bounds: inside, flipped_faces: flipped, plausibility } = diagnostics;
  if (residual === undefined) return [];
  const words = [];
  if (residual < 0.01) words.push(["good", `Fits its lengths and angles to ${percent(residual)}.`]);
  else if (residual < 0.05) words.push(["fair", `Lengths and angles are off by ${percent(residual)}.`]);
  else words.push(["poor", `Lengths and angles are off by ${percent(residual)}: this shape hardly exists.`]);
  words.push(inside
    ? ["good", "Inside the range of the training data."]
    : ["fair", "Outside the range of the training data: extrapolated."]);
  if (typeof plausibility === "number") words.push(plausible(plausibility));
  if (flipped > 0) words.push(["poor", `${flipped} ${flipped === 1 ? "face is" : "faces are"} folded over.`]);
  if (status && status !== "converged") words.push(["poor", `The solver did not finish (${status.replace("_", " ")}).`]);
  return words;
}

function plausible(distance) {
  if (distance < 1) return ["good", "As plausible as the training shapes."];
  if (distance < 2) return ["fair", `Rarer than the training shapes (${readable(distance, 2)} times their distance).`];
  return ["poor", `Far from every training shape (${readable(distance, 2)} times their distance).`];
}

const percent = (share) => `${readable(100 * share, 2)} %`;
