/** Names the motion of each coordinate, such as "back" and "forward", by the shapes at its two ends. */

import { Matrix3, Vector3 } from "three";
import { always } from "../memory.js";

/** @typedef {[string, string] | null} Motion what the lower and the upper end are called */

const SURE = 0.4; // least share of the displacement that a motion must explain
const MOVED = 0.5; // share of the largest displacement from which a vertex counts as moved
const ROUNDS = 12; // of the search for the part that rests
const NEAR = 0.01; // distance that counts as rest, in diameters
const ASIDE = 0.14; // distance of a part from the middle, in widths, from which it moves in and out

const place = ({ name, version }) => `motions:${name}:${version}`;

/** Return the motions that this browser has computed before; null if there are none. */
export function keptMotions(model) {
  try {
    const kept = JSON.parse(always.kept(place(model)));
    return Array.isArray(kept) && kept.length === model.latent_dimension ? kept : null;
  } catch {
    return null;
  }
}

export const keepMotions = (model, motions) => always.keep(place(model), JSON.stringify(motions));

/**
 * Name the coordinates of factors.
 * @param {{name: string, start: number, stop: number}[]} factors
 * @param {ReturnType<typeof measure>[]} seen by coordinate
 * @returns {Motion[]}
 */
export function motionsOf(factors, seen) {
  const aside = seen.map((each) => each.aside);
  // A body's own sides, as its factors are named; otherwise sides of the picture.
  const left = factors.find(({ name, start }) => /\bleft\b/i.test(name) && Math.abs(aside[start]) > ASIDE);
  /** @type {[string, string]} */
  const sides = (left ? aside[left.start] : -1) > 0 ? ["right", "left"] : ["left", "right"];
  const motions = seen.map(() => null);
  for (const { start, stop } of factors) {
    // The clearest motion first; within a factor each motion occurs once.
    const taken = new Set();
    const choices = seen
      .slice(start, stop)
      .flatMap(({ scores }, i) =>
        Object.entries(scores).map(([kind, score]) => ({ k: start + i, kind, score })),
      );
    for (const { k, kind, score } of choices.toSorted((a, b) => Math.abs(b.score) - Math.abs(a.score))) {
      if (motions[k] || taken.has(kind) || Math.abs(score) < SURE) continue;
      taken.add(kind);
      const words = wordsFor(kind, sides, aside[k]);
      motions[k] = score > 0 ? words : [words[1], words[0]];
    }
  }
  return motions;
}

/**
 * Return what the lower and the upper end of a motion along its axis are called.
 * @returns {[string, string]}
 */
function wordsFor(kind, [minus, plus], aside) {
  if (kind === "move x" && Math.abs(aside) > ASIDE) return aside > 0 ? ["in", "out"] : ["out", "in"];
  /** @type {Record<string, [string, string]>} */
  const words = {
    "move x": [minus, plus],
    "move y": ["down", "up"],
    "move z": ["back", "forward"],
    "turn x": ["tip back", "tip forward"],
    "turn y": [`turn ${minus}`, `turn ${plus}`],
    "turn z": [`lean ${plus}`, `lean ${minus}`],
    "grow x": ["narrower", "wider"],
    "grow y": ["shorter", "taller"],
    "grow z": ["flatter", "deeper"],
    grow: ["smaller", "larger"],
  };
  return words[kind];
}

/**
 * Measure how much of the displacement of the part that moves most each kind of motion explains, and how far
 * this part lies from the middle, in widths.
 * @param {Float32Array} home positions (3V numbers) of the home shape
 * @param {Float32Array} down positions at the lower end of a coordinate
 * @param {Float32Array} up positions at its upper end
 */
