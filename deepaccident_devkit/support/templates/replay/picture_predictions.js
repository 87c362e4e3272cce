// What a task draws of an agent's prediction, on the ground in the pictures of its cameras.

import { linesAt } from "./actors.js";
import { ground } from "./data.js";
import { drawn } from "./elements.js";
import { RING_METRES } from "./map_view.js";
import { areaInPicture, edgesInPicture, inCamera, pathOf } from "./projection.js";
import { state } from "./state.js";

/** @import { Camera, DrawnLine, Point, Vector } from "./types.js" */

const RING_POINTS = 24;

/**
 * Make the parts of an agent's prediction in a picture of its camera.
 * @param {number} agent its number
 * @param {Camera} camera
 * @param {number} frame of the picture
 * @returns {SVGElement[]}
 */
export function predictionParts(agent, camera, frame) {
  if (!state.layers.prediction) return [];
  const samples = state.foreseen.filter((sample) => sample.agent === agent);
  const rings = samples.flatMap(({ places }) =>
    places.flatMap(({ points, color }) => points.map((point) => ({ points: ring(point), color, dashed: true }))),
  );
  return [...linesAt(samples, state.frame), ...rings].flatMap((line) => lineParts(line, camera, frame));
}

/**
 * @param {DrawnLine} line
 * @param {Camera} camera
 * @param {number} frame
 * @returns {SVGElement[]}
 */
function lineParts({ points, color, opacity = 1, width = 0, dashed, filled }, camera, frame) {
  const parts = [];
  const area = filled ? points : ribbon(points, 50 * width);
  const corners = areaInPicture(camera, onGround(area, camera, frame));
  if (corners.length) parts.push(drawn("path", { d: `${pathOf(corners)}Z`, fill: color, "fill-opacity": 0.3 * opacity }));
  const steps = points.slice(1).map((_, number) => [number, number + 1]);
  const edges = edgesInPicture(camera, onGround(points, camera, frame), steps);
  if (edges.length) {
    const style = { "stroke-width": dashed ? 1.5 : 2.5, "stroke-dasharray": dashed ? "5 3" : "none" };
    const look = { fill: "none", stroke: color, "stroke-opacity": 0.2 + 0.8 * opacity, "vector-effect": "non-scaling-stroke" };
    parts.push(drawn("path", { d: edges.map(pathOf).join(""), ...look, ...style }));
  }
  return parts;
}

/**
 * Return points on the ground in the axes of a camera.
 * @param {Point[]} points
 * @param {Camera} camera
 * @param {number} frame
 */
function onGround(points, camera, frame) {
  const places = points.map(([x, y]) => /** @type {Vector} */ ([x, y, 100 * ground.heightAt(x / 100, y / 100)]));
  return inCamera(camera.poses[frame], places);
}

/**
 * Return the outline of a band around a path; nothing if it has no width.
 * @param {Point[]} points
 * @param {number} reach half of its width
 * @returns {Point[]}
 */
function ribbon(points, reach) {
  if (!reach) return [];
  const side = (/** @type {number} */ sign) =>
    points.map(([x, y], number) => {
      const [before, after] = [points[Math.max(0, number - 1)], points[Math.min(points.length - 1, number + 1)]];
      const [right, up] = [after[0] - before[0], after[1] - before[1]];
      const share = (sign * reach) / Math.max(Math.hypot(right, up), 1);
      return /** @type {Point} */ ([x - up * share, y + right * share]);
    });
  return [...side(1), ...side(-1).reverse()];
}

/**
 * Return a closed line around a point.
 * @param {Point} point
 * @returns {Point[]}
 */
function ring([x, y]) {
  return Array.from({ length: RING_POINTS + 1 }, (_, step) => {
    const angle = (2 * Math.PI * step) / RING_POINTS;
    return [x + 100 * RING_METRES * Math.cos(angle), y + 100 * RING_METRES * Math.sin(angle)];
  });
}
