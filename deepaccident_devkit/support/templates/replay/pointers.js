// The mouse and fingers on a canvas: dragging, pinching, pointing and clicking.

const STILL = 4; // pixels: a pointer that moves less has clicked

/**
 * Call `drag(right, down, moves)` with pixels (`moves`: two fingers, the right button or the shift key),
 * `zoom(factor)`, `point(x, y)` where the mouse is and `point(null)` where it has gone, and `click(x, y)`.
 */
function onPointers(canvas, { drag, zoom, point, click }) {
  const fingers = new Map();
  let way = 0;
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
    if (!fingers.size) way = 0;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) {
      point(event.offsetX, event.offsetY);
      return;
    }
    const apart = fingers.size === 2 ? spread() : null;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const [right, down] = [event.clientX - before.x, event.clientY - before.y];
    way += Math.hypot(right, down);
    if (apart !== null) {
      zoom(spread() / Math.max(apart, 1));
      drag(right / 2, down / 2, true);
    } else if (way >= STILL) drag(right, down, event.shiftKey || event.buttons === 2);
  });
  canvas.addEventListener("pointerleave", () => point(null));
  canvas.addEventListener("pointerup", (event) => {
    if (fingers.delete(event.pointerId) && !fingers.size && way < STILL) click(event.offsetX, event.offsetY);
  });
  canvas.addEventListener("pointercancel", (event) => fingers.delete(event.pointerId));
}
