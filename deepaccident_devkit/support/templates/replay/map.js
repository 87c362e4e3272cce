// The scene from above, on a canvas.

import { actorOf, agentByNumber, isSeen, joinedPlaces, linesAt, seersOf } from "./actors.js";
import { channelsOf, lightened } from "./colors.js";
import { data, pair, sources } from "./data.js";
import { byId } from "./elements.js";
import { placeBeside } from "./labels.js";
import { gridStep, MapView, middleOf, multiples, RING_METRES, shapeOf } from "./map_view.js";
import { actorOnMap } from "./picking.js";
import { state } from "./state.js";

/** @import { JoinedPlace } from "./actors.js" */
/** @import { Actor, ActorState, DrawnLine, Pixel, Point, Rectangle, Road, SceneView } from "./types.js" */

export const TRAIL_FRAMES = 20;
export const GRID_METRES = 10;
const FONT = "600 11px system-ui, sans-serif";
const INK = "#1c1c1c";
const CHIP = "#ffffffe6";
const CASING = "#ffffff";
const PAPER = { light: "#ffffff", dark: "#181818" };
const ROAD_ON_DARK = 0.3; // share of the road's pale colours
const MAP_POINTS = 4000; // of a cloud

const darkScheme = matchMedia("(prefers-color-scheme: dark)");

/** The picture of the road, if there is one. */
export const roadImage = data.road && Object.assign(new Image(), { src: `data:image/png;base64,${data.road.png}` });

