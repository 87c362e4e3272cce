// The view of the scene from above: what part of the world a canvas shows, how large, and where on it places lie.

/** @import { Actor, ActorState, Pixel, Place, Point, Rectangle } from "./types.js" */

export const ZOOM_STEP = 1.25;
const SCALES = { min: 0.5, max: 120 }; // pixels of a metre
const LEAST_SPAN = 30; // metres
const MARGIN = 16;
const PAIR_MARGIN = 36;
const LEAST_BOX = 5; // pixels
const LEAST_MARK = 9;
export const RING_METRES = 1.2; // around marked places
/** @type {Record<string, string>} matplotlib's names of markers to ours */
const SHAPES = { o: "circle", D: "diamond", "^": "triangle" };

export class MapView {
  constructor() {
    this.x = 0; // the middle, metres
    this.y = 0;
    this.span = LEAST_SPAN; // metres that must be seen
    this.scale = 0; // pixels of a metre; 0 until the canvas has a size
    this.width = 0; // pixels
    this.height = 0;
  }

  /**
   * Show all of some places.
   * @param {Iterable<Place>} places
   */
  showAll(places) {
    const xs = [];
    const ys = [];
    for (const [x, y] of places) {
      xs.push(x / 100);
      ys.push(y / 100);
    }
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    this.x = (left + right) / 2;
    this.y = (low + high) / 2;
    this.span = Math.max(right - left, high - low, LEAST_SPAN) + MARGIN;
    this.scale = 0;
  }

  /**
   * Show two actors in the middle, the larger the nearer they are.
   * @param {ActorState} one
   * @param {ActorState} other
   */
  showPair(one, other) {
    const [oneX, oneY, otherX, otherY] = [one[0] / 100, one[1] / 100, other[0] / 100, other[1] / 100];
    this.x = (oneX + otherX) / 2;
    this.y = (oneY + otherY) / 2;
    const span = Math.max(Math.abs(oneX - otherX), Math.abs(oneY - otherY)) * 1.5 + PAIR_MARGIN;
    this.scale = Math.min(this.width, this.height) / span;
  }

  /**
   * Take the size of the canvas.
   * @param {number} width
   * @param {number} height
   */
  fit(width, height) {
    this.width = width;
    this.height = height;
    if (this.scale === 0) this.scale = Math.min(width, height) / this.span;
  }

  /** @param {number} factor */
  zoom(factor) {
    this.scale = Math.min(SCALES.max, Math.max(SCALES.min, this.scale * factor));
  }

  /**
   * Move by pixels.
   * @param {number} right
   * @param {number} down
   */
  move(right, down) {
    this.x -= right / this.scale;
    this.y += down / this.scale;
  }

  /** The three numbers of `data-view`: the middle and the scale. */
  get numbers() {
    return [this.x, this.y, this.scale];
  }

  /** @param {number[]} numbers as `numbers` has them */
  set numbers([x, y, scale]) {
    Object.assign(this, { x, y, scale });
  }

  /**
   * Return the pixel of a point.
   * @param {Place} point
   * @returns {Pixel}
   */
  pixel(point) {
    return [
      this.width / 2 + (point[0] / 100 - this.x) * this.scale,
      this.height / 2 - (point[1] / 100 - this.y) * this.scale,
    ];
  }

  /**
   * Return the length and width of an actor in pixels. Small actors stay large enough to be found.
   * @param {Actor} actor
   * @param {string} shape as of `shapeOf`
   * @returns {[length: number, width: number]}
   */
  size(actor, shape) {
    const minPixels = shape ? LEAST_MARK : LEAST_BOX;
    return [Math.max(minPixels, (actor.length / 100) * this.scale), Math.max(minPixels, (actor.width / 100) * this.scale)];
  }

  /**
   * Return the rectangle around an actor.
   * @param {Actor} actor
   * @param {ActorState} state
   * @param {string} shape
   * @returns {Rectangle}
   */
  extent(actor, state, shape) {
    const [x, y] = this.pixel(state);
    const [length, width] = this.size(actor, shape);
    const [cos, sin] = [Math.abs(Math.cos(state[2] / 1000)), Math.abs(Math.sin(state[2] / 1000))];
    const [across, down] = [(length * cos + width * sin) / 2, (length * sin + width * cos) / 2];
    return [x - across, y - down, x + across, y + down];
  }
}

/**
 * Return the shape of an actor's mark, or an empty text if it is drawn as a box.
 * @param {Actor} actor
 * @param {Record<string, string>} markers
 */
export function shapeOf(actor, markers) {
  return SHAPES[markers[actor.category]] || "";
}

/**
 * Return the size of a grid's cells (metres): 10, or as much more as keeps the lines 24 pixels apart.
 * @param {number} cell metres
 * @param {number} scale pixels of a metre
 */
export function gridStep(cell, scale) {
  return cell * Math.max(1, 2 ** Math.ceil(Math.log2(24 / (cell * scale))));
}

/**
 * Return the multiples of a step between two numbers.
 * @param {number} from
 * @param {number} to
 * @param {number} step
 */
export function multiples(from, to, step) {
  const lines = [];
  for (let value = Math.ceil(from / step) * step; value <= to; value += step) lines.push(value);
  return lines;
}

/**
 * Return the mean of some points.
 * @param {Point[]} points
 * @returns {Point}
 */
export function middleOf(points) {
  const mean = (/** @type {0 | 1} */ axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length;
  return [mean(0), mean(1)];
}
