// The boxes of actors and the prediction of the moment over the pictures of cameras.

import { isSeen } from "./actors.js";
import { data } from "./data.js";
import { drawn } from "./elements.js";
import { placeAbove } from "./labels.js";
import { predictionParts } from "./picture_predictions.js";
import { cornersInCamera, edgesInPicture, extentOf, isAhead, pathOf, pixelOf } from "./projection.js";
import { state } from "./state.js";

/** @import { Picture } from "./lit.js" */
/** @import { Actor, ActorState, Agent, Camera, Pixel, Rectangle, Vector } from "./types.js" */

const INK = "#1c1c1c";

/**
 * A picture of an agent's camera.
 * @typedef {Picture & { agent: Agent, number: number }} AgentPicture
 */

/**
 * How a box is drawn.
 * @typedef {{ isLarge: boolean, isSeen: boolean, isLit: boolean }} BoxStyle
 */

/**
 * Draw the agent's prediction and, if the reader wants them, boxes over a picture.
 * @param {AgentPicture} picture
 * @param {Camera} camera
 * @param {number} frame of the picture
 */
export function drawOver(picture, camera, frame) {
  const [width, height] = camera.lens;
  picture.boxes.setAttribute("viewBox", `0 0 ${width} ${height}`);
  picture.size = [width, height];
  picture.places = [];
  const boxes = state.boxes ? boxGroups(picture, camera, frame) : [];
  picture.boxes.replaceChildren(...predictionParts(picture.number, camera, frame), ...boxes);
}

/**
 * Make the boxes of the actors that the agent sees, of the highlighted one and, dashed, of the colliding pair.
 * @param {AgentPicture} picture
 * @param {Camera} camera
 * @param {number} frame
 */
function boxGroups(picture, camera, frame) {
  const [width] = camera.lens;
  const ratio = width / Math.max(picture.boxes.clientWidth, 1);
  const isLarge = picture.figure.classList.contains("large");
  /** @type {Rectangle[]} */
  const occupied = [];
  const groups = [];
  for (const actor of [...data.actors].reverse()) {
    const now = actor.states[frame];
    const isLit = actor.id === state.lit;
    const sees = isSeen(actor, frame, picture.number);
    if (now === null || actor.id === picture.agent.actor) continue;
    if (actor.role !== "pair" && !isLit && !sees) continue;
    const corners = cornersInCamera(camera.poses[frame], actor, now);
    const edges = edgesInPicture(camera, corners);
    if (!edges.length) continue;
    const pixels = edges.flat();
    const distance = corners.reduce((sum, corner) => sum + corner[2], 0);
    picture.places.push({ actor, place: extentOf(pixels), distance });
    const parts = boxParts(actor, camera, corners, edges, { isLarge, isSeen: sees, isLit });
    if (isLit || actor.role === "pair" || (isLarge && actor.tag)) {
      parts.push(...tagParts(actor, pixels, camera, ratio, occupied));
    }
    groups.push(drawn("g", { "data-actor": actor.id, class: isLit ? "lit" : "" }, ...parts));
  }
  return groups;
}

/**
 * Make a box's edges with a casing and, if the agent sees the actor, its front.
 * @param {Actor} actor
 * @param {Camera} camera
 * @param {Vector[]} corners
 * @param {[Pixel, Pixel][]} edges
 * @param {BoxStyle} style
 * @returns {SVGElement[]}
 */
function boxParts(actor, camera, corners, edges, style) {
  const path = { d: edges.map(pathOf).join(""), fill: "none", "vector-effect": "non-scaling-stroke" };
  const thick = (actor.role === "other" ? 1.2 : 2) * (style.isLarge ? 1 : 0.75);
  /** @type {Record<string, string | number>} */
  const casing = style.isLit
    ? { stroke: INK, "stroke-width": thick + 4 }
    : { stroke: "#ffffff", "stroke-width": thick + 1.5, "stroke-opacity": 0.5 };
  const line = { stroke: actor.color, "stroke-width": thick, "stroke-dasharray": style.isSeen ? "none" : "4 3" };
  const parts = [drawn("path", { ...path, ...casing }), drawn("path", { ...path, ...line })];
  const front = corners.slice(0, 4);
  if (style.isSeen && front.every(isAhead)) {
    const face = pathOf(front.map((corner) => pixelOf(camera, corner)));
    parts.push(drawn("path", { d: `${face}Z`, fill: actor.color, "fill-opacity": 0.25 }));
  }
  return parts;
}

/**
 * Make a tag above a box: the letters of the agent that the actor is, or its id; its title if it is highlighted.
 * @param {Actor} actor
 * @param {Pixel[]} pixels of the box
 * @param {Camera} camera
 * @param {number} ratio the image's pixels by the page's
 * @param {Rectangle[]} occupied by other tags; this one is added
 * @returns {SVGElement[]}
 */
function tagParts(actor, pixels, camera, ratio, occupied) {
  const words = actor.id === state.lit ? actor.title : actor.tag || String(actor.id);
  const [wide, tall] = [(words.length * 7 + 6) * ratio, 14 * ratio];
  const rectangle = placeAbove(pixels, [wide, tall], occupied, [camera.lens[0], camera.lens[1]], ratio);
  occupied.push(rectangle);
  const [x, y] = rectangle;
  const frame = { fill: "#ffffff", "fill-opacity": 0.9, stroke: actor.color, "vector-effect": "non-scaling-stroke" };
  const text = { "text-anchor": "middle", "font-size": 11 * ratio, "font-weight": 600, fill: INK };
  return [
    drawn("rect", { x, y, width: wide, height: tall, rx: 2 * ratio, "stroke-width": 1.5, ...frame }),
    drawn("text", { x: x + wide / 2, y: y + tall * 0.8, ...text }, words),
  ];
}
