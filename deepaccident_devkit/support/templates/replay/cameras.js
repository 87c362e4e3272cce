// The agents' cameras: one large picture and small ones, and on demand all of them.

import { isSeen } from "./actors.js";
import { selection } from "./choices.js";
import { agentOptions, data, sources } from "./data.js";
import { byId, chip, drawn, made } from "./elements.js";
import { lightIn } from "./lit.js";
import { drawOver } from "./picture_boxes.js";
import { hasPictures, isOutdated, pictureFrame, pictureTitle } from "./pictures.js";
import { show } from "./refresh.js";
import { state } from "./state.js";
import { verdictBadge } from "./verdicts.js";

/** @import { AgentPicture } from "./picture_boxes.js" */
/** @import { Agent, Camera } from "./types.js" */

/**
 * What of a picture does not depend on whether its camera changes.
 * @typedef {AgentPicture & {
 *   image: HTMLImageElement, where: HTMLElement, none: HTMLElement,
 *   camera: Camera | null, frame: number, source: string }} LoadedPicture
 */

/**
 * An agent's picture of the camera that the reader chose (its title), or of the one that shows the pair best.
 * @typedef {LoadedPicture & {
 *   available: Camera[], chosen: string, judged: HTMLElement, select: HTMLSelectElement, sees: HTMLElement }} Card
 */

/** @typedef {LoadedPicture & { shown: Camera, isThere: boolean }} CameraPicture */

/**
 * Make the picture of a camera, without anything in it.
 * @param {Agent} agent
 * @param {number} number of the agent
 * @param {string} absence what stands in place of a picture
 * @returns {LoadedPicture}
 */
function emptyPicture(agent, number, absence) {
  const image = made("img", { alt: "" });
  image.addEventListener("error", () => image.classList.add("broken"));
  image.addEventListener("load", () => image.classList.remove("broken"));
  return {
    agent,
    number,
    image,
    boxes: drawn("svg", { class: "boxes", preserveAspectRatio: "none", "aria-hidden": "true" }),
    none: made("span", { className: "none", textContent: absence }),
    where: made("span", { className: "where" }),
    figure: made("figure", { className: "agent" }),
    size: [0, 0],
    places: [],
    camera: null,
    frame: 0,
    source: "",
  };
}

// the agents' pictures

/** @type {Card[]} */
export const cards = data.agents.map((agent, number) => {
  const picture = emptyPicture(agent, number, "no pictures");
  const { image, boxes, where, none, figure } = picture;
  const available = data.cameras[number].filter(hasPictures);
  const judged = made("span", { className: "judged" });
  const button = made("button", { type: "button", className: "pictured" }, image, boxes, where, judged, none);
  button.style.borderColor = agent.color;
  button.ariaLabel = `Large picture of ${agent.title}`;
  const title = made("span", { className: "name" }, chip(agent.color, "round"), agent.title);
  const select = made("select", { ariaLabel: `Camera of ${agent.title}`, hidden: available.length < 2 });
  const sees = made("p", {});
  figure.dataset.agent = agent.name;
  figure.append(title, button, select, sees);
  byId("cards").append(figure);
  const card = Object.assign(picture, { available, chosen: "", judged, select, sees });
  const options = available.map((camera) => /** @type {[string, string]} */ ([camera.title, camera.title]));
  selection(select, [["", "automatic"], ...options], "", (value) => {
    card.chosen = value;
  });
  lightIn(card, button, () => enlarge(String(number)));
  return card;
});

const largeSelect = byId("large", HTMLSelectElement);
selection(largeSelect, [["", "automatic"], ...agentOptions], "", (value) => {
  state.large = value;
});

/**
 * Show the large picture of an agent.
 * @param {string} number of the agent; empty for automatic
 */
export function enlarge(number) {
  state.large = number;
  largeSelect.value = number;
  show();
}

const boxesControl = byId("boxes", HTMLInputElement);
boxesControl.addEventListener("change", () => {
  state.boxes = boxesControl.checked;
  show();
});

/**
 * Return the camera that a card shows; undefined if the agent has none with pictures.
 * @param {Card} card
 * @returns {Camera | undefined}
 */
export function cameraOf(card) {
  const title = card.chosen || data.automatic.cameras[card.number][state.frame];
  return card.available.find((camera) => camera.title === title) ?? card.available[0];
}

/** Show the pictures of the frame. */
export function showCameras() {
  const large = state.large === "" ? data.automatic.agents[state.frame] : Number(state.large);
  for (const card of cards) card.figure.classList.toggle("large", card.number === large);
  for (const card of cards) showCamera(card);
}

