"use strict";

// The scene from above, rendered on a canvas: x of the world to the right, y up. Data are centimetres and milliradians.

const TRAIL_FRAMES = 20;
const GRID_METRES = 10;
const LEAST_SPAN = 30;
const LEAST_PIXELS = 4;
const ZOOM_STEP = 1.25;
const ZOOM_RANGE = [0.5, 120];

class Ground {
  constructor(canvas, data, state) {
    this.canvas = canvas;
    this.data = data;
    this.state = state;
    this.pen = canvas.getContext("2d");
    this.clouds = (data.points || []).map((coded) => (coded === null ? null : decodedCloud(coded)));
    this.showWhole();
  }

  // All agents' paths and the colliding pair's, in metres.
  showWhole() {
    const pair = this.data.actors.filter((actor) => actor.role === "pair");
    const states = [...this.data.agents.flatMap((agent) => agent.poses), ...pair.flatMap((actor) => actor.states)];
    const places = states.filter((each) => each !== null);
    const xs = places.map((each) => each[0] / 100);
    const ys = places.map((each) => each[1] / 100);
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    this.x = (left + right) / 2;
    this.y = (low + high) / 2;
    this.span = Math.max(right - left, high - low, LEAST_SPAN) + 16;
    this.scale = null;
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
    this.canvas.dataset.view = [this.x, this.y, this.scale].join(" ");
    this.pen.fillStyle = "#fff";
    this.pen.fillRect(0, 0, this.width, this.height);
    const shown = this.state.layers;
    this.drawGrid();
    if (shown.points) this.drawPoints();
    if (shown.trails) for (const actor of this.data.actors) this.drawTrail(actor);
    this.drawSights();
    for (const actor of [...this.data.actors].reverse()) this.drawActor(actor);
    if (shown.agents) this.data.agents.forEach((agent) => this.drawAgent(agent));
    if (this.data.impact) this.drawImpact();
    if (shown.prediction) this.state.foreseen.forEach((sample) => this.drawForeseen(sample));
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
    this.write(`grid of ${step} m`, 8, this.height - 8, "#666666", "left");
  }

