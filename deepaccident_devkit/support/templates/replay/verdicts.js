// What a model predicts, and what its predictions count as.

import { lastBefore, samplesByFrame } from "./actors.js";
import { data } from "./data.js";
import { badge, byId, made, smallText } from "./elements.js";
import { go } from "./playback.js";
import { agentHeadings } from "./seen.js";
import { state } from "./state.js";

/** @import { Sample } from "./types.js" */

/** The samples of each evaluated frame. */
export const samplesAt = samplesByFrame(data.prediction?.samples ?? []);

/** @param {Sample} sample */
export function verdictBadge(sample) {
  return badge(sample.verdict, sample.color);
}

/**
 * Make the row of a frame in the table of all verdicts.
 * @param {number} frame
 * @param {Sample[]} samples
 */
function verdictRow(frame, samples) {
  const number = String(frame + 1);
  const jump = made("button", { type: "button", textContent: number, ariaLabel: `Go to frame ${number}` });
  jump.addEventListener("click", () => go(frame));
  const cells = data.agents.map((_, agent) => {
    const sample = samples.find((candidate) => candidate.agent === agent);
    return made("td", {}, sample?.verdict ? verdictBadge(sample) : "");
  });
  const row = made("tr", {}, made("th", { scope: "row" }, jump), ...cells);
  row.dataset.frame = String(frame);
  return row;
}

if (data.prediction) {
  byId("verdict").hidden = false;
  byId("rule").textContent = data.prediction.rule;
  const heading = made("tr", {}, made("th", { scope: "col", textContent: "frame" }), ...agentHeadings());
  const body = [...samplesAt].map(([frame, samples]) => verdictRow(frame, samples));
  byId("samples").append(made("table", {}, made("thead", {}, heading), made("tbody", {}, ...body)));
}

function nothingYet() {
  const [first] = [...samplesAt.keys()].sort((one, other) => one - other);
  return `No prediction yet${first === undefined ? "" : ` (first at frame ${first + 1})`}.`;
}

/** Show what was predicted at the last evaluated frame or, if the reader keeps it, at an earlier one. */
export function showForeseen() {
  if (!data.prediction) return;
  const [kept] = state.held ? state.foreseen : [];
  const frame = kept?.frame ?? lastBefore(samplesAt.keys(), state.frame);
  state.foreseen = frame === null ? [] : samplesAt.get(frame) ?? [];
  const lines = state.foreseen.flatMap((sample) => [
    made("p", {}, ...(sample.verdict ? [verdictBadge(sample)] : []), sample.text),
    ...(sample.more ? [smallText(`and ${sample.more} more with lower scores`)] : []),
  ]);
  byId("foreseen").replaceChildren(...(lines.length ? lines : [smallText(nothingYet())]));
  for (const row of byId("samples").querySelectorAll("tr")) {
    if (row.dataset.frame) row.className = row.dataset.frame === String(frame) ? "now" : "";
  }
}
