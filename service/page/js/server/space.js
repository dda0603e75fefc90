/**
 * The coordinates of a model's codes: bounds, periods, and the home code. Computes as the server does.
 */

const mod = (a, n) => ((a % n) + n) % n;

export class LatentSpace {
  constructor({ lower, upper, period, factors }) {
    this.lower = lower;
    this.upper = upper;
    this.period = period;
    this.factors = factors;
    /** Zero, which is the mean, if it lies inside the bounds; otherwise the middle. */
    this.home = lower.map((low, k) => (low <= 0 && upper[k] >= 0 ? 0 : (low + upper[k]) / 2));
  }

  /** Return a coordinate in canonical form: an angle within one period from its lower bound. */
  wrap(k, value) {
    if (!this.period[k] || (value >= this.lower[k] && value < this.lower[k] + this.period[k])) return value;
    return this.lower[k] + mod(value - this.lower[k], this.period[k]);
  }

  wrapAll(code) {
    return code.map((value, k) => this.wrap(k, value));
  }

  /** Return a code inside the bounds: others move to the nearer bound, with an address's digits. */
  clampAll(code) {
    return this.wrapAll(code).map((value, k) => {
      const low = Math.ceil(1e5 * this.lower[k]) / 1e5;
      const high = Math.floor(1e5 * this.upper[k]) / 1e5;
      if (value >= low && value <= high) return value;
      const away = (bound) => Math.abs(this.#shorter(k, value - bound));
      return away(low) <= away(high) ? low : high;
    });
  }

  /** Return the ends of a slider: somewhat beyond the bounds, or one period. */
  range(k) {
    if (this.period[k]) return [this.lower[k], this.lower[k] + this.period[k]];
    const beyond = 0.3 * (this.upper[k] - this.lower[k]);
    return [this.lower[k] - beyond, this.upper[k] + beyond];
  }

  /** Return the values of a coordinate's two pictures: its bounds, or a quarter of a period on each side. */
  ends(k) {
    if (!this.period[k]) return [this.lower[k], this.upper[k]];
    return [-0.25, 0.25].map((turn) => this.wrap(k, this.home[k] + turn * this.period[k]));
  }

  inside(k, value) {
    const slack = 1e-6 * (this.upper[k] - this.lower[k]);
    return value >= this.lower[k] - slack && value <= this.upper[k] + slack;
  }

  /**
   * Return the codes at some times of a path through keyframes; time 0 is the first keyframe, 1 the second.
   * Outside, the path continues in a straight line. Angles take the shorter way round.
   * @param {number[][]} keyframes
   * @param {number[]} times
   */
  along(keyframes, times) {
    const way = this.#unroll(keyframes);
    return times.map((t) => {
      const k = Math.min(Math.max(Math.floor(t), 0), way.length - 2);
      return this.wrapAll(way[k].map((value, i) => (1 - t + k) * value + (t - k) * way[k + 1][i]));
    });
  }

  /** Return keyframes with angles moved by whole periods, so that no step exceeds half a period. */
  #unroll(keyframes) {
    const way = [keyframes[0]];
    for (const code of keyframes.slice(1)) {
      const before = way.at(-1);
      way.push(code.map((value, k) => before[k] + this.#shorter(k, value - before[k])));
    }
    return way;
  }

  #shorter(k, step) {
    const period = this.period[k];
    return period ? period / 2 - mod(period / 2 - step, period) : step;
  }

  /** Return the home code with some coordinates replaced. */
  homeBut(changes) {
    return this.home.map((value, k) => changes[k] ?? value);
  }

  /** Return the home code with one factor's coordinates from `code`. */
  alone(factor, code) {
    return this.home.map((value, k) => (k >= factor.start && k < factor.stop ? code[k] : value));
  }
}

export const sameCode = (a, b) =>
  a.length === b.length && a.every((value, k) => Math.abs(value - b[k]) < 1e-7);

/** Return the locked coordinates of a code as the server's `fixed`. */
export const fixedBy = (locked, code) =>
  Object.fromEntries(code.map((value, k) => [k, value]).filter(([k]) => locked[k]));

/** Return the code of `m` numbers that a text lists, or null. */
export function codeIn(text, m) {
  const code = (text ?? "").split(",").map(Number);
  return code.length === m && code.every(Number.isFinite) ? code : null;
}
