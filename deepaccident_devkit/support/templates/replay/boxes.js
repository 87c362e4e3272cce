// The boxes of actors in the world, and the ground below them. Data are centimetres and milliradians.

import { along } from "./vectors.js";

/** @import { Actor, ActorState, Axes, Vector } from "./types.js" */

// Which corners an edge joins; the corners are in the order of SIGNS, the front ones first.
export const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
// The corners of the faces; the first face is the front.
export const FACES = [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]];
/** @type {Vector[]} */
const SIGNS = [[1, 1, 1], [1, -1, 1], [1, -1, -1], [1, 1, -1], [-1, 1, 1], [-1, -1, 1], [-1, -1, -1], [-1, 1, -1]];
const SINGULAR = 1e-6;

/**
 * Return the axes of an actor's box: forward, left and up. It may be tilted, as its road is.
 * @param {ActorState} state
 * @returns {Axes}
 */
export function axesOf(state) {
  const [upX, upY] = [state[5] / 1000, state[6] / 1000];
  const upZ = Math.sqrt(1 - upX ** 2 - upY ** 2);
  const [x, y] = [Math.cos(state[2] / 1000), Math.sin(state[2] / 1000)];
  const rise = -(upX * x + upY * y) / upZ;
  const length = Math.hypot(1, rise);
  /** @type {Vector} */
  const forward = [x / length, y / length, rise / length];
  /** @type {Vector} */
  const left = [
    upY * forward[2] - upZ * forward[1],
    upZ * forward[0] - upX * forward[2],
    upX * forward[1] - upY * forward[0],
  ];
  return [forward, left, [upX, upY, upZ]];
}

/**
 * @param {ActorState} state
 * @returns {Vector} the centre, centimetres
 */
function centreOf(state) {
  return [state[0], state[1], state[4]];
}

/**
 * @param {ActorState} state
 * @returns {Vector} the centre, metres
 */
export function centreInMetres(state) {
  return [state[0] / 100, state[1] / 100, state[4] / 100];
}

/**
 * Return the eight corners of an actor's box in the world, centimetres.
 * @param {Actor} actor
 * @param {ActorState} state
 */
export function cornersOf(actor, state) {
  const axes = axesOf(state);
  const [length, width, height] = [actor.length / 2, actor.width / 2, actor.height / 2];
  return SIGNS.map((sign) => along(centreOf(state), axes, [sign[0] * length, sign[1] * width, sign[2] * height]));
}

/** The ground: the plane z = a + b x + c y, metres. */
export class GroundPlane {
  /**
   * @param {number} a
   * @param {number} b
   * @param {number} c
   */
  constructor(a, b, c) {
    this.plane = [a, b, c];
  }

  /**
   * Fit the plane to the undersides of all actors, by least squares. It is level where they stand in one line.
   * @param {Actor[]} actors
   */
  static below(actors) {
    const rows = [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]];
    for (const actor of actors) {
      for (const state of actor.states) {
        if (state === null) continue;
        const values = [1, state[0] / 100, state[1] / 100, (state[4] - actor.height / 2) / 100];
        for (const [number, row] of rows.entries()) {
          for (const [column, value] of values.entries()) row[column] += values[number] * value;
        }
      }
    }
    for (let pivot = 0; pivot < 3; pivot += 1) {
      if (Math.abs(rows[pivot][pivot]) < SINGULAR) {
        return new GroundPlane(rows[0][0] ? rows[0][3] / rows[0][0] : 0, 0, 0);
      }
      for (let number = 0; number < 3; number += 1) {
        if (number === pivot) continue;
        const share = rows[number][pivot] / rows[pivot][pivot];
        rows[number] = rows[number].map((value, column) => value - share * rows[pivot][column]);
      }
    }
    return new GroundPlane(rows[0][3] / rows[0][0], rows[1][3] / rows[1][1], rows[2][3] / rows[2][2]);
  }

  /**
   * @param {number} x metres
   * @param {number} y metres
   */
  heightAt(x, y) {
    return this.plane[0] + this.plane[1] * x + this.plane[2] * y;
  }
}
