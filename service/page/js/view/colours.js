/** Colour scales, from numbers to linear sRGB. */

import * as THREE from "three";
import { BASE } from "./scene.js";

/** Moreland's colour map "coolwarm", as in the server's coloured files. */
const DIVERGING = [
  "#3b4cc0",
  "#6282ea",
  "#8db0fe",
  "#b9d0f9",
  "#dddcdc",
  "#f5c4ac",
  "#f4987a",
  "#dd5f4b",
  "#b40426",
];
const stops = DIVERGING.map((colour) => new THREE.Color(colour));
const accent = new THREE.Color("#1f7fc4");
export const gradient = `linear-gradient(to right, ${DIVERGING.join(", ")})`;

/** Return colours (3V) of values (V), from blue at −limit to red at limit. */
export function diverging(values, limit) {
  const colours = new Float32Array(3 * values.length);
  const colour = new THREE.Color();
  values.forEach((value, i) => {
    const at = Math.min(Math.max((value / limit + 1) / 2, 0), 1) * (stops.length - 1);
    const left = Math.min(Math.floor(at), stops.length - 2);
    colour.lerpColors(stops[left], stops[left + 1], at - left).toArray(colours, 3 * i);
  });
  return colours;
}

/** Return colours (3V) of distances (V), from blue at 0 to red at limit. */
export const distant = (distances, limit) =>
  diverging(
    distances.map((distance) => 2 * distance - limit),
    limit,
  );

/** Return colours (3V) of weights (V), from the surface's own colour at 0 to the accent at 1. */
export function tint(weights, base = BASE) {
  const colours = new Float32Array(3 * weights.length);
  const colour = new THREE.Color();
  weights.forEach((weight, i) => colour.lerpColors(base, accent, weight).toArray(colours, 3 * i));
  return colours;
}
