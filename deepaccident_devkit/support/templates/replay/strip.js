// The strip below the slider, on its scale: the pair's speeds, gap and time to collision, who sees it, verdicts; and
// which frames have files. A click goes there.

const ROW = 20; // pixels of a curve's height
const BAND = 3; // pixels of an agent's line
const LONGEST = 6; // seconds: the curve has no longer time to collision
const strip = byId("strip");

const known = (values) => values.filter((each) => each !== null);
const svg = (height, ...children) => {
  const looks = { viewBox: `0 0 ${Math.max(last, 1)} ${height}`, height, preserveAspectRatio: "none" };
  return drawn("svg", { ...looks, "aria-hidden": "true" }, ...children);
};

/** A curve of values, one a frame, between 0 and `most`; it has gaps where they are not known. */
function curve(values, most, color, dashed) {
  let path = "";
  values.forEach((value, frame) => {
    if (value === null) return;
    const isFirst = frame === 0 || values[frame - 1] === null;
    path += `${isFirst ? "M" : "L"}${frame} ${(ROW - 1.5 - (Math.min(value, most) / most) * (ROW - 3)).toFixed(1)}`;
  });
  const line = { d: path, fill: "none", stroke: color, "stroke-width": 2, "vector-effect": "non-scaling-stroke" };
  return drawn("path", { ...line, "stroke-dasharray": dashed ? "5 3" : "none" });
}

/** A bar from frame to frame, half a frame beyond both where the strip goes on. */
function bar(from, to, y, height, color) {
  const [left, right] = [Math.max(0, from - 0.5), Math.min(Math.max(last, 1), to + 0.5)];
  return drawn("rect", { x: left, y, width: right - left, height, fill: color });
}

/** Bars where a condition holds. */
function bars(holds, y, height, color) {
  const found = [];
  for (let frame = 0; frame <= last; frame += 1) {
    if (!holds(frame)) continue;
    const from = frame;
    while (frame < last && holds(frame + 1)) frame += 1;
    found.push(bar(from, frame, y, height, color));
  }
  return found;
}

/** A row: its name, its picture, and what it says of a frame. */
function stripRow(name, picture, words) {
  const told = made("span", { className: "told" });
  const plot = made("div", { className: "plot" }, picture);
  strip.append(made("span", { className: "row", textContent: name }), plot, told);
  return { plot, told, words };
}

// The pair's own hues: red would be both.
const hueOf = (actor) => (data.agents.find((agent) => agent.actor === actor.id) || { color: "currentColor" }).color;

function speedRow() {
  const speeds = pair.map((actor) => actor.states.map((now) => now && now[3]));
  const most = Math.max(1, ...speeds.flatMap(known));
  const lines = speeds.map((values, number) => curve(values, most, hueOf(pair[number]), number === 1));
  const told = (value) => (value === null ? "–" : (value / 10).toFixed(1));
  const words = (frame) => `${speeds.map((each) => told(each[frame])).join(" and ")} m/s`;
  return stripRow("speeds", svg(ROW, ...lines), words);
}

function measureRow(name, values, unit, scale, limit) {
  const most = Math.min(limit * scale, Math.max(1, ...known(values)));
  const told = (frame) => (values[frame] === null ? "–" : `${(values[frame] / scale).toFixed(1)} ${unit}`);
  const shown = values.map((each) => (each !== null && each > limit * scale ? null : each));
  return stripRow(name, svg(ROW, curve(shown, most, "currentColor", false)), told);
}

function sightRow(actor) {
  const lines = data.agents.flatMap((agent, bit) => {
    const own = agent.actor === actor.id;
    return own ? [] : bars((frame) => actor.seen[frame] & (1 << bit), bit * BAND, BAND - 0.8, agent.color);
  });
  const seeing = (frame) => data.agents.filter((_, bit) => actor.seen[frame] & (1 << bit));
  const told = (frame) => seeing(frame).map((agent) => agent.short).join(" ") || "nobody";
  return stripRow(`${actor.tag || actor.id} seen by`, svg(BAND * data.agents.length, ...lines), told);
}

function verdictRow() {
  const lines = data.prediction.samples.map((sample) =>
    bar(sample.frame, sample.frame, sample.agent * BAND, BAND - 0.8, verdictColor(sample.verdict)),
  );
  const told = () => {
    const words = state.foreseen.map((sample) => `${data.agents[sample.agent].short} ${sample.verdict}`);
    return words.join(", ") || "none yet";
  };
  return stripRow("verdicts", svg(BAND * data.agents.length, ...lines), told);
}

const stripRows = [
  ...(pair.length ? [speedRow()] : []),
  ...(data.pair ? [measureRow("gap", data.pair.gap, "m", 100, FARTHEST)] : []),
  ...(data.pair ? [measureRow("time to collision", data.pair.ttc, "s", 10, LONGEST)] : []),
  ...pair.map(sightRow),
  ...(data.prediction ? [verdictRow()] : []),
];

function showStrip() {
  strip.style.setProperty("--now", String(state.frame / Math.max(last, 1)));
  for (const { told, words } of stripRows) told.textContent = words(state.frame);
}

let isHeld = false;
function goIn(event) {
  const plot = event.target.closest(".plot");
  if (!plot) return;
  const box = plot.getBoundingClientRect();
  step(Math.round(((event.clientX - box.left) / box.width) * last) - state.frame);
}
strip.addEventListener("pointerdown", (event) => {
  isHeld = true;
  goIn(event);
});
strip.addEventListener("pointermove", (event) => isHeld && goIn(event));
addEventListener("pointerup", () => {
  isHeld = false;
});

const more = byId("more");
function openStrip(isOpen) {
  strip.hidden = !isOpen;
  more.setAttribute("aria-expanded", String(isOpen));
}
more.hidden = !stripRows.length;
more.addEventListener("click", () => openStrip(strip.hidden));
openStrip(stripRows.length > 0 && innerWidth >= 840 && innerHeight >= 700);

// Below the slider: the frames whose sensor files are there, paler where some of them are missing.
if (data.files.some((each) => each < data.sensors)) {
  const height = 4;
  const there = bars((frame) => data.files[frame] === data.sensors, 0, height, "currentColor");
  const some = bars((frame) => data.files[frame] > 0 && data.files[frame] < data.sensors, 0, height, "currentColor");
  for (const each of some) each.setAttribute("fill-opacity", "0.5");
  byId("files").append(svg(height, ...there, ...some));
  byId("files").hidden = false;
  byId("files-key").hidden = false;
}
