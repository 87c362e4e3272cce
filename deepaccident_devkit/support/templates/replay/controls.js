// The controls of a replay: buttons, menus, the mouse on the scene, and keys.

import { cards, enlarge } from "./cameras.js";
import { addCheckbox, selection } from "./choices.js";
import { agentOptions, data, last, pair, sources } from "./data.js";
import { byId } from "./elements.js";
import { choose, chooseNext, point } from "./lit.js";
import { map } from "./map.js";
import { ZOOM_STEP } from "./map_view.js";
import { play, setSpeed, step } from "./playback.js";
import { onPointers } from "./pointers.js";
import { savePicture } from "./saved_picture.js";
import { space } from "./space.js";
import { state } from "./state.js";

/** @import { Scene } from "./types.js" */

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
/** @type {Record<string, string>} */
const LAYERS = {
  road: "road",
  trails: "trails",
  dots: "who sees",
  agents: "agents",
  ids: "ids",
  points: "LiDAR",
  prediction: "prediction",
};
/** @type {[Scene, string][]} */
const SCENES = [["both", "3D and map"], ["space", "3D"], ["map", "map"]];
/** @type {Record<string, [right: number, up: number]>} by how much an arrow key with shift turns the scene, radians */
const TURNS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };

// time

byId("play").addEventListener("click", () => play(!state.playing));
byId("back").addEventListener("click", () => step(-1));
byId("on").addEventListener("click", () => step(1));
const speeds = SPEEDS.map((speed) => /** @type {[string, string]} */ ([String(speed), `${speed} ×`]));
selection(byId("speed", HTMLSelectElement), speeds, "1", (value) => setSpeed(Number(value)));

// what is shown

const followSelect = byId("follow", HTMLSelectElement);
/** @type {[string, string][]} */
const pairOption = pair.length ? [["pair", "the colliding pair"]] : [];
selection(followSelect, [["", "nobody"], ...pairOption, ...agentOptions], state.follow, (value) => {
  state.follow = value;
});
const sightOptions = /** @type {[string, string][]} */ ([["", "none"], ["all", "all agents"], ...agentOptions]);
selection(byId("sight", HTMLSelectElement), sightOptions, "", (value) => {
  state.sight = value;
});

/**
 * Return whether the release has what a layer shows.
 * @param {string} layer
 */
function hasLayer(layer) {
  if (layer === "points") return sources.withPoints.length > 0;
  if (layer === "road") return data.road !== null;
  return layer !== "prediction" || data.prediction !== null;
}

for (const [layer, title] of Object.entries(LAYERS)) {
  if (!hasLayer(layer)) continue;
  addCheckbox("layers", `layer-${layer}`, title, state.layers[layer], (checked) => {
    state.layers[layer] = checked;
  });
}
if (data.prediction) {
  addCheckbox("layers", "hold", "keep this prediction", state.held, (checked) => {
    state.held = checked;
  });
}
byId("clouds").hidden = sources.withPoints.length < 2;
for (const number of sources.withPoints) {
  const agent = data.agents[number];
  addCheckbox("clouds", `cloud-${agent.name}`, agent.title, true, (checked) => {
    state.clouds = sources.withPoints.filter((index) => (index === number ? checked : state.clouds.includes(index)));
    if (state.scene !== "map") return;
    state.layers.points = true;
    byId("layer-points", HTMLInputElement).checked = true;
  });
}
selection(byId("points-by", HTMLSelectElement), [["agent", "agent"], ["height", "height"]], state.pointsBy, (value) => {
  state.pointsBy = value === "height" ? "height" : "agent";
});

// where the reader looks

/** Follow nobody. */
export function stay() {
  state.follow = "";
  followSelect.value = "";
}

/** @param {number} factor */
function zoomMap(factor) {
  if (state.follow === "pair") stay(); // the pair has a scale of its own
  map.view.zoom(factor);
  map.draw();
}

