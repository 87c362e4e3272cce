// The projection of boxes into the pictures of a camera. Cameras have optical axes: right, down and ahead.

import { cornersOf, EDGES } from "./boxes.js";
import { along, between, difference, inAxes } from "./vectors.js";

/** @import { Actor, ActorState, Axes, Camera, CameraPose, Pixel, Rectangle, Vector } from "./types.js" */

const NEAR = 10; // centimetres ahead of the camera: what is nearer is cut off

/**
 * Return the axes of a camera in the world.
 * @param {CameraPose} pose
 * @returns {Axes}
 */
export function cameraAxes(pose) {
  const [w, x, y, z] = [pose[3] / 10000, pose[4] / 10000, pose[5] / 10000, pose[6] / 10000];
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

/**
 * Return the corners of an actor's box in the axes of a camera, centimetres.
 * @param {CameraPose} pose
 * @param {Actor} actor
 * @param {ActorState} state
 */
export function cornersInCamera(pose, actor, state) {
  return inCamera(pose, cornersOf(actor, state));
}

/**
 * Return places in the axes of a camera, centimetres.
 * @param {CameraPose} pose
 * @param {Vector[]} places in the world, centimetres
 */
export function inCamera(pose, places) {
  const axes = cameraAxes(pose);
  /** @type {Vector} */
  const eye = [pose[0], pose[1], pose[2]];
  return places.map((place) => inAxes(axes, difference(place, eye)));
}

/**
 * Return the pixel of a place ahead of a camera.
 * @param {Camera} camera
 * @param {Vector} place in the camera's axes
 * @returns {Pixel}
 */
export function pixelOf(camera, [right, down, ahead]) {
  const [, , fx, fy, cx, cy] = camera.lens;
  return [(fx * right) / ahead + cx, (fy * down) / ahead + cy];
}

/** @param {Vector} corner in the axes of a camera */
export function isAhead(corner) {
  return corner[2] > NEAR;
}

/**
 * Return edges in a picture; none if all lie outside of it. What is behind the camera is cut off.
 * @param {Camera} camera
 * @param {Vector[]} corners in the camera's axes
 * @param {number[][]} joined which corners an edge joins; by default those of a box
 * @returns {[Pixel, Pixel][]}
 */
export function edgesInPicture(camera, corners, joined = EDGES) {
  /** @type {[Pixel, Pixel][]} */
  const edges = [];
  for (const [from, to] of joined) {
    const [one, other] = [corners[from], corners[to]];
    if (!isAhead(one) && !isAhead(other)) continue;
    edges.push([pixelOf(camera, cutOff(one, other)), pixelOf(camera, cutOff(other, one))]);
  }
  const [width, height] = camera.lens;
  const [left, top, right, bottom] = extentOf(edges.flat());
  return right < 0 || left > width || bottom < 0 || top > height ? [] : edges;
}

/**
 * Return the corners of an area in a picture; what is behind the camera is cut off.
 * @param {Camera} camera
 * @param {Vector[]} corners in the camera's axes
 * @returns {Pixel[]}
 */
export function areaInPicture(camera, corners) {
  return corners.flatMap((corner, number) => {
    const next = corners[(number + 1) % corners.length];
    const ends = [isAhead(corner) ? [corner] : [], isAhead(corner) === isAhead(next) ? [] : [crossing(corner, next)]];
    return ends.flat().map((end) => pixelOf(camera, end));
  });
}

/**
 * Return the place between two others that is as near as a camera sees.
 * @param {Vector} one
 * @param {Vector} other
 */
function crossing(one, other) {
  return between(other, one, (NEAR - other[2]) / (one[2] - other[2]));
}

/**
 * Return an end of an edge or, if it is too near, the place on the edge that is as near as a camera sees.
 * @param {Vector} end
 * @param {Vector} other
 */
function cutOff(end, other) {
  return end[2] >= NEAR ? end : crossing(end, other);
}

/**
 * Return the corners of a camera's picture in the world, at a depth ahead of it; metres.
 * @param {Camera} camera
 * @param {CameraPose} pose
 * @param {number} depth
 */
export function frustumCorners(camera, pose, depth) {
  const [width, height, fx, fy, cx, cy] = camera.lens;
  const axes = cameraAxes(pose);
  const eye = eyeOf(pose);
  return [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) =>
    along(eye, axes, [((u - cx) / fx) * depth, ((v - cy) / fy) * depth, depth]),
  );
}

/**
 * @param {CameraPose} pose
 * @returns {Vector} where the camera is, metres
 */
export function eyeOf(pose) {
  return [pose[0] / 100, pose[1] / 100, pose[2] / 100];
}

/**
 * Return the rectangle around some pixels.
 * @param {Pixel[]} pixels
 * @returns {Rectangle}
 */
export function extentOf(pixels) {
  const across = pixels.map((pixel) => pixel[0]);
  const down = pixels.map((pixel) => pixel[1]);
  return [Math.min(...across), Math.min(...down), Math.max(...across), Math.max(...down)];
}

/**
 * Return pixels as the path of an SVG.
 * @param {Pixel[]} pixels
 */
export function pathOf(pixels) {
  return `M${pixels.map(([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`).join("L")}`;
}
