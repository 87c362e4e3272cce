// The tables below the scene: who sees whom, predictions. Text of the data is only set as text, not as HTML.

const data = JSON.parse(document.getElementById("data").textContent);
const last = data.countdown.length - 1;
const pair = data.actors.filter((actor) => actor.role === "pair");
const state = {
  frame: 0,
  playing: false,
  speed: 1,
  follow: pair.length ? "pair" : "",
  sight: "",
  large: "",
  boxes: true,
  layers: { road: true, trails: true, dots: true, ids: false, agents: true, points: false, prediction: true },
  clouds: [],
  pointsBy: "agent",
  scene: "both",
  pointed: null,
  chosen: null,
  lit: null, // the id of the actor that is pointed at or chosen
  foreseen: [],
};
const byId = (name) => document.getElementById(name);
const sources = new Sources(data, () => {
  ground.draw();
  space.draw();
});
state.clouds = sources.withPoints;
const ground = new Ground(byId("ground"), data, state, sources);

function made(name, properties = {}, ...children) {
  const element = Object.assign(document.createElement(name), properties);
  element.append(...children);
  return element;
}

function chip(color, kind = "") {
  const element = made("span", { className: `chip ${kind}`, ariaHidden: "true" });
  element.style.background = color;
  return element;
}

const small = (text, kind = "") => made("p", { className: `small ${kind}`, textContent: text });

// Fill a <select> with [value, text] and call back with what is chosen.
function choice(element, options, chosen, changed) {
  element.append(...options.map(([value, text]) => made("option", { value, textContent: text })));
  element.value = chosen;
  element.addEventListener("change", () => {
    changed(element.value);
    show();
  });
}

// who sees whom

const table = byId("seen");
const headsOf = () =>
  data.agents.map((agent) =>
    made("th", { scope: "col", title: agent.title }, chip(agent.color, "round"), agent.short),
  );
table.append(made("thead", {}, made("tr", {}, made("th", { scope: "col", textContent: "actor" }), ...headsOf())));
const rows = data.actors.map((actor) => {
  const cells = data.agents.map(() => made("td"));
  const row = made("tr", {}, made("th", { scope: "row" }, chip(actor.color), actor.title), ...cells);
  return { actor, row, cells };
});
table.append(made("tbody", {}, ...rows.map((each) => each.row)));

function showSeen() {
  for (const { actor, row, cells } of rows) {
    const there = actor.states[state.frame] !== null;
    row.classList.toggle("absent", !there);
    cells.forEach((cell, bit) => {
      const own = data.agents[bit].actor === actor.id;
      const text = !there ? "" : own ? "self" : actor.seen[state.frame] & (1 << bit) ? "●" : "–";
      if (cell.textContent !== text) cell.textContent = text;
    });
  }
  const sentences = pair
    .filter((actor) => actor.states[state.frame] !== null)
    .map((actor) => `${actor.title}, ${speedOf(actor.states[state.frame])}: ${seenBy(actor)}.`);
  byId("pair").textContent = sentences.join(" ");
}

// predictions

const verdictColors = {
  TP: data.colors.right,
  TN: data.colors.right,
  FN: data.colors.missed,
  "not judged": data.colors.grid,
};
const verdictColor = (verdict) => verdictColors[verdict] || data.colors.false;
const badge = (verdict) => {
  const element = made("span", { className: "badge", textContent: verdict });
  element.style.borderColor = verdictColor(verdict);
  return element;
};
const samplesAt = new Map();
if (data.prediction) {
  byId("verdict").hidden = false;
  byId("rule").textContent = data.prediction.rule;
  for (const sample of data.prediction.samples) {
    samplesAt.set(sample.frame, [...(samplesAt.get(sample.frame) || []), sample]);
  }
  const body = [...samplesAt].map(([frame, samples]) => {
    const number = String(frame + 1);
    const jump = made("button", { type: "button", textContent: number, ariaLabel: `Go to frame ${number}` });
    jump.addEventListener("click", () => go(frame));
    const cells = data.agents.map((_, bit) => {
      const sample = samples.find((each) => each.agent === bit);
      return made("td", {}, sample ? badge(sample.verdict) : "");
    });
    const row = made("tr", {}, made("th", { scope: "row" }, jump), ...cells);
    row.dataset.frame = String(frame);
    return row;
  });
  const heading = made("tr", {}, made("th", { scope: "col", textContent: "frame" }), ...headsOf());
  byId("samples").append(made("table", {}, made("thead", {}, heading), made("tbody", {}, ...body)));
}

// Between evaluated samples the last one before stays.
function showForeseen() {
  if (!data.prediction) return;
  const frames = [...samplesAt.keys()].filter((frame) => frame <= state.frame);
  const frame = frames.length ? Math.max(...frames) : null;
  state.foreseen = frame === null ? [] : samplesAt.get(frame);
  const lines = state.foreseen.flatMap((sample) => [
    made("p", {}, badge(sample.verdict), sample.text),
    ...sample.alarms.map((alarm) => small(alarm.text, alarm.right ? "right" : "")),
    ...(sample.more ? [small(`and ${sample.more} more, less sure`)] : []),
  ]);
  byId("foreseen").replaceChildren(...(lines.length ? lines : [small("Nothing was evaluated yet.")]));
  for (const row of byId("samples").querySelectorAll("tbody tr")) {
    row.className = row.dataset.frame === String(frame) ? "now" : "";
  }
}
