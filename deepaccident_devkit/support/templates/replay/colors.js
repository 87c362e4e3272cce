// Colours as the graphics processor takes them: red, green and blue from 0 to 1.

/** @import { Color } from "./types.js" */

/**
 * @param {string} color `#rrggbb`
 * @returns {Color}
 */
export function channelsOf(color) {
  const channel = (/** @type {number} */ at) => parseInt(color.slice(at, at + 2), 16) / 255;
  return [channel(1), channel(3), channel(5)];
}

/**
 * Return a lighter colour, for thin lines and points on a dark ground.
 * @param {Color} color
 */
export function lightened(color) {
  return changed(color, (channel) => 0.3 + 0.7 * channel);
}

/**
 * Return the colour at a share of the way through several colours.
 * @param {Color[]} colors
 * @param {number} share below 0 the first, above 1 the last colour
 * @returns {Color}
 */
export function mixed(colors, share) {
  const position = Math.min(1, Math.max(0, share)) * (colors.length - 1);
  const low = Math.min(colors.length - 2, Math.floor(position));
  const [one, other, weight] = [colors[low], colors[low + 1], position - low];
  return [
    one[0] + weight * (other[0] - one[0]),
    one[1] + weight * (other[1] - one[1]),
    one[2] + weight * (other[2] - one[2]),
  ];
}

/**
 * @param {Color} color
 * @param {(channel: number) => number} change
 * @returns {Color}
 */
export function changed([red, green, blue], change) {
  return [change(red), change(green), change(blue)];
}
