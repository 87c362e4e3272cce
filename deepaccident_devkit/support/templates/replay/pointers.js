// The mouse and fingers on a canvas: dragging, pinching, pointing and clicking.

import { ZOOM_STEP } from "./map_view.js";

const CLICK = 4; // pixels: a pointer that moves less has clicked

/**
 * What pointers do on a canvas.
 * @typedef {object} PointerActions
 * @property {(right: number, down: number, isMove: boolean) => void} drag by pixels; a move is one by two fingers, the
 *   right button or the shift key
 * @property {(factor: number) => void} zoom
 * @property {(x: number, y: number) => void} point
 * @property {() => void} leave
 * @property {(x: number, y: number) => void} click
 */

/**
 * Call back what pointers do on a canvas.
 * @param {HTMLCanvasElement} canvas
 * @param {PointerActions} actions
 */
export function onPointers(canvas, { drag, zoom, point, leave, click }) {
  /** @type {Map<number, { x: number, y: number }>} */
  const fingers = new Map();
  let travelled = 0;
  const spread = () => {
    const [one, other] = [...fingers.values()];
    return Math.hypot(one.x - other.x, one.y - other.y);
  };
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(event.deltaY < 0 ? ZOOM_STEP : 1 / ZOOM_STEP);
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (!fingers.size) travelled = 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      point(event.offsetX, event.offsetY);
      return;
    }
    const spreadBefore = fingers.size === 2 ? spread() : null;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const [right, down] = [event.clientX - before.x, event.clientY - before.y];
    travelled += Math.hypot(right, down);
    if (spreadBefore !== null) {
      zoom(spread() / Math.max(spreadBefore, 1));
      drag(right / 2, down / 2, true);
    } else if (travelled >= CLICK) drag(right, down, event.shiftKey || event.buttons === 2);
  });
  canvas.addEventListener("pointerleave", leave);
  canvas.addEventListener("pointerup", (event) => {
    if (fingers.delete(event.pointerId) && !fingers.size && travelled < CLICK) click(event.offsetX, event.offsetY);
  });
  canvas.addEventListener("pointercancel", (event) => {
    fingers.delete(event.pointerId);
  });
}
