// Which picture of a camera stands for a frame. A release may lack some, and a page without a server has only some.

/** @import { Camera } from "./types.js" */

const OLDEST = 0.5; // seconds: how old a picture of a page without a server may be

/** @param {Camera} camera */
export function hasPictures(camera) {
  return camera.pictures.some((picture) => picture !== null);
}

/**
 * Return the frame whose picture stands for a frame: the last one before it or, if there is none, the first one.
 * @param {Camera} camera
 * @param {number} frame
 */
export function pictureFrame(camera, frame) {
  for (let at = frame; at >= 0; at -= 1) {
    if (camera.pictures[at] !== null) return at;
  }
  return camera.pictures.findIndex((picture) => picture !== null);
}

/**
 * Return a camera's title and, if its picture is of another frame, by how much it is earlier or later.
 * @param {Camera} camera
 * @param {number} frame that is shown
 * @param {number} pictured the picture's frame
 * @param {number} period
 */
export function pictureTitle(camera, frame, pictured, period) {
  const frames = frame - pictured;
  if (frames === 0) return camera.title;
  return `${camera.title}, ${(Math.abs(frames) * period).toFixed(1)} s ${frames > 0 ? "earlier" : "later"}`;
}

/**
 * Return whether a camera has no picture that is recent enough to stand for a frame.
 * @param {Camera} camera
 * @param {number} frame
 * @param {number} period
 * @param {boolean} isServed
 */
export function isOutdated(camera, frame, period, isServed) {
  const seconds = Math.abs(frame - pictureFrame(camera, frame)) * period;
  return seconds > (isServed ? 0 : OLDEST);
}
