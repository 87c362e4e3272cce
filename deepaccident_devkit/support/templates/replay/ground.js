// The scene from above, rendered on a canvas: x of the world to the right, y up. Data are centimetres and milliradians.

const TRAIL_FRAMES = 20;
const GRID_METRES = 10;
const LEAST_SPAN = 30;
const PAIR_SPAN = 36;
const LEAST_PIXELS = 5;
const LEAST_MARK = 9;
const SHAPES = { o: "circle", D: "diamond", "^": "triangle" }; // of the colour table's markers
const RING = 1.2; // metres
const TOUCH = 6; // pixels beside a box that still count
const ZOOM_STEP = 1.25;
const ZOOM_RANGE = [0.5, 120];
const FONT = "600 11px system-ui, sans-serif";
const INK = "#1c1c1c";
const SIDES = [[0, -1], [1, 0], [0, 1], [-1, 0], [1, -1], [1, 1], [-1, 1], [-1, -1]];

class Ground {
  constructor(canvas, data, state, sources) {
    this.canvas = canvas;
    this.data = data;
    this.state = state;
    this.sources = sources;
    this.pen = canvas.getContext("2d");
    this.road = data.road && Object.assign(new Image(), { src: `data:image/png;base64,${data.road.png}` });
    if (this.road) this.road.addEventListener("load", () => this.draw());
    this.pair = data.actors.filter((actor) => actor.role === "pair");
    for (const actor of data.actors) actor.shape = SHAPES[data.markers[actor.category]];
    this.showWhole();
  }

  // All agents' paths and the colliding pair's, in metres.
  showWhole() {
    const states = [...this.data.agents, ...this.pair].flatMap((each) => each.poses || each.states);
    const places = states.filter((each) => each !== null);
    const xs = places.map((each) => each[0] / 100);
    const ys = places.map((each) => each[1] / 100);
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    this.x = (left + right) / 2;
    this.y = (low + high) / 2;
    this.span = Math.max(right - left, high - low, LEAST_SPAN) + 16;
    this.scale = null;
  }

  // The pair in the middle, the closer the larger; it stays where it was while nobody annotated one of the two.
  showPair() {
    const states = this.pair.map((actor) => actor.states[this.state.frame]).filter((each) => each);
    if (states.length < 2) return;
    const [x, y] = [0, 1].map((axis) => states.map((each) => each[axis] / 100));
    [this.x, this.y] = [(x[0] + x[1]) / 2, (y[0] + y[1]) / 2];
    const span = Math.max(Math.abs(x[0] - x[1]), Math.abs(y[0] - y[1])) * 1.5 + PAIR_SPAN;
    this.scale = Math.min(this.width, this.height) / span;
  }

  fit() {
    const box = this.canvas.getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    this.width = this.canvas.clientWidth || box.width;
    this.height = this.canvas.clientHeight || box.height;
    const [wide, tall] = [Math.round(this.width * ratio), Math.round(this.height * ratio)];
    if (this.canvas.width !== wide || this.canvas.height !== tall) {
      this.canvas.width = wide;
      this.canvas.height = tall;
    }
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (this.scale === null) this.scale = Math.min(this.width, this.height) / this.span;
  }

  zoom(factor) {
    this.scale = Math.min(ZOOM_RANGE[1], Math.max(ZOOM_RANGE[0], this.scale * factor));
  }

  move(right, down) {
    this.x -= right / this.scale;
    this.y += down / this.scale;
  }

  // The middle in metres and the pixels of a metre, in the order of `data-view`.
  setView([x, y, scale]) {
    Object.assign(this, { x, y, scale });
  }

  // Pixels of the page from centimetres.
  at(place) {
    return [
      this.width / 2 + (place[0] / 100 - this.x) * this.scale,
      this.height / 2 - (place[1] / 100 - this.y) * this.scale,
    ];
  }