/** @param {Card} card */
function showCamera(card) {
  const camera = cameraOf(card);
  card.none.hidden = Boolean(camera);
  card.image.hidden = !camera;
  card.boxes.replaceChildren();
  card.places = [];
  if (camera) {
    const frame = load(card, camera, card.figure.classList.contains("large"));
    describe(card, camera, frame);
    card.select.options[0].textContent = card.chosen ? "automatic" : `auto: ${camera.title}`;
    drawOver(card, camera, frame);
  }
  const sample = state.foreseen.find((candidate) => candidate.agent === card.number);
  card.judged.replaceChildren(...(sample?.verdict ? [verdictBadge(sample)] : []));
  card.sees.textContent = sightText(card);
}

/**
 * Load a camera's picture, and return its frame. While the recording plays, the next picture is only asked for when the
 * server has given this one.
 * @param {LoadedPicture} picture
 * @param {Camera} camera
 * @param {boolean} isLarge
 */
function load(picture, camera, isLarge) {
  const frame = pictureFrame(camera, state.frame);
  const source = sources.picture(picture.agent, camera, frame, isLarge);
  if (source !== picture.source) {
    if (state.playing && picture.camera === camera && !picture.image.complete) return picture.frame;
    Object.assign(picture, { source, camera, frame });
    picture.image.src = source;
  }
  return picture.frame;
}

/**
 * Say which camera and moment a picture is of, and veil one that is outdated.
 * @param {LoadedPicture} picture
 * @param {Camera} camera
 * @param {number} frame of the picture
 */
function describe(picture, camera, frame) {
  picture.image.alt = pictureText(picture.agent, camera, frame);
  picture.where.textContent = pictureTitle(camera, state.frame, frame, data.period);
  picture.where.classList.toggle("earlier", frame !== state.frame);
  picture.figure.classList.toggle("veiled", isOutdated(camera, state.frame, data.period, Boolean(data.served)));
}

/**
 * @param {Agent} agent
 * @param {Camera} camera
 * @param {number} frame
 */
function pictureText(agent, camera, frame) {
  return `${agent.title}, camera ${camera.title}, frame ${frame + 1}`;
}

/**
 * Say how many actors an agent sees and, below the large picture, which of the pair it does not.
 * @param {Card} card
 */
function sightText(card) {
  const others = data.actors.filter((actor) => actor.states[state.frame] && actor.id !== card.agent.actor);
  if (!others.length) return "";
  const seen = others.filter((actor) => isSeen(actor, state.frame, card.number));
  const hidden = others.filter((actor) => actor.role === "pair" && !seen.includes(actor));
  const isNamed = hidden.length > 0 && card.figure.classList.contains("large");
  const names = isNamed ? `, not ${hidden.map((actor) => actor.title).join(", ")}` : "";
  return `sees ${seen.length} of ${others.length}${names}`;
}

// all cameras

/** @type {CameraPicture[]} */
const everyCamera = [];

function makeEveryCamera() {
  for (const [number, agent] of data.agents.entries()) {
    const row = made("div", { className: "cards" });
    byId("every-camera").append(made("h3", {}, chip(agent.color, "round"), agent.title), row);
    for (const camera of data.cameras[number]) {
      const isThere = hasPictures(camera);
      const picture = emptyPicture(agent, number, "not downloaded");
      const { image, boxes, where, none, figure } = picture;
      image.hidden = !isThere;
      none.hidden = isThere;
      const pictured = made("div", { className: "pictured" }, image, boxes, where, none);
      pictured.style.borderColor = agent.color;
      figure.append(pictured);
      row.append(figure);
      lightIn(picture, pictured, () => {});
      everyCamera.push(Object.assign(picture, { shown: camera, isThere }));
    }
  }
}

const every = byId("every", HTMLDetailsElement);
every.hidden = data.cameras.every((cameras) => !cameras.length);
every.addEventListener("toggle", show);

/** Show the pictures of all cameras; only while the reader has opened them. */
export function showEveryCamera() {
  if (!every.open) return;
  if (!everyCamera.length) makeEveryCamera();
  for (const picture of everyCamera) {
    const camera = picture.shown;
    const frame = picture.isThere ? load(picture, camera, false) : state.frame;
    if (picture.isThere) describe(picture, camera, frame);
    else {
      picture.image.alt = pictureText(picture.agent, camera, frame);
      picture.where.textContent = camera.title;
    }
    drawOver(picture, camera, frame);
  }
}
