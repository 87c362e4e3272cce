// Time and controls: `show` brings the whole page up to the frame of the state.

// Of the arrow keys with shift: by how much they turn the scene, to the right and up.
const TURNS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
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
  showLit();
  showStrip();
  ground.draw();
  space.draw();
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
    if (state.scene === "map") state.layers.points = byId("layer-points").checked = true;
  });
}

function follow(value) {
  byId("follow").value = state.follow = value;
}

// For the pages around: show in a canvas, by its id, what the numbers of such a canvas' `data-view` say.
const VIEWS = { ground, space };
function look(id, view) {
  follow("");
  VIEWS[id].setView(view);
  VIEWS[id].draw();
}

function zoomMap(factor) {
  if (state.follow === "pair") follow(""); // it has its own scale
  ground.zoom(factor);
  ground.draw();
}

function zoomSpace(factor) {
  space.zoom(factor);
  space.draw();
}

function zoom(factor) {
  zoomSpace(factor);
  if (state.scene !== "space") zoomMap(factor);
}
byId("closer").addEventListener("click", () => zoom(ZOOM_STEP));
byId("farther").addEventListener("click", () => zoom(1 / ZOOM_STEP));
byId("whole").addEventListener("click", () => {
  follow("");
  ground.showWhole();
  space.setOut();
  ground.draw();
  space.draw();
});

onPointers(ground.canvas, {
  zoom: zoomMap,
  drag: (right, down) => {
    follow("");
    ground.move(right, down);
    ground.draw();
  },
  point: (x, y) => point(x === null ? null : ground.actorAt(x, y)),
  click: (x, y) => choose(ground.actorAt(x, y)),
});
onPointers(space.canvas, {
  zoom: zoomSpace,
  drag: (right, down, moves) => {
    if (moves) {
      follow("");
      space.orbit.move(right, down, space.canvas.clientHeight);
    } else space.orbit.turnBy(right / 150, down / 150);
    space.draw();
  },
  point: (x, y) => point(x === null ? null : space.actorAt(x, y)),
  click: (x, y) => choose(space.actorAt(x, y)),
});

function layOut(scene) {
  state.scene = scene;
  byId("space-box").hidden = scene === "map";
  ground.canvas.hidden = scene === "space";
  document.querySelector(".above").classList.toggle("both", scene === "both");
}

// Where the browser has no WebGL there is the map.
function showScene(scene) {
  if (scene === "map") space.end();
  const isWithout = scene !== "map" && space.gpu === null && !space.begin();
  layOut(isWithout ? "map" : scene);
  if (isWithout) for (const name of ["scene-tools", "space-key"]) byId(name).hidden = true;
}
const SCENES = [["both", "3D and map"], ["space", "3D"], ["map", "map"]];
choice(byId("scene"), SCENES, state.scene, showScene);
choice(byId("points-by"), [["agent", "agent"], ["height", "height"]], state.pointsBy, (value) => {
  state.pointsBy = value;
});
byId("top").addEventListener("click", () => space.fromAbove());
layOut(state.scene);
addEventListener("pageshow", () => showScene(state.scene)); // after the rest of the page: it takes a moment to begin
addEventListener("pagehide", () => space.end());

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
  ".": () => chooseNext(1),
  ",": () => chooseNext(-1),
  Escape: () => choose(null),
};
for (const card of cards) keys[card.bit + 1] = () => enlarge(String(card.bit));
document.addEventListener("keydown", (event) => {
  // a control that has the focus keeps the keys that it needs itself
  const control = event.target.closest("button, select, input");
  const own = control && (event.key === " " ? control !== scrubber : control.matches("select, input"));
  if (own || event.ctrlKey || event.metaKey || event.altKey) return;
  if (!keys[event.key] && !(event.shiftKey && TURNS[event.key])) return;
  event.preventDefault();
  if (event.shiftKey && TURNS[event.key] && space.gpu) {
    space.orbit.turnBy(...TURNS[event.key]);
    space.draw();
  } else keys[event.key]();
});
const resized = new ResizeObserver(show);
resized.observe(ground.canvas);
resized.observe(space.canvas);

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