  draw() {
    this.fit();
    const followed = this.data.agents[this.state.follow];
    if (followed) [this.x, this.y] = followed.poses[this.state.frame].map((each) => each / 100);
    if (this.state.follow === "pair") this.showPair();
    this.canvas.dataset.view = [this.x, this.y, this.scale].join(" ");
    this.pen.fillStyle = "#fff";
    this.pen.fillRect(0, 0, this.width, this.height);
    const shown = this.state.layers;
    this.taken = this.data.actors.map((actor) => this.extent(actor)).filter((each) => each !== null);
    if (shown.road && this.road) this.drawRoad();
    this.drawGrid();
    if (shown.points) this.drawPoints();
    if (shown.trails) for (const actor of this.data.actors) this.drawTrail(actor);
    this.drawSights();
    const foreseen = shown.prediction ? this.state.foreseen : [];
    const alarms = foreseen.flatMap(({ agent, alarms }) =>
      alarms.map((alarm) => ({ ...alarm, short: this.data.agents[agent].short })),
    );
    for (const alarm of alarms) this.drawPlaces(alarm);
    for (const actor of [...this.data.actors].reverse()) this.drawActor(actor);
    if (shown.agents) this.drawPoles();
    if (this.data.impact) this.drawImpact();
    this.drawNames();
    this.drawAlarms(alarms);
  }

  drawRoad() {
    const { left, top, width, height } = this.data.road;
    const scale = this.scale / 100;
    this.pen.drawImage(this.road, ...this.at([left, top]), width * scale, height * scale);
  }

  drawGrid() {
    const pen = this.pen;
    pen.lineWidth = 1;
    pen.strokeStyle = this.data.colors.grid;
    pen.globalAlpha = 0.5;
    pen.beginPath();
    const half = [this.width / 2 / this.scale, this.height / 2 / this.scale];
    const step = GRID_METRES * Math.max(1, 2 ** Math.ceil(Math.log2(24 / (GRID_METRES * this.scale))));
    for (let x = Math.ceil((this.x - half[0]) / step) * step; x <= this.x + half[0]; x += step) {
      const across = this.at([x * 100, 0])[0];
      pen.moveTo(across, 0);
      pen.lineTo(across, this.height);
    }
    for (let y = Math.ceil((this.y - half[1]) / step) * step; y <= this.y + half[1]; y += step) {
      const down = this.at([0, y * 100])[1];
      pen.moveTo(0, down);
      pen.lineTo(this.width, down);
    }
    pen.stroke();
    pen.globalAlpha = 1;
    pen.font = FONT;
    pen.textAlign = "left";
    pen.textBaseline = "alphabetic";
    const words = `grid of ${step} m`;
    pen.fillStyle = "#ffffffe6";
    pen.fillRect(4, this.height - 20, pen.measureText(words).width + 8, 16);
    pen.fillStyle = INK;
    pen.fillText(words, 8, this.height - 8);
  }

  // Points of one agent are grey, those of several have the agents' colours.
  drawPoints() {
    const { clouds, frame } = this.state;
    for (const bit of clouds) {
      const cloud = this.sources.points(bit, frame);
      if (!cloud) continue;
      this.pen.fillStyle = clouds.length > 1 ? this.data.agents[bit].color : this.data.colors.points;
      for (let index = 0; index < cloud.length; index += 3) {
        const [x, y] = this.at([cloud[index] * 10, cloud[index + 1] * 10]);
        this.pen.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
      }
    }
  }

