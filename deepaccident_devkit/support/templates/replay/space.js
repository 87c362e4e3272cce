// The scene in three dimensions: clouds, boxes with headings and trails, cameras, and names.

const GRID_REACH = 60; // metres around the middle
const SHOWN_DEPTH = { large: 9, small: 4 }; // metres: how long a camera's frustum is
// corners as SIGNS has them; the first face is the front
const FACES = [[0, 1, 2, 3], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]];
const HEIGHTS = [-1, 6]; // metres above the ground, from the first to the last of the colours
const SHADE = 0.85; // yellow on white would be too pale
const POINT_NEAR = 60; // a point so many metres away is a pixel wide, nearer ones more

class Space {
  constructor(canvas, data, state, sources) {
    Object.assign(this, { canvas, data, state, sources });
    this.pair = data.actors.filter((actor) => actor.role === "pair");
    this.orbit = new Orbit();
    this.plane = groundPlane(data.actors);
    this.zoomed = 1; // by the reader
    this.kinds = { points: new Numbers(), lines: new Numbers(), faces: new Numbers(), picture: new Numbers() };
    this.kept = new Map(); // agent → the cloud that is shown while the next one is on its way
    this.gpu = null;
    this.waits = false;
    this.setOut();
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.gpu = null;
    });
    canvas.addEventListener("webglcontextrestored", () => this.begin());
    if (ground.road) ground.road.addEventListener("load", () => this.paintRoad());
  }

  /** Whether this browser can draw it; from then on it does. */
  begin() {
    const gl = this.canvas.getContext("webgl2", { antialias: true, alpha: true });
    if (gl === null || gl.isContextLost()) return false;
    if (this.gpu === null) this.gpu = new Gpu(gl);
    this.paintRoad();
    return true;
  }

  paintRoad() {
    if (ground.road && ground.road.naturalWidth && this.gpu) this.gpu.paint(ground.road);
    this.draw();
  }

  /** Give the graphics processor's memory back. */
  end() {
    if (this.gpu) this.gpu.free();
    this.gpu = null;
  }

  // Behind the first agent that is shown, who drives into the scene.
  setOut() {
    const [first] = this.data.agents;
    this.orbit.turn = first.poses[this.data.countdown.length - 1][2] / 1000 + Math.PI - 0.35;
    this.orbit.rise = 0.5;
    this.zoomed = 1;
    this.whole();
  }

  whole() {
    const [x, y] = [ground.x, ground.y];
    this.orbit.target = [x, y, this.heightAt(x, y)];
    this.orbit.distance = 0.65 * ground.span;
  }

  heightAt(x, y) {
    return this.plane[0] + this.plane[1] * x + this.plane[2] * y;
  }

  fromAbove() {
    Object.assign(this.orbit, { rise: ABOVE, turn: -ABOVE });
    this.draw();
  }

  zoom(factor) {
    this.zoomed *= factor;
    this.orbit.closer(factor);
  }

  /** What the eye looks at, from where, in the order of `data-view`. */
  setView([x, y, z, turn, rise, distance]) {
    Object.assign(this.orbit, { target: [x, y, z], turn, rise, distance });
  }

  /** Drawn once before the screen's next picture, however often it is asked for. */
  draw() {
    if (this.waits || !this.gpu) return;
    this.waits = true;
    requestAnimationFrame(() => {
      this.waits = false;
      if (this.gpu && this.canvas.clientWidth) this.render();
    });
  }

  // Whom the reader follows is in the middle; the pair as large as the map has it.
  follow() {
    const { follow, frame } = this.state;
    const followed = this.data.agents[follow];
    if (followed) this.look(followed.poses[frame][0] / 100, followed.poses[frame][1] / 100, 34);
    const states = follow === "pair" ? this.pair.map((actor) => actor.states[frame]).filter((each) => each) : [];
    if (states.length < 2) return;
    const [x, y] = [0, 1].map((axis) => (states[0][axis] + states[1][axis]) / 200);
    const apart = Math.hypot(states[0][0] - states[1][0], states[0][1] - states[1][1]) / 100;
    this.look(x, y, 1.1 * apart + 24);
  }

  look(x, y, distance) {
    this.orbit.target = [x, y, this.heightAt(x, y)];
    this.orbit.distance = Math.min(FARTHEST, Math.max(CLOSEST, distance / this.zoomed));
  }

  render() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const [wide, tall] = [Math.round(width * ratio), Math.round(height * ratio)];
    const isOther = this.canvas.width !== wide || this.canvas.height !== tall;
    if (isOther) Object.assign(this.canvas, { width: wide, height: tall });
    this.follow();
    this.ink = inkOf(this.canvas);
    const isDark = this.ink[0] > 0.5;
    // on a dark page what is thin is lighter; a box keeps its colour
    this.thin = (color) => channelsOf(color).map((each) => (isDark ? 0.3 + 0.7 * each : each));
    for (const numbers of Object.values(this.kinds)) numbers.count = 0;
    this.addRoad();
    this.addGrid();
    this.addPoints();
    if (this.state.layers.trails) for (const actor of this.data.actors) this.addTrail(actor);
    for (const actor of this.data.actors) this.addActor(actor);
    this.addAgents();
    this.addSights();
    if (this.state.layers.prediction) this.addForeseen();
    if (this.data.impact) this.addImpact();
    const gpu = this.gpu;
    for (const [kind, { array, count }] of Object.entries(this.kinds)) gpu.fill(kind, array, count);
    gpu.begin(this.orbit.matrix(width / height), wide, tall, ratio);
    gpu.draw("picture", { shade: isDark ? 0.34 : 1 });
    gpu.draw("points", { near: POINT_NEAR });
    gpu.draw("lines");
    gpu.draw("faces");
    this.canvas.dataset.view = [...this.orbit.target, this.orbit.turn, this.orbit.rise, this.orbit.distance].join(" ");
    this.writeNames(width, height);
  }

  line(from, to, color, width = 1, alpha = 1) {
    this.kinds.lines.add(...from, ...to, ...color, alpha, width);
  }

  triangle(corners, color, alpha) {
    for (const corner of corners) this.kinds.faces.add(...corner, ...color, alpha);
  }

  addRoad() {
    if (!this.data.road || !this.state.layers.road) return;
    const { left, top, width, height } = this.data.road;
    const corner = (right, down) => {
      const [x, y] = [(left + right * width) / 100, (top - down * height) / 100];
      return [x, y, this.heightAt(x, y), right, down];
    };
    for (const [right, down] of [[0, 0], [1, 0], [0, 1], [0, 1], [1, 0], [1, 1]]) {
      this.kinds.picture.add(...corner(right, down));
    }
  }

  addGrid() {
    const [x, y] = this.orbit.target.map((each) => Math.round(each / GRID_METRES) * GRID_METRES);
    const color = channelsOf(this.data.colors.grid);
    const at = (across, along) => [across, along, this.heightAt(across, along) + 0.03];
    for (let step = -GRID_REACH; step <= GRID_REACH; step += GRID_METRES) {
      this.line(at(x + step, y - GRID_REACH), at(x + step, y + GRID_REACH), color, 1, 0.25);
      this.line(at(x - GRID_REACH, y + step), at(x + GRID_REACH, y + step), color, 1, 0.25);
    }
  }

  // Points in the colours of their agents, or by their height above the ground.
  addPoints() {
    const { points } = this.kinds;
    const missing = [];
    const heights = this.data.colors.heights.map((color) => this.thin(color).map((each) => SHADE * each));
    for (const bit of this.state.clouds) {
      const cloud = this.cloud(bit);
      const agent = this.data.agents[bit];
      if (!cloud) {
        if (cloud === null) missing.push(agent.title);
        continue;
      }
      const own = this.thin(agent.color);
      for (let index = 0; index < cloud.length; index += 3) {
        const [x, y, z] = [cloud[index] / 10, cloud[index + 1] / 10, cloud[index + 2] / 10];
        const high = (z - this.heightAt(x, y) - HEIGHTS[0]) / (HEIGHTS[1] - HEIGHTS[0]);
        const color = this.state.pointsBy === "height" ? mixed(heights, high) : own;
        points.add(x, y, z, color[0], color[1], color[2], 1);
      }
    }
    const words = missing.length ? `No LiDAR at this frame: ${missing.join(", ")}` : "";
    byId("space-note").textContent = words;
  }

  // While a server has not given an agent's cloud yet, the one before stays.
  cloud(bit) {
    const cloud = this.sources.points(bit, this.state.frame);
    if (cloud !== undefined) this.kept.set(bit, cloud);
    return this.kept.get(bit);
  }

  addTrail(actor) {
    const color = channelsOf(actor.color);
    const place = (each) => [each[0] / 100, each[1] / 100, (each[4] - actor.height / 2) / 100 + 0.08];
    const last = this.state.frame;
    for (let frame = Math.max(1, last - TRAIL_FRAMES + 1); frame <= last; frame += 1) {
      const [before, after] = [actor.states[frame - 1], actor.states[frame]];
      if (before === null || after === null || (before[0] === after[0] && before[1] === after[1])) continue;
      const alpha = 0.15 + 0.7 * (1 - (last - frame) / TRAIL_FRAMES);
      this.line(place(before), place(after), color, actor.role === "other" ? 1.2 : 2, alpha);
    }
  }

  // A glass box whose front is darker, with an arrow on its roof.
  addActor(actor) {
    const corners = cornersOf(actor, this.state.frame);
    if (corners === null) return;
    const color = channelsOf(actor.color);
    const isLit = actor.id === this.state.lit;
    const thick = actor.role === "other" ? 0.7 : 1.2;
    if (isLit) for (const [from, to] of EDGES) this.line(corners[from], corners[to], this.ink, thick + 2);
    for (const [from, to] of EDGES) this.line(corners[from], corners[to], color, thick);
    FACES.forEach(([a, b, c, d], number) => {
      const alpha = (actor.role === "other" ? 0.18 : 0.32) + (number ? 0 : 0.3);
      for (const each of [[a, b, c], [a, c, d]]) this.triangle(each.map((corner) => corners[corner]), color, alpha);
    });
    const middle = (one, other) => corners[one].map((each, axis) => (each + corners[other][axis]) / 2);
    this.triangle([middle(0, 1), middle(0, 4), middle(1, 5)], color, 0.85);
  }

  // Each agent's camera that is shown beside, and the pole of the infrastructure.
  addAgents() {
    const frame = this.state.frame;
    for (const card of cards) {
      const camera = cameraOf(card);
      const color = this.thin(card.agent.color);
      const isLarge = card.figure.classList.contains("large");
      if (camera) this.addFrustum(camera, color, isLarge ? SHOWN_DEPTH.large : SHOWN_DEPTH.small, isLarge);
      if (ground.actorOf(card.agent)) continue;
      const [x, y] = card.agent.poses[frame].map((each) => each / 100);
      const low = this.heightAt(x, y);
      this.line([x, y, low], [x, y, camera ? camera.poses[frame][2] / 100 : low + 4], color, 2);
    }
  }

  addFrustum(camera, color, depth, isLarge) {
    const pose = camera.poses[this.state.frame];
    const eye = pose.slice(0, 3).map((each) => each / 100);
    const axes = axesOfCamera(pose);
    const [width, height, fx, fy, cx, cy] = camera.lens;
    const corners = [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) => {
      const away = [((u - cx) / fx) * depth, ((v - cy) / fy) * depth, depth];
      return eye.map((each, axis) => each + axes.reduce((sum, own, of) => sum + own[axis] * away[of], 0));
    });
    corners.forEach((corner, number) => {
      const next = corners[(number + 1) % 4];
      this.line(eye, corner, color, isLarge ? 0.9 : 0.6, 0.9);
      this.line(corner, next, color, isLarge ? 0.9 : 0.6, 0.9);
      if (isLarge) this.triangle([eye, corner, next], color, 0.06);
    });
  }

  // From the agents to what they see: as the reader chose, and to whom is lit.
  addSights() {
    const { frame, sight, lit } = this.state;
    this.data.agents.forEach((agent, bit) => {
      const [x, y] = agent.poses[frame].map((each) => each / 100);
      const own = ground.actorOf(agent);
      const from = [x, y, own ? own.states[frame][4] / 100 : this.heightAt(x, y) + 4];
      for (const actor of this.data.actors) {
        const isShown = sight === "all" || sight === String(bit) || actor.id === lit;
        if (!isShown || actor.states[frame] === null || !(actor.seen[frame] & (1 << bit))) continue;
        const state = actor.states[frame];
        this.line(from, [state[0] / 100, state[1] / 100, state[4] / 100], this.thin(agent.color), 0.7, 0.7);
      }
    });
  }

  addForeseen() {
    for (const alarm of this.state.foreseen.flatMap(({ alarms }) => alarms)) {
      const color = channelsOf(ground.verdictColor(alarm));
      for (const [x, y] of alarm.places.map((place) => place.map((each) => each / 100))) this.addRing(x, y, color);
    }
  }

  addRing(x, y, color) {
    const at = (step) => {
      const [across, along] = [x + RING * Math.cos((step * Math.PI) / 12), y + RING * Math.sin((step * Math.PI) / 12)];
      return [across, along, this.heightAt(across, along) + 0.15];
    };
    for (let step = 0; step < 24; step += 2) this.line(at(step), at(step + 1.3), color, 1);
  }

  addImpact() {
    const [x, y] = this.data.impact.map((each) => each / 100);
    const [inner, outer] = this.data.countdown[this.state.frame] === 0 ? [2.5, 5] : [0.6, 1.4];
    const color = channelsOf(this.data.colors.pair);
    for (let ray = 0; ray < 8; ray += 1) {
      const at = (reach) => {
        const place = [x + reach * Math.cos((ray * Math.PI) / 4), y + reach * Math.sin((ray * Math.PI) / 4)];
        return [...place, this.heightAt(...place) + 0.15];
      };
      this.line(at(inner), at(outer), color, 1.5);
    }
  }

  // Names above the pair, the agents and whom is lit; a name that would lie on another goes higher.
  writeNames(width, height) {
    const frame = this.state.frame;
    const { agents, ids } = this.state.layers;
    const named = [];
    for (const actor of this.data.actors.filter((each) => each.states[frame] !== null)) {
      const isLit = actor.id === this.state.lit;
      const asked = ids || isLit || (agents && this.pair.includes(actor) && !actor.tag);
      const words = isLit ? actor.title : [agents && actor.tag, asked && actor.id].filter(Boolean).join(" ");
      const state = actor.states[frame];
      const top = [state[0] / 100, state[1] / 100, (state[4] + actor.height / 2) / 100];
      if (words) named.push({ words, top, color: actor.color, isLit });
    }
    for (const agent of this.data.agents.filter((each) => agents && !ground.actorOf(each))) {
      const [x, y] = agent.poses[frame].map((each) => each / 100);
      named.push({ words: agent.short, top: [x, y, this.heightAt(x, y) + 4.5], color: agent.color, isLit: false });
    }
    const taken = [];
    const labels = named.sort((one, other) => other.isLit - one.isLit).flatMap(({ words, top, color, isLit }) => {
      const pixel = this.orbit.pixel(top, width, height);
      if (pixel === null) return [];
      const label = made("span", { className: isLit ? "tag lit" : "tag", textContent: words });
      const wide = 7 * words.length + 12;
      let y = pixel[1] - 20;
      const box = () => [pixel[0] - wide / 2, y, pixel[0] + wide / 2, y + 17];
      while (taken.some((each) => common(box(), each))) y -= 18;
      if (box()[0] < 0 || box()[2] > width || y < 0 || y + 17 > height) return [];
      taken.push(box());
      const looks = { left: `${pixel[0] - wide / 2}px`, top: `${y}px`, width: `${wide}px`, borderColor: color };
      Object.assign(label.style, looks);
      return [label];
    });
    byId("space-names").replaceChildren(...labels);
  }

  /** The actor at a pixel of the canvas: the nearest whose box the reader's look meets. */
  actorAt(x, y) {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const [eye, ray] = [this.orbit.eye, this.orbit.ray(x, y, width, height)];
    let best = null;
    for (const actor of this.data.actors) {
      const state = actor.states[this.state.frame];
      if (state === null) continue;
      const middle = [state[0] / 100, state[1] / 100, state[4] / 100].map((each, axis) => each - eye[axis]);
      const slack = (TOUCH * 2 * Math.tan(LENS / 2) * Math.hypot(...middle)) / height;
      const half = [actor.length, actor.width, actor.height].map((each) => each / 200 + slack);
      const away = meeting(axesOf(state), half, middle, ray);
      if (away !== null && (best === null || away < best.away)) best = { actor, away };
    }
    return best && best.actor;
  }
}

