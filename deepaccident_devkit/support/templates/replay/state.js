// What the reader has chosen to see.

import { data, pair, sources } from "./data.js";

/** @import { PageState } from "./types.js" */

/** @type {PageState} */
export const state = {
  frame: 0,
  playing: false,
  speed: 1,
  follow: pair.length ? "pair" : "",
  sight: "",
  large: "",
  boxes: true,
  layers: { road: true, trails: true, dots: true, ids: false, agents: true, points: false, prediction: true },
  clouds: sources.withPoints,
  pointsBy: "agent",
  scene: "both",
  pointed: null,
  chosen: null,
  lit: null,
  foreseen: [],
  held: false,
  sharpness: 1,
};

/** Return the actor that all views highlight, if there is one. */
export function litActor() {
  return data.actors.find((actor) => actor.id === state.lit);
}
