// Where labels are placed so that they hide little: rectangles of pixels.

/** @import { Pixel, Rectangle } from "./types.js" */

// The directions beside a rectangle, the best ones first.
const SIDES = [[0, -1], [1, 0], [0, 1], [-1, 0], [1, -1], [1, 1], [-1, 1], [-1, -1]];
const RINGS = 5;
const OUTSIDE = 1e5; // the cost of a label that the canvas cuts off
const LINE = { height: 17, step: 18, above: 20 };

/**
 * Return the area that two rectangles have in common.
 * @param {Rectangle} one
 * @param {Rectangle} other
 */
export function overlap(one, other) {
  const across = Math.min(one[2], other[2]) - Math.max(one[0], other[0]);
  const down = Math.min(one[3], other[3]) - Math.max(one[1], other[1]);
  return across > 0 && down > 0 ? across * down : 0;
}

/**
 * Return the rectangle of a label beside another rectangle, where it hides the least.
 * @param {Rectangle} rectangle
 * @param {[width: number, height: number]} size of the label
 * @param {Rectangle[]} occupied
 * @param {[width: number, height: number]} canvas
 * @returns {Rectangle}
 */
export function placeBeside([left, top, right, bottom], [wide, tall], occupied, [width, height]) {
  /** @type {Rectangle} */
  let best = [0, 0, 0, 0];
  let leastCost = Infinity;
  for (let ring = 0; ring < RINGS && leastCost > 0; ring += 1) {
    const gap = 3 + ring * (tall + 2);
    for (const [across, down] of SIDES) {
      const x = (left + right) / 2 + across * ((right - left) / 2 + gap + wide / 2);
      const y = (top + bottom) / 2 + down * ((bottom - top) / 2 + gap + tall / 2);
      /** @type {Rectangle} */
      const candidate = [x - wide / 2, y - tall / 2, x + wide / 2, y + tall / 2];
      const isCut = candidate[0] < 0 || candidate[1] < 0 || candidate[2] > width || candidate[3] > height;
      const cost = occupied.reduce((sum, rectangle) => sum + overlap(candidate, rectangle), isCut ? OUTSIDE : 0);
      if (cost < leastCost) [best, leastCost] = [candidate, cost];
    }
  }
  return best;
}

/**
 * Return the rectangle of a tag above some pixels, inside a picture and on no other tag as far as there is room.
 * @param {Pixel[]} pixels
 * @param {[width: number, height: number]} size of the tag
 * @param {Rectangle[]} occupied
 * @param {[width: number, height: number]} picture
 * @param {number} gap
 * @returns {Rectangle}
 */
export function placeAbove(pixels, [wide, tall], occupied, [width, height], gap) {
  const within = (/** @type {number} */ low, /** @type {number} */ value, /** @type {number} */ high) =>
    Math.min(Math.max(low, value), high);
  const across = pixels.map(([x]) => within(0, x, width));
  const down = pixels.map(([, y]) => within(0, y, height));
  const middle = (Math.min(...across) + Math.max(...across) - wide) / 2;
  const y = within(0, Math.min(...down) - tall - 2 * gap, height - tall);
  /** @type {Rectangle[]} */
  const places = [0, 1, -1, 2, -2].map((step) => {
    const x = within(0, middle + step * (wide + 3 * gap), width - wide);
    return [x, y, x + wide, y + tall];
  });
  const isFree = (/** @type {Rectangle} */ candidate) => occupied.every((rectangle) => overlap(candidate, rectangle) === 0);
  return places.find(isFree) ?? places[0];
}

/**
 * Return the rectangle of a name above a pixel, higher where it would lie on another one; null if it is cut off.
 * @param {Pixel} pixel
 * @param {number} wide
 * @param {Rectangle[]} occupied
 * @param {[width: number, height: number]} canvas
 * @returns {Rectangle | null}
 */
export function placeOver([x, y], wide, occupied, [width, height]) {
  /** @type {Rectangle} */
  let candidate = [x - wide / 2, y - LINE.above, x + wide / 2, y - LINE.above + LINE.height];
  while (occupied.some((rectangle) => overlap(candidate, rectangle) > 0)) {
    candidate = [candidate[0], candidate[1] - LINE.step, candidate[2], candidate[3] - LINE.step];
  }
  return candidate[0] < 0 || candidate[2] > width || candidate[1] < 0 || candidate[3] > height ? null : candidate;
}
