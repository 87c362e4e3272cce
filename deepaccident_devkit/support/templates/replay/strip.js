// The strip below the slider, on its scale: the pair's speeds, gap and time to collision, who sees it, and verdicts.
// Below the slider itself: which frames have files. A click on the strip goes to a frame.

import { isSeen, seersOf } from "./actors.js";
import { frameAtShare, shareOf } from "./clock.js";
import { barExtent, curvePath, known, runs } from "./curves.js";
import { data, last, pair } from "./data.js";
import { byId, drawn, made } from "./elements.js";
import { step } from "./playback.js";
import { state } from "./state.js";

/** @import { Actor, Sample } from "./types.js" */

const CURVE = 20; // pixels of a curve's height
const BAND = 3; // pixels of an agent's line
const LONGEST_GAP = 900; // metres
const LONGEST_TIME = 6; // seconds: the curve has no longer time to collision

const strip = byId("strip");

/**
 * @param {number} height
 * @param {SVGElement[]} children
 */
function plot(height, ...children) {
  const box = { viewBox: `0 0 ${Math.max(last, 1)} ${height}`, height, preserveAspectRatio: "none" };
  return drawn("svg", { ...box, "aria-hidden": "true" }, ...children);
}

/**
 * @param {(number | null)[]} values
 * @param {number} maximum
 * @param {string} color
 * @param {boolean} isDashed
 */
function curve(values, maximum, color, isDashed) {
  return drawn("path", {
    d: curvePath(values, maximum, CURVE),
    fill: "none",
    stroke: color,
    "stroke-width": 2,
    "vector-effect": "non-scaling-stroke",
    "stroke-dasharray": isDashed ? "5 3" : "none",
  });
}

/**
 * Draw a bar from frame to frame.
 * @param {[from: number, to: number]} frames
 * @param {number} y
 * @param {number} height
 * @param {string} color
 */
function bar([from, to], y, height, color) {
  return drawn("rect", { ...barExtent(from, to, last), y, height, fill: color });
}

/**
 * Draw bars at the frames where a condition holds.
 * @param {(frame: number) => boolean} holds
 * @param {number} y
 * @param {number} height
 * @param {string} color
 */
function bars(holds, y, height, color) {
  return runs(last, holds).map((frames) => bar(frames, y, height, color));
}

/**
 * A row of the strip: where it says something, and what it says of a frame.
 * @typedef {{ text: HTMLElement, textOf: (frame: number) => string }} Row
 */

/**
 * Add a row.
 * @param {string} name
 * @param {SVGElement} picture
 * @param {(frame: number) => string} textOf
 * @returns {Row}
 */
function addRow(name, picture, textOf) {
  const text = made("span", { className: "told" });
  strip.append(
    made("span", { className: "row", textContent: name }),
    made("div", { className: "plot" }, picture),
    text,
  );
  return { text, textOf };
}

/**
 * Return the colour of the agent that an actor is: red would be both of the pair.
 * @param {Actor} actor
 */
function colorOf(actor) {
  return data.agents.find((agent) => agent.actor === actor.id)?.color ?? "currentColor";
}

function addSpeeds() {
  const speeds = pair.map((actor) => actor.states.map((now) => now && now[3]));
  const maximum = Math.max(1, ...speeds.flatMap(known));
  const lines = speeds.map((values, number) => curve(values, maximum, colorOf(pair[number]), number === 1));
  const valueText = (/** @type {number | null} */ value) => (value === null ? "–" : (value / 10).toFixed(1));
  return addRow("speeds", plot(CURVE, ...lines), (frame) => {
    return `${speeds.map((values) => valueText(values[frame])).join(" and ")} m/s`;
  });
}

/**
 * @param {string} name
 * @param {(number | null)[]} values
 * @param {string} unit
 * @param {number} scale values of a unit
 * @param {number} limit the largest value that the curve has
 */
function addMeasure(name, values, unit, scale, limit) {
  const maximum = Math.min(limit * scale, Math.max(1, ...known(values)));
  const shown = values.map((value) => (value !== null && value > limit * scale ? null : value));
  return addRow(name, plot(CURVE, curve(shown, maximum, "currentColor", false)), (frame) => {
    const value = values[frame];
    return value === null ? "–" : `${(value / scale).toFixed(1)} ${unit}`;
  });
}

/** @param {Actor} actor */
function addSight(actor) {
  const lines = data.agents.flatMap((agent, number) => {
    if (agent.actor === actor.id) return [];
    return bars((frame) => isSeen(actor, frame, number), number * BAND, BAND - 0.8, agent.color);
  });
  const name = `${actor.tag || actor.id} seen by`;
  return addRow(name, plot(BAND * data.agents.length, ...lines), (frame) => {
    return seersOf(actor, frame, data.agents).map((agent) => agent.short).join(" ") || "nobody";
  });
}

