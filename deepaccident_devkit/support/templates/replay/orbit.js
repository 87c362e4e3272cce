// The camera that looks at the scene from a direction and a distance. Metres and radians; z points up.

import { along, cross, difference, dot, inAxes } from "./vectors.js";

/** @import { Axes, Pixel, Vector } from "./types.js" */

export const FIELD_OF_VIEW = 0.9; // radians from the picture's lower to its upper edge
const DISTANCES = { min: 4, max: 900 };
const LOWEST = 0.05;
const FROM_ABOVE = Math.PI / 2;
const NEAR = 0.3;

export class Orbit {
  constructor() {
    /** @type {Vector} */
    this.target = [0, 0, 0];
    this.turn = -Math.PI / 2; // the side that it looks from
    this.rise = 0.6; // above the horizon
    this.distance = 60;
  }

  /**
   * Right, up and ahead; they are defined from straight above, too.
   * @returns {Axes}
   */
  get axes() {
    const [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    /** @type {Vector} */
    const ahead = [-cos * Math.cos(this.rise), -sin * Math.cos(this.rise), -Math.sin(this.rise)];
    /** @type {Vector} */
    const right = [-sin, cos, 0];
    return [right, cross(right, ahead), ahead];
  }

  get eye() {
    return along(this.target, this.axes, [0, 0, -this.distance]);
  }

  /** The six numbers of `data-view`: target, turn, rise, distance. */
  get numbers() {
    return [...this.target, this.turn, this.rise, this.distance];
  }

  /** @param {number[]} numbers as `numbers` has them */
  set numbers([x, y, z, turn, rise, distance]) {
    Object.assign(this, { target: [x, y, z], turn, rise, distance });
  }

  /**
   * @param {number} right radians
   * @param {number} up radians
   */
  turnBy(right, up) {
    this.turn -= right;
    this.rise = Math.min(FROM_ABOVE, Math.max(LOWEST, this.rise + up));
  }

  /** Look straight down, with north up. */
  turnDown() {
    this.rise = FROM_ABOVE;
    this.turn = -FROM_ABOVE;
  }

  /** @param {number} distance metres; as far as that is allowed */
  setDistance(distance) {
    this.distance = Math.min(DISTANCES.max, Math.max(DISTANCES.min, distance));
  }

  /** @param {number} factor */
  zoom(factor) {
    this.setDistance(this.distance / factor);
  }

  /**
   * Move along the ground by pixels.
   * @param {number} right
   * @param {number} down
   * @param {number} height of the picture, pixels
   */
  move(right, down, height) {
    const metres = (2 * this.distance * Math.tan(FIELD_OF_VIEW / 2)) / height;
    const [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    this.target[0] += metres * (sin * right - cos * down);
    this.target[1] += metres * (-cos * right - sin * down);
  }

  /**
   * Return the matrix from the world to the picture, whose edges are at -1 and 1; column by column.
   * @param {number} aspect width by height
   */
  matrix(aspect) {
    const [right, up, ahead] = this.axes;
    const eye = this.eye;
    const zoom = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const [near, far] = [Math.max(0.2, this.distance / 200), this.distance + 1000];
    const rows = [
      [...right.map((value) => (value * zoom) / aspect), (-dot(right, eye) * zoom) / aspect],
      [...up.map((value) => value * zoom), -dot(up, eye) * zoom],
      [...ahead, -dot(ahead, eye)].map((value) => (value * (far + near)) / (far - near)),
      [...ahead, -dot(ahead, eye)],
    ];
    rows[2][3] -= (2 * far * near) / (far - near);
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }

  /**
   * Return the direction of what a pixel shows; its part along the middle of the picture has length 1.
   * @param {number} x
   * @param {number} y
   * @param {number} width of the picture, pixels
   * @param {number} height
   */
  ray(x, y, width, height) {
    const half = Math.tan(FIELD_OF_VIEW / 2);
    const [across, up] = [((2 * x) / width - 1) * half * (width / height), (1 - (2 * y) / height) * half];
    return along([0, 0, 0], this.axes, [across, up, 1]);
  }

  /**
   * Return the pixel of a point; null behind the eye.
   * @param {Vector} point
   * @param {number} width of the picture, pixels
   * @param {number} height
   * @returns {Pixel | null}
   */
  pixel(point, width, height) {
    const [right, up, ahead] = inAxes(this.axes, difference(point, this.eye));
    if (ahead < NEAR) return null;
    const zoom = height / 2 / Math.tan(FIELD_OF_VIEW / 2) / ahead;
    return [width / 2 + right * zoom, height / 2 - up * zoom];
  }
}