// The colour at a share of the way through several.
function mixed(colors, share) {
  const at = Math.min(1, Math.max(0, share)) * (colors.length - 1);
  const low = Math.min(colors.length - 2, Math.floor(at));
  return colors[low].map((each, channel) => each + (at - low) * (colors[low + 1][channel] - each));
}

// How far along a ray from 0, 0, 0 a box is met, by its axes, half its sides and its middle; null if it is not.
function meeting(axes, half, middle, ray) {
  let [enters, leaves] = [0, Infinity];
  for (const [number, axis] of axes.entries()) {
    const [at, along] = [dot(axis, middle), dot(axis, ray)];
    if (Math.abs(along) < 1e-9) {
      if (Math.abs(at) > half[number]) return null;
      continue;
    }
    const ends = [(at - half[number]) / along, (at + half[number]) / along];
    enters = Math.max(enters, Math.min(...ends));
    leaves = Math.min(leaves, Math.max(...ends));
  }
  return enters <= leaves ? enters : null;
}

// An actor's corners in world, as SIGNS has them, metres; null where nobody annotated it.
function cornersOf(actor, frame) {
  const state = actor.states[frame];
  if (state === null) return null;
  const axes = axesOf(state);
  const half = [actor.length / 200, actor.width / 200, actor.height / 200];
  return SIGNS.map((signs) =>
    [state[0], state[1], state[4]].map(
      (middle, row) => middle / 100 + axes.reduce((sum, axis, of) => sum + signs[of] * half[of] * axis[row], 0),
    ),
  );
}

// The ground as z = a + b x + c y, metres: the plane nearest to the undersides of all actors.
function groundPlane(actors) {
  const sums = [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]];
  for (const actor of actors) {
    for (const state of actor.states) {
      if (state === null) continue;
      const row = [1, state[0] / 100, state[1] / 100, (state[4] - actor.height / 2) / 100];
      sums.forEach((sum, one) => row.forEach((each, other) => {
        sum[other] += row[one] * each;
      }));
    }
  }
  for (let one = 0; one < 3; one += 1) {
    if (Math.abs(sums[one][one]) < 1e-6) return [sums[0][0] ? sums[0][3] / sums[0][0] : 0, 0, 0]; // all in one line
    for (let row = 0; row < 3; row += 1) {
      const share = sums[row][one] / sums[one][one];
      if (row !== one) sums[row] = sums[row].map((each, column) => each - share * sums[one][column]);
    }
  }
  return sums.map((row, one) => row[3] / row[one]);
}

// The colour of a page's letters, from 0 to 1.
const inkOf = (element) => getComputedStyle(element).color.match(/[\d.]+/g).slice(0, 3).map((each) => each / 255);

const space = new Space(byId("space"), data, state, sources);
