// What of a replay stands in the address of its page.

/** @import { Camera } from "../../../support/templates/replay/types.js" */

/**
 * Return the frame that an address asks for. Without one it is the first frame or, if a partial download has no
 * pictures of that, the frame that has the most.
 * @param {string | null} text the number of the frame, from 1
 * @param {Camera[]} cameras
 * @param {number} frames how many there are
 */
export function frameOfAddress(text, cameras, frames) {
  const number = Number(text);
  if (Number.isInteger(number) && number > 0) return number - 1;
  const counts = Array.from({ length: frames }, (_, frame) => {
    return cameras.filter((camera) => camera.pictures[frame] !== null).length;
  });
  return counts[0] ? 0 : counts.indexOf(Math.max(...counts));
}

/**
 * Return a view of the map as an address has it.
 * @param {number[]} view
 */
export function viewText(view) {
  return view.map((number) => number.toFixed(2)).join(",");
}

/**
 * Return the view of the map that an address asks for; null if it is not x, y and a scale.
 * @param {string | null} text
 */
export function viewOfAddress(text) {
  const view = (text ?? "").split(",").map(Number);
  return view.length === 3 && view.every(Number.isFinite) && view[2] > 0 ? view : null;
}

/**
 * Return the cameras that an address asks for: names of agents and titles.
 * @param {string | null} text
 */
export function picturesOfAddress(text) {
  const pairs = (text ?? "").split(",").map((pair) => pair.split(":"));
  return pairs.filter((pair) => pair.length === 2).map(([agent, title]) => ({ agent, title }));
}

/**
 * Return the query of an address with some values changed; those that are null are left out.
 * @param {string} query
 * @param {Record<string, string | null>} values
 */
export function changedQuery(query, values) {
  const changed = new URLSearchParams(query);
  for (const [name, value] of Object.entries(values)) {
    if (value === null) changed.delete(name);
    else changed.set(name, value);
  }
  return changed.toString();
}
