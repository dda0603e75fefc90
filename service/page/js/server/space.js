/**
 * The coordinates of a model's codes: bounds, periods, and the code at home. Mirrors what the server does
 * with them.
 */

const mod = (a, n) => ((a % n) + n) % n;

export class LatentSpace {
  constructor({ lower, upper, period, factors }) {
    this.lower = lower;
    this.upper = upper;
    this.period = period;
    this.factors = factors;
    /** Zero, the mean, where it lies inside the bounds, else the middle. */
    this.home = lower.map((low, k) => (low <= 0 && upper[k] >= 0 ? 0 : (low + upper[k]) / 2));
  }

  /** A coordinate in its one form: an angle within one period from its lower bound. */
  wrap(k, value) {
    if (!this.period[k] || (value >= this.lower[k] && value < this.lower[k] + this.period[k])) return value;
    return this.lower[k] + mod(value - this.lower[k], this.period[k]);
  }

  wrapAll(code) {
    return code.map((value, k) => this.wrap(k, value));
  }

  /** Ends of a slider: the bounds and some way beyond, or one period. */
  range(k) {
    if (this.period[k]) return [this.lower[k], this.lower[k] + this.period[k]];
    const beyond = 0.3 * (this.upper[k] - this.lower[k]);
    return [this.lower[k] - beyond, this.upper[k] + beyond];
  }

  /** The values of a coordinate's three pictures: towards the lower bound, at home, towards the upper one. */
  stations(k) {
    if (!this.period[k]) return [this.lower[k], this.home[k], this.upper[k]];
    return [-0.25, 0, 0.25].map((turn) => this.wrap(k, this.home[k] + turn * this.period[k]));
  }

  inside(k, value) {
    const slack = 1e-6 * (this.upper[k] - this.lower[k]);
    return value >= this.lower[k] - slack && value <= this.upper[k] + slack;
  }

  /**
   * The codes at some times of a path through keyframes: 0 is the first of these, 1 the next, and so on;
   * before the first and past the last it goes straight on, and angles take the shorter way round.
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

  /** Keyframes with angles moved by whole periods, so that no step is longer than half of one. */
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

  /** Home but for some coordinates. */
  homeBut(changes) {
    return this.home.map((value, k) => changes[k] ?? value);
  }

  /** Home but for one factor's coordinates, which are those of `code`. */
  alone(factor, code) {
    return this.home.map((value, k) => (k >= factor.start && k < factor.stop ? code[k] : value));
  }
}

export const sameCode = (a, b) =>
  a.length === b.length && a.every((value, k) => Math.abs(value - b[k]) < 1e-7);

/** The locked coordinates of a code, as the server takes what is fixed. */
export const fixedBy = (locked, code) =>
  Object.fromEntries(code.map((value, k) => [k, value]).filter(([k]) => locked[k]));
