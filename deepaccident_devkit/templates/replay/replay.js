// Time and controls: `show` brings the whole page up to the frame of the state.

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];
const LAYERS = {
  road: "road",
  trails: "trails",
  dots: "who sees",
  agents: "agents",
  ids: "ids",
  points: "LiDAR",
  prediction: "prediction",
};

// time

const scrubber = byId("scrubber");
scrubber.max = String(last);

function countdownText(left) {
  if (left === null) return "no impact";
  return left === 0 ? "0.0 s – impact" : `${left.toFixed(1)} s to impact`;
}

function showTime() {
  const left = data.countdown[state.frame];
  const seconds = (state.frame * data.period).toFixed(1);
  scrubber.value = String(state.frame);
  scrubber.setAttribute("aria-valuetext", `frame ${state.frame + 1}, ${seconds} seconds`);
  byId("time").textContent = `${seconds} s, frame ${state.frame + 1} / ${last + 1}`;
  byId("countdown").textContent = countdownText(left);
  document.body.classList.toggle("impact", left === 0);
  byId("announcement").textContent = left === 0 ? "Impact" : "";
  byId("play").textContent = state.playing ? "Pause" : "Play";
  byId("play").setAttribute("aria-pressed", String(state.playing));
}

function show() {
  showForeseen();
  showTime();
  showCameras();
  showEvery();
  showSeen();
  ground.draw();
  document.dispatchEvent(new Event("moment")); // for the pages around
}

function go(frame) {
  state.frame = Math.min(last, Math.max(0, frame));
  show();
}

let begun = null;
function tick(now) {
  if (!state.playing) return;
  if (begun === null) begun = { now, frame: state.frame };
  const frame = begun.frame + Math.floor(((now - begun.now) / 1000 / data.period) * state.speed + 1e-6);
  if (frame >= last) state.playing = false;
  if (frame !== state.frame || !state.playing) go(frame);
  requestAnimationFrame(tick);
}

function play(playing) {
  state.playing = playing;
  begun = null;
  if (playing && state.frame === last) state.frame = 0;
  show();
  if (playing) requestAnimationFrame(tick);
}

function step(frames) {
  if (state.playing) play(false);
  go(state.frame + frames);
}

// controls

byId("play").addEventListener("click", () => play(!state.playing));
byId("back").addEventListener("click", () => step(-1));
byId("on").addEventListener("click", () => step(1));
scrubber.addEventListener("input", () => step(Number(scrubber.value) - state.frame));
choice(byId("speed"), SPEEDS.map((speed) => [String(speed), `${speed} ×`]), "1", (value) => {
  state.speed = Number(value);
  begun = null;
});
const followOptions = [["", "nobody"], ...(pair.length ? [["pair", "the colliding pair"]] : []), ...agentOptions];
choice(byId("follow"), followOptions, state.follow, (value) => {
  state.follow = value;
});
choice(byId("sight"), [["", "none"], ["all", "all agents"], ...agentOptions], "", (value) => {
  state.sight = value;
});
function tickBox(home, id, title, checked, changed) {
  const box = made("input", { type: "checkbox", checked, id });
  box.addEventListener("change", () => {
    changed(box.checked);
    show();
  });
  byId(home).append(made("label", {}, box, ` ${title}`));
}
for (const [layer, title] of Object.entries(LAYERS)) {
  const there = layer === "points" ? sources.withPoints.length : data[layer] !== null;
  if (!there) continue; // the release does not have it
  tickBox("layers", `layer-${layer}`, title, state.layers[layer], (checked) => {
    state.layers[layer] = checked;
  });
}
byId("clouds").hidden = sources.withPoints.length < 2;
for (const bit of sources.withPoints) {
  const agent = data.agents[bit];
  tickBox("clouds", `cloud-${agent.name}`, agent.title, state.clouds.includes(bit), (checked) => {
    state.clouds = sources.withPoints.filter((each) => (each === bit ? checked : state.clouds.includes(each)));
    state.layers.points = byId("layer-points").checked = true;
  });
}

function follow(value) {
  byId("follow").value = state.follow = value;
}

// For the pages around: show in a canvas, by its id, what the numbers of such a canvas' `data-view` say.
const VIEWS = { ground };
function look(id, view) {
  follow("");
  VIEWS[id].setView(view);
  VIEWS[id].draw();
}

function zoom(factor) {
  if (state.follow === "pair") follow(""); // it has its own scale
  ground.zoom(factor);
  ground.draw();
}
byId("closer").addEventListener("click", () => zoom(ZOOM_STEP));
byId("farther").addEventListener("click", () => zoom(1 / ZOOM_STEP));
byId("whole").addEventListener("click", () => {
  follow("");
  ground.showWhole();
  ground.draw();
});

const fingers = new Map();
const spread = () => {
  const [one, other] = [...fingers.values()];
  return Math.hypot(one.x - other.x, one.y - other.y);
};
ground.canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(event.deltaY < 0 ? ZOOM_STEP : 1 / ZOOM_STEP);
});
ground.canvas.addEventListener("pointerdown", (event) => {
  ground.canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
});
ground.canvas.addEventListener("pointermove", (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const apart = fingers.size === 2 ? spread() : null;
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  if (apart !== null) zoom(spread() / Math.max(apart, 1));
  else {
    follow("");
    ground.move(event.clientX - before.x, event.clientY - before.y);
  }
  ground.draw();
});
for (const kind of ["pointerup", "pointercancel"]) {
  ground.canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
}

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
};
for (const card of cards) keys[card.bit + 1] = () => enlarge(String(card.bit));
document.addEventListener("keydown", (event) => {
  // a control that has the focus keeps the keys that it needs itself
  const control = event.target.closest("button, select, input");
  const own = control && (event.key === " " ? control !== scrubber : control.matches("select, input"));
  if (own || event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});
new ResizeObserver(show).observe(ground.canvas);

// what does not change with time

document.documentElement.style.setProperty("--alarm", data.colors.pair);
byId("scenario").textContent = data.scenario;
for (const [name, value] of data.facts) {
  byId("facts").append(made("dt", { textContent: name }), made("dd", { textContent: value }));
}
byId("notes").append(...data.notes.map((note) => made("li", { textContent: note })));
const others = data.actors.filter((actor) => actor.role === "other");
const kinds = new Map(others.map((actor) => [actor.category, chip(actor.color, actor.shape)]));
byId("legend").append(
  ...(pair.length ? [made("span", {}, chip(data.colors.pair), "colliding pair")] : []),
  ...data.agents.map((agent) => made("span", {}, chip(agent.color), `${agent.short} ${agent.title}`)),
  ...[...kinds].map(([name, mark]) => made("span", {}, mark, name)),
);
byId("foreseen-key").hidden = !data.prediction;
const impact = data.countdown.indexOf(0);
const marks = [...samplesAt].map(([frame, samples]) => [frame, verdictColor(samples[0].verdict)]);
if (impact >= 0) marks.push([impact, data.colors.pair]);
for (const [frame, color] of marks) {
  const mark = made("span");
  mark.style.left = `${(100 * frame) / Math.max(last, 1)}%`;
  mark.style.background = color;
  byId("marks").append(mark);
}
show();