/** @param {Sample[]} samples */
function addVerdicts(samples) {
  const lines = samples.map((sample) =>
    bar([sample.frame, sample.frame], sample.agent * BAND, BAND - 0.8, sample.color),
  );
  return addRow("verdicts", plot(BAND * data.agents.length, ...lines), () => {
    const judged = state.foreseen.filter((sample) => sample.verdict);
    const words = judged.map((sample) => `${data.agents[sample.agent].short} ${sample.verdict}`);
    return state.foreseen.length ? words.join(", ") : "none yet";
  });
}

/**
 * Add the alarms of the samples: the higher the score, the darker the bar; red where they fire.
 * @param {Sample[]} samples
 */
function addAlarms(samples) {
  const lines = samples.flatMap((sample) => {
    if (!sample.alarm) return [];
    const line = bar([sample.frame, sample.frame], sample.agent * BAND, BAND - 0.8, sample.color);
    line.setAttribute("fill-opacity", String(0.2 + 0.8 * sample.alarm.score));
    return [line];
  });
  return addRow("alarm", plot(BAND * data.agents.length, ...lines), () => {
    const words = state.foreseen.map((sample) => `${data.agents[sample.agent].short} ${sample.alarm?.score.toFixed(2) ?? "–"}`);
    return words.join(", ") || "none yet";
  });
}

/**
 * Mark when the places of one label happen, such as the contacts that plans run into.
 * @param {string} label
 * @param {Sample[]} samples
 */
function addTimes(label, samples) {
  const lines = samples.flatMap((sample) =>
    sample.places.flatMap((place) => {
      const frame = sample.frame + Math.round(place.time / data.period);
      if (place.label !== label || frame > last) return [];
      return [bar([frame, frame], sample.agent * BAND, BAND - 0.8, place.color)];
    }),
  );
  return addRow(label, plot(BAND * data.agents.length, ...lines), () => {
    const words = state.foreseen.flatMap((sample) =>
      sample.places
        .filter((place) => place.label === label)
        .map((place) => `${data.agents[sample.agent].short} in ${place.time.toFixed(1)} s`),
    );
    return words.join(", ") || "–";
  });
}

/** @type {Row[]} */
const rows = [];
if (pair.length) rows.push(addSpeeds());
if (data.pair) {
  rows.push(addMeasure("gap", data.pair.gap, "m", 100, LONGEST_GAP));
  rows.push(addMeasure("time to collision", data.pair.ttc, "s", 10, LONGEST_TIME));
}
for (const actor of pair) rows.push(addSight(actor));
if (data.prediction) {
  const { samples } = data.prediction;
  rows.push(addVerdicts(samples));
  if (samples.some((sample) => sample.alarm)) rows.push(addAlarms(samples));
  const labels = samples.flatMap((sample) => sample.places.map((place) => place.label));
  rows.push(...[...new Set(labels)].map((label) => addTimes(label, samples)));
}

/** Show what the strip says of the frame. */
export function showStrip() {
  strip.style.setProperty("--now", String(shareOf(state.frame, last)));
  for (const { text, textOf } of rows) text.textContent = textOf(state.frame);
}

let isHeld = false;

/** @param {PointerEvent} event */
function goIn(event) {
  const target = event.target instanceof Element && event.target.closest(".plot");
  if (!target) return;
  const box = target.getBoundingClientRect();
  step(frameAtShare((event.clientX - box.left) / box.width, last) - state.frame);
}

strip.addEventListener("pointerdown", (event) => {
  isHeld = true;
  goIn(event);
});
strip.addEventListener("pointermove", (event) => {
  if (isHeld) goIn(event);
});
addEventListener("pointerup", () => {
  isHeld = false;
});

const more = byId("more");

/** @param {boolean} isOpen */
function open(isOpen) {
  strip.hidden = !isOpen;
  more.setAttribute("aria-expanded", String(isOpen));
}

more.hidden = !rows.length;
more.addEventListener("click", () => open(Boolean(strip.hidden)));
open(rows.length > 0 && innerWidth >= 840 && innerHeight >= 700);

// the frames whose sensor files are there, paler where some of them are missing

if (data.files.some((count) => count < data.sensors)) {
  const height = 4;
  const all = bars((frame) => data.files[frame] === data.sensors, 0, height, "currentColor");
  const isPart = (/** @type {number} */ count) => count > 0 && count < data.sensors;
  const some = bars((frame) => isPart(data.files[frame]), 0, height, "currentColor");
  for (const mark of some) mark.setAttribute("fill-opacity", "0.5");
  byId("files").append(plot(height, ...all, ...some));
  byId("files").hidden = false;
  byId("files-key").hidden = false;
}
