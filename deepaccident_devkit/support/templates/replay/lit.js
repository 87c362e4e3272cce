// The actor that the reader points at or has chosen, in any view: all views name and highlight it.

import { nextActor } from "./actors.js";
import { data } from "./data.js";
import { actorInPicture } from "./picking.js";
import { refresh } from "./refresh.js";
import { state } from "./state.js";

/** @import { PicturedBox } from "./picking.js" */
/** @import { Actor } from "./types.js" */

function light() {
  const lit = state.pointed ?? state.chosen;
  if (lit === state.lit) return;
  state.lit = lit;
  refresh("actor");
}

/** @param {Actor | null} actor */
export function point(actor) {
  state.pointed = actor?.id ?? null;
  light();
}

/**
 * Choose an actor; the same one again, or none, ends the choice.
 * @param {Actor | null} actor
 */
export function choose(actor) {
  const id = actor?.id ?? null;
  state.chosen = id === state.chosen ? null : id;
  state.pointed = null;
  light();
}

/**
 * Choose the next or previous actor, in the order of the table.
 * @param {1 | -1} step
 */
export function chooseNext(step) {
  const actor = nextActor(data.actors, state.frame, state.chosen, step);
  if (actor) choose(actor);
}

/**
 * A picture with boxes over it.
 * @typedef {object} Picture
 * @property {HTMLElement} figure
 * @property {SVGSVGElement} boxes
 * @property {[width: number, height: number]} size of the image
 * @property {PicturedBox[]} places
 */

/**
 * Return the actor under a pointer.
 * @param {Picture} picture
 * @param {MouseEvent} event
 */
function actorUnder(picture, event) {
  const box = picture.boxes.getBoundingClientRect();
  const [width, height] = picture.size;
  const x = ((event.clientX - box.left) / box.width) * width;
  const y = ((event.clientY - box.top) / box.height) * height;
  return actorInPicture(picture.places, x, y);
}

/**
 * Let the reader point at and choose actors in a picture.
 * @param {Picture} picture
 * @param {HTMLElement} element around the picture
 * @param {() => void} onClick a click beside all actors, and any click on a picture that is not the large one
 */
export function lightIn(picture, element, onClick) {
  element.addEventListener("pointermove", (event) => point(actorUnder(picture, event)));
  element.addEventListener("pointerleave", () => point(null));
  element.addEventListener("click", (event) => {
    const actor = event.detail ? actorUnder(picture, event) : null; // a click by a key has no place
    if (actor) choose(actor);
    if (!actor || !picture.figure.classList.contains("large")) onClick();
  });
}
