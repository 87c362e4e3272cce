// Which actor is under a pointer: on the map, in the scene in three dimensions, and in a camera's picture.

import { axesOf, centreInMetres } from "./boxes.js";
import { shapeOf } from "./map_view.js";
import { FIELD_OF_VIEW } from "./orbit.js";
import { difference, dot } from "./vectors.js";

/** @import { Actor, Axes, Rectangle, Vector } from "./types.js" */
/** @import { MapView } from "./map_view.js" */
/** @import { Orbit } from "./orbit.js" */

const TOLERANCE = 6; // pixels beside a box that still count
const PARALLEL = 1e-9;

/**
 * Return the item with the least value, the first of several; null if there is none.
 * @template Item
 * @param {Iterable<Item>} items
 * @param {(item: Item) => number | null} valueOf null for an item that does not count
 * @returns {Item | null}
 */
function least(items, valueOf) {
  let best = null;
  let leastValue = Infinity;
  for (const item of items) {
    const value = valueOf(item);
    if (value !== null && value < leastValue) {
      best = item;
      leastValue = value;
    }
  }
  return best;
}

/**
 * Return the actor at a pixel of the map: the nearest of those whose outline is at most some pixels away.
 * @param {Actor[]} actors
 * @param {number} frame
 * @param {MapView} view
 * @param {Record<string, string>} markers
 * @param {number} x
 * @param {number} y
 */
export function actorOnMap(actors, frame, view, markers, x, y) {
  return least(actors, (actor) => {
    const state = actor.states[frame];
    if (state === null) return null;
    const middle = view.pixel(state);
    const [across, down] = [x - middle[0], y - middle[1]];
    const [cos, sin] = [Math.cos(state[2] / 1000), Math.sin(state[2] / 1000)];
    const [length, width] = view.size(actor, shapeOf(actor, markers));
    const distance = Math.hypot(
      Math.max(0, Math.abs(across * cos - down * sin) - length / 2),
      Math.max(0, Math.abs(across * sin + down * cos) - width / 2),
    );
    return distance <= TOLERANCE ? distance : null;
  });
}

/**
 * Return the actor at a pixel of the scene: the nearest whose box the ray through the pixel meets.
 * @param {Actor[]} actors
 * @param {number} frame
 * @param {Orbit} orbit
 * @param {number} x
 * @param {number} y
 * @param {number} width of the canvas
 * @param {number} height
 */
export function actorInSpace(actors, frame, orbit, x, y, width, height) {
  const eye = orbit.eye;
  const ray = orbit.ray(x, y, width, height);
  return least(actors, (actor) => {
    const state = actor.states[frame];
    if (state === null) return null;
    const middle = difference(centreInMetres(state), eye);
    const slack = (TOLERANCE * 2 * Math.tan(FIELD_OF_VIEW / 2) * Math.hypot(...middle)) / height;
    /** @type {Vector} */
    const half = [actor.length / 200 + slack, actor.width / 200 + slack, actor.height / 200 + slack];
    return distanceToBox(axesOf(state), half, middle, ray);
  });
}

/**
 * Return how far along a ray from the origin a box is met, in lengths of the ray; null if it is not.
 * @param {Axes} axes
 * @param {Vector} half half its sides
 * @param {Vector} middle
 * @param {Vector} ray
 */
export function distanceToBox(axes, half, middle, ray) {
  let [enters, leaves] = [0, Infinity];
  for (const [number, axis] of axes.entries()) {
    const [offset, speed] = [dot(axis, middle), dot(axis, ray)];
    if (Math.abs(speed) < PARALLEL) {
      if (Math.abs(offset) > half[number]) return null;
      continue;
    }
    const ends = [(offset - half[number]) / speed, (offset + half[number]) / speed];
    enters = Math.max(enters, Math.min(...ends));
    leaves = Math.min(leaves, Math.max(...ends));
  }
  return enters <= leaves ? enters : null;
}

/**
 * A box in a camera's picture: the rectangle around it, and how far its corners are in sum.
 * @typedef {{ actor: Actor, place: Rectangle, distance: number }} PicturedBox
 */

/**
 * Return the nearest actor whose rectangle holds a pixel of a picture.
 * @param {PicturedBox[]} boxes
 * @param {number} x
 * @param {number} y
 */
export function actorInPicture(boxes, x, y) {
  /** @type {(place: Rectangle) => boolean} */
  const holds = ([left, top, right, bottom]) => left <= x && x <= right && top <= y && y <= bottom;
  return least(boxes, ({ place, distance }) => (holds(place) ? distance : null))?.actor ?? null;
}