export function measure(home, down, up) {
  const moves = againstRest(
    home,
    up.map((x, i) => x - down[i]),
  );
  const lengths = Float32Array.from({ length: moves.length / 3 }, (_, v) =>
    Math.hypot(moves[3 * v], moves[3 * v + 1], moves[3 * v + 2]),
  );
  const least = MOVED * lengths.reduce((a, b) => Math.max(a, b), 1e-9);
  const part = [...lengths.keys()].filter((v) => lengths[v] >= least);
  const mean = (value) => part.reduce((sum, v) => sum + value(v), 0) / (part.length || 1);
  const center = [0, 1, 2].map((axis) => mean((v) => home[3 * v + axis]));
  const around = (v) => center.map((middle, axis) => home[3 * v + axis] - middle);
  const move = (v) => [...moves.subarray(3 * v, 3 * v + 3)];
  const total = mean((v) => lengths[v]) || 1;
  const arm = mean((v) => Math.hypot(...around(v)) * lengths[v]) || 1;
  const scores = {};
  const stretch = [0, 1, 2].map((axis) => mean((v) => around(v)[axis] * move(v)[axis]) / arm);
  ["x", "y", "z"].forEach((name, axis) => {
    const [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
    scores[`move ${name}`] = mean((v) => move(v)[axis]) / total;
    scores[`turn ${name}`] = mean((v) => around(v)[b] * move(v)[c] - around(v)[c] * move(v)[b]) / arm;
    scores[`grow ${name}`] = stretch[axis];
  });
  const all = stretch[0] + stretch[1] + stretch[2];
  // Growth along one axis is named by the axis.
  scores.grow = Math.max(...stretch.map(Math.abs)) > 0.7 * Math.abs(all) ? 0 : all;
  const [middle, width] = across(home);
  return { aside: (center[0] - middle) / width, scores };
}

/**
 * Return displacements (3V numbers) relative to the part of the shape that rests. The server aligns whole
 * shapes, so that a leg that swings turns the trunk the other way. The infinitesimal rigid motion with the
 * least sum of distances, by reweighted least squares, is the motion of the part that rests.
 */
function againstRest(home, moves) {
  const count = home.length / 3;
  const at = (values, v) => new Vector3().fromArray(values, 3 * v);
  const points = Array.from({ length: count }, (_, v) => at(home, v));
  const ways = Array.from({ length: count }, (_, v) => at(moves, v));
  const near = NEAR * across(home)[1];
  let left = ways;
  for (let round = 0; round < ROUNDS; round += 1) {
    const weights = left.map((way) => (round ? 1 / (way.length() + near) : 1));
    const total = weights.reduce((a, b) => a + b, 0);
    const mean = (vectors) =>
      vectors.reduce((sum, one, v) => sum.addScaledVector(one, weights[v] / total), new Vector3());
    const [center, shift] = [mean(points), mean(ways)];
    const inertia = new Array(9).fill(0);
    const moment = new Vector3();
    points.forEach((point, v) => {
      const arm = point.clone().sub(center);
      const [x, y, z] = arm.toArray();
      const parts = [
        y * y + z * z,
        -x * y,
        -x * z,
        -x * y,
        x * x + z * z,
        -y * z,
        -x * z,
        -y * z,
        x * x + y * y,
      ];
      parts.forEach((part, i) => (inertia[i] += weights[v] * part));
      moment.addScaledVector(arm.cross(ways[v].clone().sub(shift)), weights[v]);
    });
    const turn = moment.applyMatrix3(new Matrix3().fromArray(inertia).invert());
    left = points.map((point, v) =>
      ways[v]
        .clone()
        .sub(shift)
        .sub(turn.clone().cross(point.clone().sub(center))),
    );
  }
  return Float32Array.from(left.flatMap((way) => way.toArray()));
}

/** Return middle and extent of positions along x. */
function across(positions) {
  let [low, high] = [Infinity, -Infinity];
  for (let i = 0; i < positions.length; i += 3) {
    low = Math.min(low, positions[i]);
    high = Math.max(high, positions[i]);
  }
  return [(low + high) / 2, high - low || 1];
}
