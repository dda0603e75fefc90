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

/** By the distance to the nearest training shape, in multiples of what these have from each other. */
function plausible(distance) {
  if (distance < 1.05) return ["good", "As near to the training shapes as these are to each other."];
  const times = `${readable(distance, 2)} times as far from the training shapes as these lie apart`;
  return distance <= 2 ? ["fair", `Unusual: ${times}.`] : ["poor", `Hardly plausible: ${times}.`];
}

const percent = (share) => `${readable(100 * share, 2)} %`;
