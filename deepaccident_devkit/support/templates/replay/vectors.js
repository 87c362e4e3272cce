// Vectors of three numbers.

/** @import { Axes, Vector } from "./types.js" */

/**
 * @param {Vector} one
 * @param {Vector} other
 */
export function dot(one, other) {
  return one[0] * other[0] + one[1] * other[1] + one[2] * other[2];
}

/**
 * @param {Vector} one
 * @param {Vector} other
 * @returns {Vector}
 */
export function cross(one, other) {
  return [
    one[1] * other[2] - one[2] * other[1],
    one[2] * other[0] - one[0] * other[2],
    one[0] * other[1] - one[1] * other[0],
  ];
}

/**
 * @param {Vector} one
 * @param {Vector} other
 * @returns {Vector}
 */
export function difference(one, other) {
  return [one[0] - other[0], one[1] - other[1], one[2] - other[2]];
}

/**
 * Return the place at a share of the way from one to another.
 * @param {Vector} from
 * @param {Vector} to
 * @param {number} share
 * @returns {Vector}
 */
export function between(from, to, share) {
  return [
    from[0] + share * (to[0] - from[0]),
    from[1] + share * (to[1] - from[1]),
    from[2] + share * (to[2] - from[2]),
  ];
}

/**
 * Return a place given by its distances along three axes from an origin.
 * @param {Vector} origin
 * @param {Axes} axes
 * @param {Vector} distances
 * @returns {Vector}
 */
export function along(origin, axes, distances) {
  /** @param {0 | 1 | 2} row */
  const coordinate = (row) =>
    origin[row] + (axes[0][row] * distances[0] + axes[1][row] * distances[1] + axes[2][row] * distances[2]);
  return [coordinate(0), coordinate(1), coordinate(2)];
}

/**
 * Return the coordinates of a vector along three axes.
 * @param {Axes} axes
 * @param {Vector} vector
 * @returns {Vector}
 */
export function inAxes(axes, vector) {
  return [dot(axes[0], vector), dot(axes[1], vector), dot(axes[2], vector)];
}