  drawPoints() {
    const cloud = this.clouds[this.state.frame];
    if (!cloud) return;
    this.pen.fillStyle = this.data.colors.points;
    for (let index = 0; index < cloud.length; index += 2) {
      const [x, y] = this.at([cloud[index] * 10, cloud[index + 1] * 10]);
      this.pen.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
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
      if (chosen !== "all" && chosen !== String(bit)) return;
      pen.strokeStyle = agent.color;
      pen.beginPath();
      for (const actor of this.data.actors) {
        if (actor.states[frame] === null || !(actor.seen[frame] & (1 << bit))) continue;
        pen.moveTo(...this.at(agent.poses[frame]));
        pen.lineTo(...this.at(actor.states[frame]));
      }
      pen.stroke();
    });
    pen.globalAlpha = 1;
  }

  // Length and width in pixels: pedestrians stay large enough to be seen.
  size(actor) {
    return [actor.length, actor.width].map((each) => Math.max(LEAST_PIXELS, (each / 100) * this.scale));
  }

  drawActor(actor) {
    const state = actor.states[this.state.frame];
    if (state === null) return;
    const pen = this.pen;
    const [x, y] = this.at(state);
    const [length, width] = this.size(actor);
    const special = actor.role !== "other";
    pen.save();
    pen.translate(x, y);
    pen.rotate(-state[2] / 1000);
    pen.fillStyle = pen.strokeStyle = actor.color;
    pen.globalAlpha = special ? 0.75 : 0.35;
    pen.fillRect(-length / 2, -width / 2, length, width);
    pen.globalAlpha = 1;
    pen.lineWidth = special ? 2 : 1.2;
    pen.strokeRect(-length / 2, -width / 2, length, width);
    pen.strokeStyle = special ? "#ffffff" : actor.color;
    pen.beginPath();
    pen.moveTo(0, 0);
    pen.lineTo(length / 2, 0);
    pen.stroke();
    pen.restore();
    const reach = Math.max(width, 8) / 2 + 7;
    if (this.state.layers.dots) this.drawDots(actor, x, y + reach);
    if (this.state.layers.ids) this.write(String(actor.id), x, y - reach, "#1c1c1c", "center");
  }

  drawDots(actor, x, y) {
    const seen = actor.seen[this.state.frame];
    const seeing = this.data.agents.filter((agent, bit) => seen & (1 << bit));
    seeing.forEach((agent, place) => {
      this.pen.fillStyle = agent.color;
      this.pen.beginPath();
      this.pen.arc(x + (place - (seeing.length - 1) / 2) * 6, y, 2.5, 0, 2 * Math.PI);
      this.pen.fill();
    });
  }

  drawAgent(agent) {
    const [x, y] = this.at(agent.poses[this.state.frame]);
    const pen = this.pen;
    pen.beginPath();
    pen.arc(x, y, 4, 0, 2 * Math.PI);
    pen.fillStyle = agent.color;
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = "#ffffff";
    pen.stroke();
    this.write(agent.short, x + 9, y, "#1c1c1c", "left");
  }

  drawImpact() {
    const [x, y] = this.at(this.data.impact);
    const pen = this.pen;
    const now = this.data.countdown[this.state.frame] === 0;
    pen.strokeStyle = this.data.colors.pair;
    pen.lineWidth = now ? 3 : 1.5;
    pen.beginPath();
    for (let ray = 0; ray < 8; ray += 1) {
      const [across, down] = [Math.cos((ray * Math.PI) / 4), Math.sin((ray * Math.PI) / 4)];
      const [inner, outer] = now ? [16, 30] : [5, 9];
      pen.moveTo(x + across * inner, y + down * inner);
      pen.lineTo(x + across * outer, y + down * outer);
    }
    pen.stroke();
    if (now) this.write("impact", x, y - 40, this.data.colors.pair, "center");
  }

  drawForeseen(sample) {
    const pen = this.pen;
    pen.lineWidth = 2;
    if (sample.truth) {
      pen.strokeStyle = this.data.colors.right;
      for (const place of sample.truth) {
        const [x, y] = this.at(place);
        pen.beginPath();
        pen.arc(x, y, 12, 0, 2 * Math.PI);
        pen.stroke();
      }
    }
    for (const alarm of sample.alarms) {
      const color = alarm.right ? this.data.colors.right : this.data.colors.false;
      pen.strokeStyle = color;
      const ends = alarm.places.map((place) => this.at(place));
      pen.setLineDash([5, 4]);
      pen.beginPath();
      pen.moveTo(...ends[0]);
      pen.lineTo(...ends[1]);
      pen.stroke();
      pen.setLineDash([]);
      pen.beginPath();
      for (const [x, y] of ends) {
        pen.moveTo(x - 6, y - 6);
        pen.lineTo(x + 6, y + 6);
        pen.moveTo(x + 6, y - 6);
        pen.lineTo(x - 6, y + 6);
      }
      pen.stroke();
      this.outline(alarm.actors, color);
    }
  }

  // A dashed frame around the actors that a prediction names.
  outline(ids, color) {
    const pen = this.pen;
    for (const actor of this.data.actors.filter((each) => ids.includes(each.id))) {
      const state = actor.states[this.state.frame];
      if (state === null) continue;
      pen.save();
      pen.translate(...this.at(state));
      pen.rotate(-state[2] / 1000);
      pen.strokeStyle = color;
      pen.setLineDash([4, 3]);
      const [length, width] = this.size(actor).map((each) => each + 10);
      pen.strokeRect(-length / 2, -width / 2, length, width);
      pen.restore();
    }
  }

  write(text, x, y, color, align) {
    const pen = this.pen;
    pen.font = "600 11px system-ui, sans-serif";
    pen.textAlign = align;
    pen.textBaseline = "middle";
    pen.lineWidth = 3;
    pen.strokeStyle = "#ffffffcc";
    pen.strokeText(text, x, y);
    pen.fillStyle = color;
    pen.fillText(text, x, y);
  }
}

// Little-endian int16 from base64: x, y, x, y, …, decimetres.
function decodedCloud(coded) {
  const text = atob(coded);
  const view = new DataView(Uint8Array.from(text, (character) => character.charCodeAt(0)).buffer);
  return Int16Array.from({ length: view.byteLength / 2 }, (_, index) => view.getInt16(2 * index, true));
}