/** @param {number} factor */
function zoomSpace(factor) {
  space.zoom(factor);
  space.draw();
}

/** @param {number} factor */
function zoom(factor) {
  zoomSpace(factor);
  if (state.scene !== "space") zoomMap(factor);
}

byId("closer").addEventListener("click", () => zoom(ZOOM_STEP));
byId("farther").addEventListener("click", () => zoom(1 / ZOOM_STEP));
byId("top").addEventListener("click", () => space.fromAbove());
byId("save").addEventListener("click", () => void savePicture());
byId("whole").addEventListener("click", () => {
  stay();
  map.showWhole();
  space.setOut();
  map.draw();
  space.draw();
});

onPointers(map.canvas, {
  zoom: zoomMap,
  drag: (right, down) => {
    stay();
    map.view.move(right, down);
    map.draw();
  },
  point: (x, y) => point(map.actorAt(x, y)),
  leave: () => point(null),
  click: (x, y) => choose(map.actorAt(x, y)),
});
onPointers(space.canvas, {
  zoom: zoomSpace,
  drag: (right, down, isMove) => {
    if (isMove) {
      stay();
      space.orbit.move(right, down, space.canvas.clientHeight);
    } else space.orbit.turnBy(right / 150, down / 150);
    space.draw();
  },
  point: (x, y) => point(space.actorAt(x, y)),
  leave: () => point(null),
  click: (x, y) => choose(space.actorAt(x, y)),
});

/** @param {Scene} scene */
function layOut(scene) {
  state.scene = scene;
  byId("space-box").hidden = scene === "map";
  map.canvas.hidden = scene === "space";
  document.querySelector(".above")?.classList.toggle("both", scene === "both");
}

/**
 * Show the map, the scene in three dimensions, or both; only the map where the browser has no WebGL.
 * @param {Scene} scene
 */
function showScene(scene) {
  if (scene === "map") space.end();
  const isWithout = scene !== "map" && space.gpu === null && !space.begin();
  layOut(isWithout ? "map" : scene);
  if (!isWithout) return;
  byId("scene-tools").hidden = true;
  byId("space-key").hidden = true;
}

selection(byId("scene", HTMLSelectElement), SCENES, state.scene, (value) => {
  showScene(SCENES.find(([scene]) => scene === value)?.[0] ?? "both");
});
layOut(state.scene);
addEventListener("pageshow", () => showScene(state.scene)); // after the rest of the page: it takes a moment to begin
addEventListener("pagehide", () => space.end());

// keys

/** @type {Record<string, () => void>} */
const keys = {
  " ": () => play(!state.playing),
  ArrowLeft: () => step(-1),
  ArrowRight: () => step(1),
  Home: () => step(-last),
  End: () => step(last),
  "+": () => zoom(ZOOM_STEP),
  "-": () => zoom(1 / ZOOM_STEP),
  0: () => enlarge(""),
  b: () => byId("boxes").click(),
  t: () => byId("top").click(),
  s: () => byId("save").click(),
  ".": () => chooseNext(1),
  ",": () => chooseNext(-1),
  Escape: () => choose(null),
};
for (const card of cards) keys[String(card.number + 1)] = () => enlarge(String(card.number));

/**
 * Return whether a control that has the focus needs a key itself.
 * @param {KeyboardEvent} event
 */
function isOfControl(event) {
  const control = event.target instanceof Element && event.target.closest("button, select, input");
  if (!control) return false;
  return event.key === " " ? control.id !== "scrubber" : control.matches("select, input");
}

document.addEventListener("keydown", (event) => {
  if (isOfControl(event) || event.ctrlKey || event.metaKey || event.altKey) return;
  const turn = event.shiftKey ? TURNS[event.key] : undefined;
  const act = keys[event.key];
  if (!act && !turn) return;
  event.preventDefault();
  if (turn && space.gpu) {
    space.orbit.turnBy(...turn);
    space.draw();
  } else act?.();
});
