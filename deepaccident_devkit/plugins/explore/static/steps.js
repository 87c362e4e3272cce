// Two recordings in step: which frame and view of one belong to those of the other.

/**
 * Return the frame of the other recording at the same moment, or the nearest that exists.
 * @param {number} frame
 * @param {number} shift of the number of a frame in the other recording
 * @param {number} last the other one's last frame
 */
export function frameInStep(frame, shift, last) {
  return Math.min(last, Math.max(0, frame + shift));
}

/**
 * Return the numbers of a view (of `data-view`) that shows the other recording the same part of the world.
 * @param {number[]} view its first numbers are a place
 * @param {number[]} offset from one recording's places to the other's, metres
 */
export function viewInStep(view, offset) {
  return view.map((number, position) => number + (offset[position] ?? 0));
}

/**
 * @param {number[]} one
 * @param {number[]} other
 */
export function isSameView(one, other) {
  return one.every((number, position) => Math.abs(number - other[position]) < 1e-6);
}

/**
 * Return the numbers of a text.
 * @param {string | undefined} text
 */
export function numbersOf(text) {
  return (text ?? "").split(" ").map(Number);
}