  drawTrail(actor) {
    const last = this.state.frame;
    const pen = this.pen;
    pen.strokeStyle = actor.color;
    pen.lineWidth = actor.role === "other" ? 1.5 : 2.5;
    for (let frame = Math.max(1, last - TRAIL_FRAMES + 1); frame <= last; frame += 1) {
      const [before, after] = [actor.states[frame - 1], actor.states[frame]];
      if (before === null || after === null) continue;
      if (before[0] === after[0] && before[1] === after[1]) continue;
      pen.globalAlpha = 0.1 + 0.6 * (1 - (last - frame) / TRAIL_FRAMES);
      pen.beginPath();
      pen.moveTo(...this.at(before));
      pen.lineTo(...this.at(after));
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  drawSights() {
    const pen = this.pen;
    const frame = this.state.frame;
    const chosen = this.state.sight;
    pen.lineWidth = 1.2;
    pen.globalAlpha = 0.55;
    this.data.agents.forEach((agent, bit) => {
      const all = chosen === "all" || chosen === String(bit);
      pen.strokeStyle = agent.color;
      pen.beginPath();
      for (const actor of this.data.actors) {
        if (!all && actor.id !== this.state.lit) continue;
        if (actor.states[frame] === null || !(actor.seen[frame] & (1 << bit))) continue;
        pen.moveTo(...this.at(agent.poses[frame]));
        pen.lineTo(...this.at(actor.states[frame]));
      }
      pen.stroke();
    });
    pen.globalAlpha = 1;
  }

  // Length and width in pixels: small actors stay large enough to be found.
  size(actor) {
    const least = actor.shape ? LEAST_MARK : LEAST_PIXELS;
    return [actor.length, actor.width].map((each) => Math.max(least, (each / 100) * this.scale));
  }

  // Left, top, right and bottom of an actor in pixels; null if nobody annotated it at this moment.
  extent(actor) {
    const state = actor.states[this.state.frame];
    if (state === null) return null;
    const [x, y] = this.at(state);
    const [length, width] = this.size(actor).map((each) => each / 2);
    const [cos, sin] = [Math.cos(state[2] / 1000), Math.sin(state[2] / 1000)].map(Math.abs);
    const [across, down] = [length * cos + width * sin, length * sin + width * cos];
    return [x - across, y - down, x + across, y + down];
  }

  // The outline of an actor that drives to the right, around 0, 0: a box, or the mark of its class.
  trace(actor) {
    const pen = this.pen;
    const [length, width] = this.size(actor).map((each) => each / 2);
    const corners = {
      diamond: [[length, 0], [0, width], [-length, 0], [0, -width]],
      triangle: [[length, 0], [-length, width], [-length, -width]],
    }[actor.shape] || [[length, -width], [length, width], [-length, width], [-length, -width]];
    pen.beginPath();
    if (actor.shape === "circle") pen.arc(0, 0, length, 0, 2 * Math.PI);
    else corners.forEach((corner) => pen.lineTo(...corner));
    pen.closePath();
  }

  drawActor(actor) {
    const state = actor.states[this.state.frame];
    if (state === null) return;
    const pen = this.pen;
    const [x, y] = this.at(state);
    const length = this.size(actor)[0];
    pen.save();
    pen.translate(x, y);
    pen.rotate(-state[2] / 1000);
    this.trace(actor);
    const isLit = actor.id === this.state.lit;
    pen.lineWidth = isLit ? 7 : 4;
    pen.strokeStyle = isLit ? INK : "#ffffff";
    pen.stroke();
    pen.fillStyle = pen.strokeStyle = actor.color;
    pen.globalAlpha = actor.role === "other" ? 0.55 : 0.75;
    pen.fill();
    pen.globalAlpha = 1;
    pen.lineWidth = actor.role === "other" ? 1.2 : 2;
    pen.stroke();
    if (!actor.shape) {
      pen.strokeStyle = "#ffffff";
      pen.beginPath();
      pen.moveTo(0, 0);
      pen.lineTo(length / 2, 0);
      pen.stroke();
    }
    pen.restore();
    if (this.state.layers.dots) this.drawDots(actor, x, this.extent(actor)[3] + 6);
  }

  drawDots(actor, x, y) {
    const seen = actor.seen[this.state.frame];
    const seeing = this.data.agents.filter((agent, bit) => seen & (1 << bit));
    this.taken.push([x - 3 * seeing.length, y - 3, x + 3 * seeing.length, y + 3]);
    seeing.forEach((agent, place) => {
      this.pen.fillStyle = agent.color;
      this.pen.beginPath();
      this.pen.arc(x + (place - (seeing.length - 1) / 2) * 6, y, 2.5, 0, 2 * Math.PI);
      this.pen.fill();
    });
  }

  // The agents that are no actors: the infrastructure.
  drawPoles() {
    const pen = this.pen;
    for (const agent of this.data.agents.filter((each) => !this.actorOf(each))) {
      const [x, y] = this.at(agent.poses[this.state.frame]);
      this.taken.push([x - 5, y - 5, x + 5, y + 5]);
      pen.beginPath();
      pen.arc(x, y, 5, 0, 2 * Math.PI);
      pen.fillStyle = agent.color;
      pen.fill();
      pen.lineWidth = 1.5;
      pen.strokeStyle = "#ffffff";
      pen.stroke();
    }
  }

  // The actor that an agent is at this moment, if any label has it.
  actorOf(agent) {
    return this.data.actors.find((actor) => actor.id === agent.actor && actor.states[this.state.frame] !== null);
  }

  // The agents' letters and, on demand, the actors' ids: first the pair's, so that they get the best places.
  drawNames() {
    const { agents, ids } = this.state.layers;
    for (const actor of this.data.actors) {
      const named = ids || (agents && this.pair.includes(actor) && !actor.tag);
      const short = [agents && actor.tag, named && String(actor.id)].filter(Boolean).join(" ");
      const words = actor.id === this.state.lit ? actor.title : short;
      if (words && actor.states[this.state.frame] !== null) this.writeBeside(words, this.extent(actor), actor.color);
    }
    if (!agents) return;
    for (const agent of this.data.agents.filter((each) => !this.actorOf(each))) {
      const [x, y] = this.at(agent.poses[this.state.frame]);
      this.writeBeside(agent.short, [x - 5, y - 5, x + 5, y + 5], agent.color);
    }
  }

  /** The actor at a pixel: the nearest of those whose outline is at most some pixels away. */
  actorAt(x, y) {
    let best = null;
    for (const actor of this.data.actors) {
      const state = actor.states[this.state.frame];
      if (state === null) continue;
      const [across, down] = this.at(state).map((each, axis) => [x, y][axis] - each);
      const [cos, sin] = [Math.cos(state[2] / 1000), Math.sin(state[2] / 1000)];
      const [length, width] = this.size(actor);
      const beside = [
        Math.max(0, Math.abs(across * cos - down * sin) - length / 2),
        Math.max(0, Math.abs(across * sin + down * cos) - width / 2),
      ];
      const away = Math.hypot(...beside);
      if (away <= TOUCH && (best === null || away < best.away)) best = { actor, away };
    }
    return best && best.actor;
  }

  drawImpact() {
    const [x, y] = this.at(this.data.impact);
    const pen = this.pen;
    const now = this.data.countdown[this.state.frame] === 0;
    pen.beginPath();
    for (let ray = 0; ray < 8; ray += 1) {
      const [across, down] = [Math.cos((ray * Math.PI) / 4), Math.sin((ray * Math.PI) / 4)];
      const [inner, outer] = now ? [16, 30] : [5, 9];
      pen.moveTo(x + across * inner, y + down * inner);
      pen.lineTo(x + across * outer, y + down * outer);
    }
    // on the red cars the rays need a white casing
    for (const [color, width] of [["#ffffff", 3], [this.data.colors.pair, 0]]) {
      pen.strokeStyle = color;
      pen.lineWidth = width + (now ? 3 : 1.5);
      pen.stroke();
    }
    if (now) this.writeBeside("impact", [x - 30, y - 30, x + 30, y + 30], this.data.colors.pair);
  }

  // Where an alarm has the pair at the impact: thin rings, which the actors hide.
  drawPlaces(alarm) {
    const pen = this.pen;
    pen.strokeStyle = this.verdictColor(alarm);
    pen.lineWidth = 1;
    pen.setLineDash([3, 2]);
    for (const [x, y] of alarm.places.map((place) => this.at(place))) {
      pen.beginPath();
      pen.arc(x, y, RING * this.scale, 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.setLineDash([]);
  }

  // What alarms say, beside the places where they expect the impact; a line leads there, and ends before the crash.
  drawAlarms(alarms) {
    const pen = this.pen;
    for (const alarm of this.joined(alarms)) {
      const [one, other] = alarm.places.map((place) => this.at(place));
      const [x, y] = [(one[0] + other[0]) / 2, (one[1] + other[1]) / 2];
      const ring = RING * this.scale;
      const reach = 2 * ring + 12;
      const words = `${alarm.right ? "✓" : "✗"} ${alarm.by.join(" ")} ${alarm.time.toFixed(1)} s${alarm.names}`;
      const color = this.verdictColor(alarm);
      const box = this.writeBeside(words, [x - reach, y - reach, x + reach, y + reach], color);
      const [across, down] = [0, 1].map((axis) => Math.min(Math.max([x, y][axis], box[axis]), box[axis + 2]));
      const share = Math.min(1, (1.5 * ring) / Math.max(Math.hypot(across - x, down - y), 1));
      pen.beginPath();
      pen.moveTo(across, down);
      pen.lineTo(x + (across - x) * share, y + (down - y) * share);
      pen.stroke();
    }
  }

  // Agents that foresee the same have one alarm; actors are named unless they are those who collide.
  joined(alarms) {
    const pair = this.pair.map((actor) => actor.id);
    const byWords = new Map();
    for (const alarm of alarms) {
      const right = alarm.actors.length === 2 && alarm.actors.every((id) => pair.includes(id));
      const names = alarm.actors.length && !right ? `: ${alarm.actors.join(", ")}` : "";
      const middle = [0, 1].map((axis) => Math.round((alarm.places[0][axis] + alarm.places[1][axis]) / 400));
      const key = [alarm.right, alarm.time, names, ...middle].join(" ");
      if (byWords.has(key)) byWords.get(key).by.push(alarm.short);
      else byWords.set(key, { ...alarm, names, by: [alarm.short] });
    }
    return [...byWords.values()];
  }

  verdictColor(alarm) {
    return alarm.right ? this.data.colors.right : this.data.colors.false;
  }

  // Write dark words on a white chip beside a rectangle, where they hide the least; the chip's place.
  writeBeside(words, [left, top, right, bottom], color) {
    const pen = this.pen;
    pen.font = FONT;
    const [wide, tall] = [pen.measureText(words).width + 8, 16];
    let best = null;
    for (let ring = 0; ring < 5 && (best === null || best.cost > 0); ring += 1) {
      const gap = 3 + ring * (tall + 2);
      for (const [across, down] of SIDES) {
        const x = (left + right) / 2 + across * ((right - left) / 2 + gap + wide / 2);
        const y = (top + bottom) / 2 + down * ((bottom - top) / 2 + gap + tall / 2);
        const box = [x - wide / 2, y - tall / 2, x + wide / 2, y + tall / 2];
        const outside = box[0] < 0 || box[1] < 0 || box[2] > this.width || box[3] > this.height;
        const cost = this.taken.reduce((sum, each) => sum + common(box, each), outside ? 1e5 : 0);
        if (best === null || cost < best.cost) best = { box, cost };
      }
    }
    this.taken.push(best.box);
    const [x, y] = best.box;
    pen.beginPath();
    pen.roundRect(x, y, wide, tall, 3);
    pen.fillStyle = "#ffffffe6";
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = color;
    pen.stroke();
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillStyle = INK;
    pen.fillText(words, x + wide / 2, y + tall / 2 + 0.5);
    return best.box;
  }
}

// The area that two rectangles have in common.
function common(one, other) {
  const across = Math.min(one[2], other[2]) - Math.max(one[0], other[0]);
  const down = Math.min(one[3], other[3]) - Math.max(one[1], other[1]);
  return across > 0 && down > 0 ? across * down : 0;
}