/** @implements {SceneView} */
class SceneMap {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    const pen = canvas.getContext("2d");
    if (pen === null) throw new Error("this browser draws nothing on a canvas");
    this.canvas = canvas;
    this.pen = pen;
    this.view = new MapView();
    /** @type {Rectangle[]} where a label would hide something */
    this.occupied = [];
    roadImage?.addEventListener("load", () => this.draw());
    darkScheme.addEventListener("change", () => this.draw());
    this.showWhole();
  }

  /** Show the paths of all agents and of the colliding pair. */
  showWhole() {
    const states = pair.flatMap((actor) => actor.states).filter((position) => position !== null);
    this.view.showAll([...data.agents.flatMap((agent) => agent.poses), ...states]);
  }

  /** @param {number[]} numbers as in `data-view` */
  setView(numbers) {
    this.view.numbers = numbers;
  }

  /** Give the canvas the pixels of the screen. */
  fit() {
    const box = this.canvas.getBoundingClientRect();
    const ratio = state.sharpness * (window.devicePixelRatio || 1);
    this.view.fit(this.canvas.clientWidth || box.width, this.canvas.clientHeight || box.height);
    const [wide, tall] = [Math.round(this.view.width * ratio), Math.round(this.view.height * ratio)];
    if (this.canvas.width !== wide || this.canvas.height !== tall) {
      this.canvas.width = wide;
      this.canvas.height = tall;
    }
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  }

  /** Move to whom the reader follows. The pair stays where it was while one of the two is not annotated. */
  follow() {
    const pose = agentByNumber(state.follow, data.agents)?.poses[state.frame];
    if (pose) [this.view.x, this.view.y] = [pose[0] / 100, pose[1] / 100];
    if (state.follow !== "pair") return;
    const [one, other] = pair.map((actor) => actor.states[state.frame]).filter((position) => position !== null);
    if (one && other) this.view.showPair(one, other);
  }

  draw() {
    this.fit();
    this.follow();
    this.canvas.dataset.view = this.view.numbers.join(" ");
    this.pen.fillStyle = darkScheme.matches ? PAPER.dark : PAPER.light;
    this.pen.fillRect(0, 0, this.view.width, this.view.height);
    const { layers } = state;
    const actors = this.annotated();
    this.occupied = actors.map(([actor, now]) => this.extent(actor, now));
    if (layers.road) this.drawRoad();
    this.drawGrid();
    if (layers.points) this.drawPoints();
    if (layers.trails) for (const actor of data.actors) this.drawTrail(actor);
    this.drawSights();
    const samples = layers.prediction ? state.foreseen : [];
    const lines = linesAt(samples, state.frame);
    const outlines = lines.filter((line) => line.frames && !line.filled);
    for (const line of lines) if (!outlines.includes(line)) this.drawLine(line);
    for (const place of samples.flatMap((sample) => sample.places)) this.drawPlaces(place.points, thin(place.color));
    for (const [actor, now] of [...actors].reverse()) this.drawActor(actor, now);
    for (const line of outlines) this.drawLine(line); // a missed box lies on its actor
    if (layers.agents) this.drawPoles();
    if (data.impact) this.drawImpact(data.impact);
    this.drawNames();
    for (const place of joinedPlaces(samples, data.agents)) if (place.note) this.drawNote(place);
  }

  /**
   * Return the actors that are annotated at the frame, and their states.
   * @returns {[Actor, ActorState][]}
   */
  annotated() {
    return data.actors.flatMap((actor) => {
      const now = actor.states[state.frame];
      return now === null ? [] : [/** @type {[Actor, ActorState]} */ ([actor, now])];
    });
  }

  /** Return the agents that are no actors, such as the infrastructure. */
  poles() {
    return data.agents.filter((agent) => !actorOf(agent, data.actors, state.frame));
  }

  /**
   * @param {Actor} actor
   * @param {ActorState} now
   */
  extent(actor, now) {
    return this.view.extent(actor, now, shapeOf(actor, data.markers));
  }

  drawRoad() {
    if (!data.road || !roadImage) return;
    const { left, top, width, height } = data.road;
    const scale = this.view.scale / 100;
    this.pen.globalAlpha = darkScheme.matches ? ROAD_ON_DARK : 1;
    this.pen.drawImage(roadImage, ...this.view.pixel([left, top]), width * scale, height * scale);
    this.pen.globalAlpha = 1;
  }

  drawGrid() {
    const { pen, view } = this;
    pen.lineWidth = 1;
    pen.strokeStyle = data.colors.grid;
    pen.globalAlpha = darkScheme.matches ? 0.25 : 0.5;
    pen.beginPath();
    const [halfWidth, halfHeight] = [view.width / 2 / view.scale, view.height / 2 / view.scale];
    const step = gridStep(GRID_METRES, view.scale);
    for (const x of multiples(view.x - halfWidth, view.x + halfWidth, step)) {
      const across = view.pixel([x * 100, 0])[0];
      pen.moveTo(across, 0);
      pen.lineTo(across, view.height);
    }
    for (const y of multiples(view.y - halfHeight, view.y + halfHeight, step)) {
      const down = view.pixel([0, y * 100])[1];
      pen.moveTo(0, down);
      pen.lineTo(view.width, down);
    }
    pen.stroke();
    pen.globalAlpha = 1;
    pen.font = FONT;
    pen.textAlign = "left";
    pen.textBaseline = "alphabetic";
    const words = `grid of ${step} m`;
    pen.fillStyle = CHIP;
    pen.fillRect(4, view.height - 20, pen.measureText(words).width + 8, 16);
    pen.fillStyle = INK;
    pen.fillText(words, 8, view.height - 8);
  }

  /** Draw LiDAR points: grey those of one agent, in the agents' colours those of several. */
  drawPoints() {
    for (const agent of state.clouds) {
      const cloud = sources.points(agent, state.frame);
      if (!cloud) continue;
      this.pen.fillStyle = state.clouds.length > 1 ? thin(data.agents[agent].color) : data.colors.points;
      for (let index = 0; index < Math.min(cloud.length, 3 * MAP_POINTS); index += 3) {
        const [x, y] = this.view.pixel([cloud[index], cloud[index + 1]]);
        this.pen.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
      }
    }
  }

  /** @param {Actor} actor */
  drawTrail(actor) {
    const last = state.frame;
    const pen = this.pen;
    pen.strokeStyle = thin(actor.color);
    pen.lineWidth = actor.role === "other" ? 1.5 : 2.5;
    for (let frame = Math.max(1, last - TRAIL_FRAMES + 1); frame <= last; frame += 1) {
      const [before, after] = [actor.states[frame - 1], actor.states[frame]];
      if (before === null || after === null) continue;
      if (before[0] === after[0] && before[1] === after[1]) continue;
      pen.globalAlpha = 0.1 + 0.6 * (1 - (last - frame) / TRAIL_FRAMES);
      pen.beginPath();
      pen.moveTo(...this.view.pixel(before));
      pen.lineTo(...this.view.pixel(after));
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  /** Draw lines from the agents to what they see. */
  drawSights() {
    const pen = this.pen;
    pen.lineWidth = 1.2;
    pen.globalAlpha = 0.55;
    for (const [number, agent] of data.agents.entries()) {
      const isChosen = state.sight === "all" || state.sight === String(number);
      pen.strokeStyle = thin(agent.color);
      pen.beginPath();
      for (const [actor, now] of this.annotated()) {
        if (!isChosen && actor.id !== state.lit) continue;
        if (!isSeen(actor, state.frame, number)) continue;
        pen.moveTo(...this.view.pixel(agent.poses[state.frame]));
        pen.lineTo(...this.view.pixel(now));
      }
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  /**
   * Trace the outline of an actor that heads to the right, around the origin: a box, or the mark of its category.
   * @param {Actor} actor
   */
  trace(actor) {
    const pen = this.pen;
    const shape = shapeOf(actor, data.markers);
    const [length, width] = this.view.size(actor, shape).map((side) => side / 2);
    pen.beginPath();
    if (shape === "circle") pen.arc(0, 0, length, 0, 2 * Math.PI);
    for (const [x, y] of outline(shape, length, width)) pen.lineTo(x, y);
    pen.closePath();
  }

  /**
   * @param {Actor} actor
   * @param {ActorState} now
   */
  drawActor(actor, now) {
    const pen = this.pen;
    const [x, y] = this.view.pixel(now);
    const shape = shapeOf(actor, data.markers);
    const isLit = actor.id === state.lit;
    pen.save();
    pen.translate(x, y);
    pen.rotate(-now[2] / 1000);
    this.trace(actor);
    pen.lineWidth = isLit ? 7 : 4;
    pen.strokeStyle = isLit ? INK : CASING;
    pen.stroke();
    pen.fillStyle = actor.color;
    pen.strokeStyle = actor.color;
    pen.globalAlpha = actor.role === "other" ? 0.55 : 0.75;
    pen.fill();
    pen.globalAlpha = 1;
    pen.lineWidth = actor.role === "other" ? 1.2 : 2;
    pen.stroke();
    if (!shape) {
      pen.strokeStyle = CASING;
      pen.beginPath();
      pen.moveTo(0, 0);
      pen.lineTo(this.view.size(actor, shape)[0] / 2, 0);
      pen.stroke();
    }
    pen.restore();
    if (state.layers.dots) this.drawDots(actor, x, this.extent(actor, now)[3] + 6);
  }

  /**
   * Draw a dot for each agent that sees an actor.
   * @param {Actor} actor
   * @param {number} x
   * @param {number} y
   */
  drawDots(actor, x, y) {
    const agents = seersOf(actor, state.frame, data.agents);
    this.occupied.push([x - 3 * agents.length, y - 3, x + 3 * agents.length, y + 3]);
    for (const [number, agent] of agents.entries()) {
      this.pen.fillStyle = agent.color;
      this.pen.beginPath();
      this.pen.arc(x + (number - (agents.length - 1) / 2) * 6, y, 2.5, 0, 2 * Math.PI);
      this.pen.fill();
    }
  }

  drawPoles() {
    const pen = this.pen;
    for (const agent of this.poles()) {
      const [x, y] = this.view.pixel(agent.poses[state.frame]);
      this.occupied.push(around([x, y], 5));
      pen.beginPath();
      pen.arc(x, y, 5, 0, 2 * Math.PI);
      pen.fillStyle = agent.color;
      pen.fill();
      pen.lineWidth = 1.5;
      pen.strokeStyle = CASING;
      pen.stroke();
    }
  }

  /** Write the agents' letters and, on demand, ids; those of the pair first, so that they get the best places. */
  drawNames() {
    const { agents, ids } = state.layers;
    for (const [actor, now] of this.annotated()) {
      const hasId = ids || (agents && actor.role === "pair" && !actor.tag);
      const short = [agents && actor.tag, hasId && String(actor.id)].filter(Boolean).join(" ");
      const words = actor.id === state.lit ? actor.title : short;
      if (words) this.writeBeside(words, this.extent(actor, now), actor.color);
    }
    if (!agents) return;
    for (const agent of this.poles()) {
      this.writeBeside(agent.short, around(this.view.pixel(agent.poses[state.frame]), 5), agent.color);
    }
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  actorAt(x, y) {
    return actorOnMap(data.actors, state.frame, this.view, data.markers, x, y);
  }

  /** @param {Point} point */
  drawImpact(point) {
    const [x, y] = this.view.pixel(point);
    const pen = this.pen;
    const isNow = data.countdown[state.frame] === 0;
    const [inner, outer] = isNow ? [16, 30] : [5, 9];
    pen.beginPath();
    for (let ray = 0; ray < 8; ray += 1) {
      const [across, down] = [Math.cos((ray * Math.PI) / 4), Math.sin((ray * Math.PI) / 4)];
      pen.moveTo(x + across * inner, y + down * inner);
      pen.lineTo(x + across * outer, y + down * outer);
    }
    // on the red cars the rays need a white casing
    pen.strokeStyle = CASING;
    pen.lineWidth = 3 + (isNow ? 3 : 1.5);
    pen.stroke();
    pen.strokeStyle = data.colors.pair;
    pen.lineWidth = isNow ? 3 : 1.5;
    pen.stroke();
    if (isNow) this.writeBeside("impact", around([x, y], 30), data.colors.pair);
  }

  /**
   * Draw a path, above a ribbon of its width if it has one, or the outline of a box or shape.
   * @param {DrawnLine} line
   */
  drawLine({ points, color, opacity = 1, width = 0, dashed, filled }) {
    const pen = this.pen;
    pen.beginPath();
    for (const point of points) pen.lineTo(...this.view.pixel(point));
    pen.strokeStyle = thin(color);
    pen.lineJoin = "round";
    pen.lineWidth = width * this.view.scale;
    pen.globalAlpha = 0.3 * opacity;
    if (width) pen.stroke();
    pen.fillStyle = thin(color);
    if (filled) pen.fill();
    pen.lineWidth = dashed ? 1.5 : 2.5;
    pen.globalAlpha = 0.2 + 0.8 * opacity;
    if (dashed) pen.setLineDash([5, 3]);
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }

  /**
   * Draw where something is predicted, such as the pair at the impact: thin rings below the actors.
   * @param {Point[]} points
   * @param {string} color
   */
  drawPlaces(points, color) {
    const pen = this.pen;
    pen.strokeStyle = color;
    pen.lineWidth = 1;
    pen.setLineDash([3, 2]);
    for (const point of points) {
      pen.beginPath();
      pen.arc(...this.view.pixel(point), RING_METRES * this.view.scale, 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.setLineDash([]);
  }

  /**
   * Write a note and its agents beside a marked place, with a line that ends before the rings.
   * @param {JoinedPlace} place
   */
  drawNote({ note, by, points, color }) {
    const pen = this.pen;
    const [x, y] = this.view.pixel(middleOf(points));
    const ring = RING_METRES * this.view.scale;
    const box = this.writeBeside(`${by.join(" ")}: ${note}`, around([x, y], 2 * ring + 12), color);
    const across = Math.min(Math.max(x, box[0]), box[2]);
    const down = Math.min(Math.max(y, box[1]), box[3]);
    const share = Math.min(1, (1.5 * ring) / Math.max(Math.hypot(across - x, down - y), 1));
    pen.beginPath();
    pen.moveTo(across, down);
    pen.lineTo(x + (across - x) * share, y + (down - y) * share);
    pen.stroke();
  }

  /**
   * Write dark words on a white chip beside a rectangle, and return the chip's place.
   * @param {string} words
   * @param {Rectangle} rectangle
   * @param {string} color
   */
  writeBeside(words, rectangle, color) {
    const pen = this.pen;
    pen.font = FONT;
    const [wide, tall] = [pen.measureText(words).width + 8, 16];
    const label = placeBeside(rectangle, [wide, tall], this.occupied, [this.view.width, this.view.height]);
    this.occupied.push(label);
    const [x, y] = label;
    pen.beginPath();
    pen.roundRect(x, y, wide, tall, 3);
    pen.fillStyle = CHIP;
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = color;
    pen.stroke();
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillStyle = INK;
    pen.fillText(words, x + wide / 2, y + tall / 2 + 0.5);
    return label;
  }
}

/**
 * Return the colour of thin lines and points; on a dark page it is lighter. Boxes keep their colours.
 * @param {string} color
 */
function thin(color) {
  if (!darkScheme.matches) return color;
  return `rgb(${lightened(channelsOf(color)).map((channel) => Math.round(255 * channel)).join(" ")})`;
}

/**
 * Return the corners of a shape; none of a circle.
 * @param {string} shape
 * @param {number} length half of it
 * @param {number} width half of it
 * @returns {Pixel[]}
 */
function outline(shape, length, width) {
  if (shape === "circle") return [];
  if (shape === "diamond") return [[length, 0], [0, width], [-length, 0], [0, -width]];
  if (shape === "triangle") return [[length, 0], [-length, width], [-length, -width]];
  return [[length, -width], [length, width], [-length, width], [-length, -width]];
}

/**
 * Return the square around a pixel.
 * @param {Pixel} pixel
 * @param {number} reach
 * @returns {Rectangle}
 */
function around([x, y], reach) {
  return [x - reach, y - reach, x + reach, y + reach];
}

export const map = new SceneMap(byId("ground", HTMLCanvasElement));
