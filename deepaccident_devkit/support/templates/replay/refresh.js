// Brings the parts of the page up to date. Modules register what they show, so that none needs to import all others.

/**
 * What has changed: the frame or a setting, the actor that is highlighted, or the points at hand.
 * @typedef {"moment" | "actor" | "points"} Change
 */

/** @type {{ draw: () => void, changes: Change[] }[]} */
const views = [];

/**
 * Register what is to be drawn anew after some changes, after what was registered before.
 * @param {() => void} draw
 * @param {Change[]} changes
 */
export function addView(draw, ...changes) {
  views.push({ draw, changes });
}

/**
 * Draw what a change concerns.
 * @param {Change} change
 */
export function refresh(change) {
  for (const view of views) if (view.changes.includes(change)) view.draw();
}

/** Bring the whole page up to date, and tell the pages around. */
export function show() {
  refresh("moment");
  document.dispatchEvent(new Event("moment"));
}
