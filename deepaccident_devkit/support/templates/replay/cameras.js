// The agents' cameras: one large picture and small ones, with the actors' boxes projected into them.

const NEAR = 10; // centimetres before the camera: nearer parts of a box are cut off
const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
const SIGNS = [[1, 1, 1], [1, -1, 1], [1, -1, -1], [1, 1, -1], [-1, 1, 1], [-1, -1, 1], [-1, -1, -1], [-1, 1, -1]];

const dot = (one, other) => one[0] * other[0] + one[1] * other[1] + one[2] * other[2];

function drawn(name, attributes, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

// An actor's axes in world: forward, left, up; the box may be tilted as its road is.
function axesOf(state) {
  const up = [state[5] / 1000, state[6] / 1000];
  up.push(Math.sqrt(1 - up[0] ** 2 - up[1] ** 2));
  const [x, y] = [Math.cos(state[2] / 1000), Math.sin(state[2] / 1000)];
  const rise = -(up[0] * x + up[1] * y) / up[2];
  const long = Math.hypot(1, rise);
  const forward = [x / long, y / long, rise / long];
  const left = [
    up[1] * forward[2] - up[2] * forward[1],
    up[2] * forward[0] - up[0] * forward[2],
    up[0] * forward[1] - up[1] * forward[0],
  ];
  return [forward, left, up];
}

// A camera's axes in world, right, down and ahead, from its unit quaternion in ten thousandths.
function axesOfCamera(pose) {
  const [w, x, y, z] = pose.slice(3).map((each) => each / 10000);
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// The eight corners of an actor, the front ones first: right, down and ahead of a camera, centimetres.
function cornersBefore(camera, frame, actor) {
  const state = actor.states[frame];
  const axes = axesOf(state);
  const pose = camera.poses[frame];
  const seen = axesOfCamera(pose);
  const half = [actor.length / 2, actor.width / 2, actor.height / 2];
  return SIGNS.map((signs) => {
    const place = [state[0], state[1], state[4]].map(
      (middle, row) => middle - pose[row] + axes.reduce((sum, axis, of) => sum + signs[of] * half[of] * axis[row], 0),
    );
    return seen.map((axis) => dot(axis, place));
  });
}

function pixelOf(camera, [right, down, ahead]) {
  const [, , fx, fy, cx, cy] = camera.lens;
  return [(fx * right) / ahead + cx, (fy * down) / ahead + cy];
}

// The edges of an actor in a picture, pixels; none if it is not in the picture.
function edgesIn(camera, corners) {
  const lines = EDGES.map(([from, to]) => [corners[from], corners[to]])
    .filter((ends) => ends.some((end) => end[2] > NEAR))
    .map((ends) => ends.map((end, which) => {
      if (end[2] >= NEAR) return pixelOf(camera, end);
      const other = ends[1 - which];
      const share = (NEAR - other[2]) / (end[2] - other[2]);
      return pixelOf(camera, end.map((each, axis) => other[axis] + share * (each - other[axis])));
    }));
  const [width, height] = camera.lens;
  const across = lines.flat().map((pixel) => pixel[0]);
  const down = lines.flat().map((pixel) => pixel[1]);
  const beside = Math.max(...across) < 0 || Math.min(...across) > width;
  return beside || Math.max(...down) < 0 || Math.min(...down) > height ? [] : lines;
}

const pathOf = (pixels) => `M${pixels.map((pixel) => pixel.map((each) => each.toFixed(1)).join(" ")).join("L")}`;

// The boxes of the actors that an agent sees, and dashed those of the pair that it does not see.
function drawBoxes(card, camera, frame) {
  const [width, height] = camera.lens;
  card.boxes.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const ratio = width / Math.max(card.boxes.clientWidth, 1);
  const large = card.figure.classList.contains("large");
  const sees = (actor) => Boolean(actor.seen[frame] & (1 << card.bit));
  const taken = [];
  const shown = data.actors.filter((actor) => {
    const there = actor.states[frame] !== null && actor.id !== card.agent.actor;
    return there && (actor.role === "pair" || actor.id === state.lit || sees(actor));
  });
  card.size = [width, height];
  card.places = [];
  card.boxes.replaceChildren(...[...shown].reverse().flatMap((actor) => {
    const corners = cornersBefore(camera, frame, actor);
    const lines = edgesIn(camera, corners);
    if (!lines.length) return [];
    card.places.push({ actor, place: extentOf(lines.flat()), away: corners.reduce((sum, each) => sum + each[2], 0) });
    const isLit = actor.id === state.lit;
    const parts = boxOf(actor, camera, corners, lines, { large, seen: sees(actor), isLit });
    if (isLit || actor.role === "pair" || (large && actor.tag)) parts.push(...tagOf(actor, lines.flat(), camera, ratio, taken));
    return [drawn("g", { "data-actor": actor.id, class: isLit ? "lit" : "" }, ...parts)];
  }));
}

// An actor's edges with a white casing and, if the agent sees it, its front.
function boxOf(actor, camera, corners, lines, { large, seen, isLit }) {
  const edges = { d: lines.map(pathOf).join(""), fill: "none", "vector-effect": "non-scaling-stroke" };
  const thick = (actor.role === "other" ? 1.2 : 2) * (large ? 1 : 0.75);
  const parts = [
    drawn("path", isLit
      ? { ...edges, stroke: INK, "stroke-width": thick + 4 }
      : { ...edges, stroke: "#ffffff", "stroke-width": thick + 1.5, "stroke-opacity": 0.5 }),
    drawn("path", { ...edges, stroke: actor.color, "stroke-width": thick, "stroke-dasharray": seen ? "none" : "4 3" }),
  ];
  const front = corners.slice(0, 4);
  if (seen && front.every((corner) => corner[2] > NEAR)) {
    const face = pathOf(front.map((corner) => pixelOf(camera, corner)));
    parts.push(drawn("path", { d: `${face}Z`, fill: actor.color, "fill-opacity": 0.25 }));
  }
  return parts;
}

// Left, top, right and bottom of pixels.
function extentOf(pixels) {
  const [across, down] = [0, 1].map((axis) => pixels.map((pixel) => pixel[axis]));
  return [Math.min(...across), Math.min(...down), Math.max(...across), Math.max(...down)];
}

// The letters of the agent that an actor is, or its id, or of whom is lit all, above its box but in the picture, and not on another tag.
function tagOf(actor, pixels, camera, ratio, taken) {
  const [width, height] = camera.lens;
  const words = actor.id === state.lit ? actor.title : actor.tag || String(actor.id);
  const [wide, tall] = [(words.length * 7 + 6) * ratio, 14 * ratio];
  const within = (low, value, high) => Math.min(Math.max(low, value), high);
  const [across, down] = [0, 1].map((axis) =>
    pixels.map((pixel) => within(0, pixel[axis], axis ? height : width)),
  );
  const middle = (Math.min(...across) + Math.max(...across) - wide) / 2;
  const y = within(0, Math.min(...down) - tall - 2 * ratio, height - tall);
  const places = [0, 1, -1, 2, -2].map((step) => within(0, middle + step * (wide + 3 * ratio), width - wide));
  const free = (left) => taken.every((each) => common([left, y, left + wide, y + tall], each) === 0);
  const x = places.find(free) ?? places[0];
  taken.push([x, y, x + wide, y + tall]);
  const frame = { fill: "#ffffff", "fill-opacity": 0.9, stroke: actor.color, "vector-effect": "non-scaling-stroke" };
  const text = { "text-anchor": "middle", "font-size": 11 * ratio, "font-weight": 600, fill: INK };
  return [
    drawn("rect", { x, y, width: wide, height: tall, rx: 2 * ratio, "stroke-width": 1.5, ...frame }),
    drawn("text", { x: x + wide / 2, y: y + tall * 0.8, ...text }, words),
  ];
}

// the cards

const hasPictures = (camera) => camera.pictures.some((each) => each !== null);

const cards = data.agents.map((agent, bit) => {
  const available = data.cameras[bit].filter(hasPictures);
  const title = made("span", { className: "name" }, chip(agent.color, "round"), agent.title);
  const picture = madePicture();
  const none = made("span", { className: "none", textContent: "no pictures" });
  const where = made("span", { className: "where" });
  const judged = made("span", { className: "judged" });
  const sees = made("p");
  const boxes = drawn("svg", { class: "boxes", preserveAspectRatio: "none", "aria-hidden": "true" });
  const pictured = made("button", { type: "button", className: "pictured" }, picture, boxes, where, judged, none);
  pictured.style.borderColor = agent.color;
  pictured.ariaLabel = `Large picture of ${agent.title}`;
  const figure = made("figure", { className: "agent" }, title, pictured);
  figure.dataset.agent = agent.name;
  const select = made("select", { ariaLabel: `Camera of ${agent.title}`, hidden: available.length < 2 });
  const card = { agent, bit, available, chosen: "", picture, none, where, judged, select, sees, boxes, figure };
  choice(select, [["", "automatic"], ...available.map(({ title }) => [title, title])], "", (value) => {
    card.chosen = value;
  });
  figure.append(select, sees);
  lightIn(card, pictured, () => enlarge(String(bit)));
  byId("cards").append(figure);
  return card;
});

const agentOptions = data.agents.map((agent, bit) => [String(bit), agent.title]);
choice(byId("large"), [["", "automatic"], ...agentOptions], "", (value) => {
  state.large = value;
});

function enlarge(value) {
  byId("large").value = state.large = value;
  show();
}

byId("boxes").addEventListener("change", () => {
  state.boxes = byId("boxes").checked;
  show();
});

// The frame whose picture stands for a frame: the last one before it or, if there is none, the first one.
function pictureFrame(camera, frame) {
  for (let at = frame; at >= 0; at -= 1) if (camera.pictures[at] !== null) return at;
  return camera.pictures.findIndex((each) => each !== null);
}

// A picture of another moment says how far that is; where the release has none of this moment, it is veiled. A page
// without a server has some of the pictures alone: one of up to half a second ago may stand for now.
function sayWhen(card, camera, frame) {
  const seconds = (frames) => Math.abs(frames) * data.period;
  const away = state.frame - frame;
  const words = `${seconds(away).toFixed(1)} s ${away > 0 ? "earlier" : "later"}`;
  card.where.textContent = away ? `${camera.title}, ${words}` : camera.title;
  card.where.classList.toggle("earlier", away !== 0);
  const nearest = seconds(state.frame - pictureFrame(camera, state.frame));
  card.figure.classList.toggle("veiled", nearest > (data.served ? 0 : 0.5));
}

function cameraOf(card) {
  const wanted = card.chosen || data.automatic.cameras[card.bit][state.frame];
  return card.available.find((camera) => camera.title === wanted) || card.available[0];
}

function showCameras() {
  const large = state.large === "" ? data.automatic.agents[state.frame] : Number(state.large);
  for (const card of cards) card.figure.classList.toggle("large", card.bit === large);
  cards.forEach(showCamera);
}

function showCamera(card) {
  const camera = cameraOf(card);
  card.none.hidden = Boolean(camera);
  card.picture.hidden = !camera;
  card.boxes.replaceChildren();
  card.places = [];
  if (camera) {
    const frame = showPicture(card, camera, card.figure.classList.contains("large"));
    card.picture.alt = `${card.agent.title}, camera ${camera.title}, frame ${frame + 1}`;
    sayWhen(card, camera, frame);
    card.select.options[0].textContent = card.chosen ? "automatic" : `auto: ${camera.title}`;
    if (state.boxes) drawBoxes(card, camera, frame);
  }
  const sample = state.foreseen.find((each) => each.agent === card.bit);
  card.judged.replaceChildren(...(sample ? [badge(sample.verdict)] : []));
  showSight(card);
}

// Show a camera's picture of the moment, and return its frame. While it plays, a picture that a server has not yet given
// is waited for: the next one is asked for then.
function showPicture(card, camera, large) {
  const frame = pictureFrame(camera, state.frame);
  const source = sources.picture(card.agent, camera, frame, large);
  if (source !== card.source) {
    if (state.playing && card.camera === camera && !card.picture.complete) return card.frame;
    Object.assign(card, { source, camera, frame });
    card.picture.src = source;
  }
  return card.frame;
}

function madePicture() {
  const picture = made("img", { alt: "" });
  picture.addEventListener("error", () => picture.classList.add("broken"));
  picture.addEventListener("load", () => picture.classList.remove("broken"));
  return picture;
}

function showSight(card) {
  const others = data.actors.filter((actor) => actor.states[state.frame] && actor.id !== card.agent.actor);
  const seen = others.filter((actor) => actor.seen[state.frame] & (1 << card.bit));
  const hidden = others.filter((actor) => actor.role === "pair" && !seen.includes(actor));
  const large = card.figure.classList.contains("large") && hidden.length;
  const without = large ? `, not ${hidden.map((actor) => actor.title).join(", ")}` : "";
  card.sees.textContent = others.length ? `sees ${seen.length} of ${others.length}${without}` : "";
}

// all cameras

let everyCamera = null;

function madeEvery() {
  return data.agents.flatMap((agent, bit) => {
    const row = made("div", { className: "cards" });
    byId("every-camera").append(made("h3", {}, chip(agent.color, "round"), agent.title), row);
    return data.cameras[bit].map((camera) => {
      const there = hasPictures(camera);
      const boxes = drawn("svg", { class: "boxes", preserveAspectRatio: "none", "aria-hidden": "true" });
      const picture = madePicture();
      picture.hidden = !there;
      const none = made("span", { className: "none", textContent: "not downloaded", hidden: there });
      const where = made("span", { className: "where" });
      const pictured = made("div", { className: "pictured" }, picture, boxes, where, none);
      pictured.style.borderColor = agent.color;
      const figure = made("figure", { className: "agent" }, pictured);
      row.append(figure);
      const card = { agent, bit, there, shown: camera, picture, boxes, where, figure };
      lightIn(card, pictured, () => {});
      return card;
    });
  });
}

// The pictures of all cameras at this moment; only while the reader has opened them.
function showEvery() {
  if (!byId("every").open) return;
  everyCamera = everyCamera || madeEvery();
  for (const card of everyCamera) {
    const frame = card.there ? showPicture(card, card.shown, false) : state.frame;
    card.picture.alt = `${card.agent.title}, camera ${card.shown.title}, frame ${frame + 1}`;
    if (card.there) sayWhen(card, card.shown, frame);
    else card.where.textContent = card.shown.title;
    card.boxes.replaceChildren();
    if (state.boxes) drawBoxes(card, card.shown, frame);
  }
}
byId("every").hidden = data.cameras.every((cameras) => !cameras.length);
byId("every").addEventListener("toggle", show);
