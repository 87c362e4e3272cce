// The page of a replay: what is drawn when, what does not change with time, and what the pages around may ask for.

import { showCameras, showEveryCamera } from "./cameras.js";
import { shareOf } from "./clock.js";
import { stay } from "./controls.js";
import { data, last, pair } from "./data.js";
import { byId, chip, made } from "./elements.js";
import { map } from "./map.js";
import { shapeOf } from "./map_view.js";
import { go, showTime } from "./playback.js";
import { addView, show } from "./refresh.js";
import { showLit, showSeen } from "./seen.js";
import { space } from "./space.js";
import { showStrip } from "./strip.js";
import { samplesAt, showForeseen } from "./verdicts.js";

addView(showForeseen, "moment");
addView(showTime, "moment");
addView(showCameras, "moment", "actor");
addView(showEveryCamera, "moment", "actor");
addView(showSeen, "moment");
addView(showLit, "moment", "actor");
addView(showStrip, "moment");
addView(() => map.draw(), "moment", "actor", "points");
addView(() => space.draw(), "moment", "actor", "points");

const resized = new ResizeObserver(show);
resized.observe(map.canvas);
resized.observe(space.canvas);

// what does not change with time

document.documentElement.style.setProperty("--alarm", data.colors.pair);
byId("scenario").textContent = data.scenario;
for (const [name, value] of data.facts) {
  byId("facts").append(made("dt", { textContent: name }), made("dd", { textContent: value }));
}
byId("notes").append(...data.notes.map((note) => made("li", { textContent: note })));
byId("foreseen-key").hidden = !data.prediction || !data.prediction.samples.some((sample) => sample.places.length);

const others = data.actors.filter((actor) => actor.role === "other");
const categories = new Map(
  others.map((actor) => [actor.category, chip(actor.color, shapeOf(actor, data.markers))]),
);
byId("legend").append(
  ...(pair.length ? [made("span", {}, chip(data.colors.pair), "colliding pair")] : []),
  ...data.agents.map((agent) => made("span", {}, chip(agent.color), `${agent.short} ${agent.title}`)),
  ...[...categories].map(([name, mark]) => made("span", {}, mark, name)),
  ...(data.prediction?.legend ?? []).map(([label, color]) => made("span", {}, chip(color), label)),
);

/**
 * Mark a frame above the slider.
 * @param {number} frame
 * @param {string} color
 */
function addMark(frame, color) {
  const mark = made("span", {});
  mark.style.left = `${100 * shareOf(frame, last)}%`;
  mark.style.background = color;
  byId("marks").append(mark);
}

for (const [frame, [sample]] of samplesAt) addMark(frame, sample.color);
const impact = data.countdown.indexOf(0);
if (impact >= 0) addMark(impact, data.colors.pair);

// The pages around dispatch these events on the document. `go` has the number of a frame; `look` has the id of a canvas
// and what the numbers of its `data-view` shall be.

document.addEventListener("go", (event) => go(/** @type {CustomEvent<number>} */ (event).detail));
document.addEventListener("look", (event) => {
  const { id, view } = /** @type {CustomEvent<{ id: string, view: number[] }>} */ (event).detail;
  const scene = id === "space" ? space : map;
  stay();
  scene.setView(view);
  scene.draw();
});

show();
