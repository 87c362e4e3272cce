// Curves and bars over the frames of a recording, in the coordinates of an SVG: x is the frame.

/**
 * Return the values that are known.
 * @param {(number | null)[]} values
 */
export function known(values) {
  return values.filter((value) => value !== null);
}

/**
 * Return the path of a curve between 0 and `maximum`, with gaps where values are unknown.
 * @param {(number | null)[]} values one for each frame
 * @param {number} maximum what is at the upper edge; larger values are, too
 * @param {number} height of the curve, pixels
 */
export function curvePath(values, maximum, height) {
  let path = "";
  for (const [frame, value] of values.entries()) {
    if (value === null) continue;
    const isFirst = frame === 0 || values[frame - 1] === null;
    const y = height - 1.5 - (Math.min(value, maximum) / maximum) * (height - 3);
    path += `${isFirst ? "M" : "L"}${frame} ${y.toFixed(1)}`;
  }
  return path;
}

/**
 * Return the first and last frame of each run in which a condition holds.
 * @param {number} last the last frame
 * @param {(frame: number) => boolean} holds
 */
export function runs(last, holds) {
  /** @type {[from: number, to: number][]} */
  const intervals = [];
  for (let frame = 0; frame <= last; frame += 1) {
    if (!holds(frame)) continue;
    const from = frame;
    while (frame < last && holds(frame + 1)) frame += 1;
    intervals.push([from, frame]);
  }
  return intervals;
}

/**
 * Return the left end and the width of a bar: half a frame beyond its frames, but not beyond the recording.
 * @param {number} from
 * @param {number} to
 * @param {number} last
 */
export function barExtent(from, to, last) {
  const left = Math.max(0, from - 0.5);
  return { x: left, width: Math.min(Math.max(last, 1), to + 0.5) - left };
}
