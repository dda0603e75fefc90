/** Lengths and angles of a mesh's edges, and their differences between two shapes. */

/**
 * The connectivity of a mesh: its edges, the faces beside them, and the edges around each vertex.
 */
export class Surface {
  constructor(faces, vertexCount) {
    const known = new Map();
    const edges = [];
    for (let f = 0; f < faces.length; f += 3) {
      for (let c = 0; c < 3; c += 1) {
        const [a, b, opposite] = [faces[f + c], faces[f + ((c + 1) % 3)], faces[f + ((c + 2) % 3)]];
        const key = Math.min(a, b) * vertexCount + Math.max(a, b);
        const edge = known.get(key);
        // In the second face the edge has the opposite direction, so the opposite corner lies to the right.
        if (edge === undefined) {
          known.set(key, edges.length);
          edges.push([a, b, opposite, -1]);
        } else edges[edge][3] = opposite;
      }
    }
    this.edges = edges;
    this.vertexCount = vertexCount;
  }

  /** Return lengths and signed dihedral angles of all edges; positive where convex, 0 at a boundary. */
  measure(x) {
    const lengths = new Float32Array(this.edges.length);
    const angles = new Float32Array(this.edges.length);
    this.edges.forEach(([a, b, c, d], i) => {
      const e = minus(x, b, a);
      lengths[i] = Math.hypot(...e);
      if (d < 0) return;
      const left = cross(e, minus(x, c, a));
      const right = cross(minus(x, d, a), e);
      angles[i] = Math.atan2(-dot(e, cross(right, left)), lengths[i] * dot(left, right));
    });
    return { lengths, angles };
  }

  /** Return the logarithm of the ratio of each edge's lengths. */
  stretch(from, to) {
    return to.lengths.map((length, i) => Math.log(length / from.lengths[i]));
  }

  /** Return the change of each edge's angle, in radians. */
  bending(from, to) {
    return to.angles.map((angle, i) => {
      const change = angle - from.angles[i];
      return change - 2 * Math.PI * Math.round(change / (2 * Math.PI));
    });
  }

  /** Average values at vertices over each vertex and its neighbours. */
  smooth(values) {
    const sums = Float32Array.from(values);
    const counts = new Float32Array(this.vertexCount).fill(1);
    for (const [a, b] of this.edges) {
      sums[a] += values[b];
      sums[b] += values[a];
      counts[a] += 1;
      counts[b] += 1;
    }
    return sums.map((sum, vertex) => sum / counts[vertex]);
  }

  /** Return the mean of values at the edges of each vertex, weighted by their lengths before. */
  atVertices(values, { lengths }, interiorOnly) {
    const sums = new Float32Array(this.vertexCount);
    const weights = new Float32Array(this.vertexCount);
    this.edges.forEach(([a, b, , d], i) => {
      if (interiorOnly && d < 0) return;
      for (const vertex of [a, b]) {
        sums[vertex] += lengths[i] * values[i];
        weights[vertex] += lengths[i];
      }
    });
    return sums.map((sum, vertex) => sum / (weights[vertex] || 1));
  }
}

const minus = (x, i, j) => [x[3 * i] - x[3 * j], x[3 * i + 1] - x[3 * j + 1], x[3 * i + 2] - x[3 * j + 2]];
const dot = (u, v) => u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
const cross = (u, v) => [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
