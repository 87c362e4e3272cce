// The scene in three dimensions: clouds, boxes with headings and trails, cameras, and names.

import { actorOf, agentByNumber, isSeen, linesAt } from "./actors.js";
import { centreInMetres, cornersOf, EDGES, FACES } from "./boxes.js";
import { cameraOf, cards } from "./cameras.js";
import { changed, channelsOf, lightened, mixed } from "./colors.js";
import { data, ground, last, pair, sources } from "./data.js";
import { byId, made } from "./elements.js";
import { Gpu, Numbers } from "./gpu.js";
import { placeOver } from "./labels.js";
import { GRID_METRES, map, roadImage, TRAIL_FRAMES } from "./map.js";
import { RING_METRES } from "./map_view.js";
import { Orbit } from "./orbit.js";
import { actorInSpace } from "./picking.js";
import { eyeOf, frustumCorners } from "./projection.js";
import { state } from "./state.js";

/** @import { Kind } from "./gpu.js" */
/** @import { Actor, ActorState, Agent, Camera, Color, Point, Rectangle, SceneView, Vector } from "./types.js" */

const GRID_REACH = 60; // metres around the middle
const FRUSTUM_DEPTH = { large: 9, small: 4 }; // metres
const HEIGHTS = [-1, 6]; // metres above the ground, from the first to the last of the colours
const SHADE = 0.85; // yellow on white would be too pale
const POINT_NEAR = 60; // metres: a point that far away is a pixel wide, nearer ones more
const POLE_HEIGHT = 4; // metres
/** @type {Kind[]} */
const ORDER = ["points", "lines", "faces"];

/** @implements {SceneView} */
class Space {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.orbit = new Orbit();
    this.zoomed = 1; // by the reader
    /** @type {Record<Kind, Numbers>} */
    this.kinds = { points: new Numbers(), lines: new Numbers(), faces: new Numbers(), picture: new Numbers() };
    /** @type {Map<number, Int16Array | null>} the cloud of each agent that is shown while the next one is loaded */
    this.lastClouds = new Map();
    /** @type {Map<number, { cloud: Int16Array, look: string, points: Float32Array }>} what is drawn of each agent's cloud */
    this.drawnClouds = new Map();
    /** @type {Gpu | null} */
    this.gpu = null;
    this.isWaiting = false; // for the screen's next picture
    this.isDark = false;
    /** @type {Color} */
    this.ink = [0, 0, 0];
    this.setOut();
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.gpu = null;
    });
    canvas.addEventListener("webglcontextrestored", () => this.begin());
    roadImage?.addEventListener("load", () => this.paintRoad());
  }

  /** Begin to draw, and return whether this browser can. */
  begin() {
    const gl = this.canvas.getContext("webgl2", { antialias: true, alpha: true });
    if (gl === null || gl.isContextLost()) return false;
    if (this.gpu === null) this.gpu = new Gpu(gl);
    this.paintRoad();
    return true;
  }

  paintRoad() {
    if (roadImage?.naturalWidth) this.gpu?.paint(roadImage);
    this.draw();
  }

  /** Give the graphics processor's memory back. */
  end() {
    this.gpu?.free();
    this.gpu = null;
  }

  /** Look at the whole scene from behind the first agent. */
  setOut() {
    this.orbit.turn = data.agents[0].poses[last][2] / 1000 + Math.PI - 0.35;
    this.orbit.rise = 0.5;
    this.zoomed = 1;
    this.orbit.target = this.onGround(map.view.x, map.view.y);
    this.orbit.distance = 0.65 * map.view.span;
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} height above the ground
   * @returns {Vector}
   */
  onGround(x, y, height = 0) {
    return [x, y, ground.heightAt(x, y) + height];
  }

  fromAbove() {
    this.orbit.turnDown();
    this.draw();
  }

  /** @param {number} factor */
  zoom(factor) {
    this.zoomed *= factor;
    this.orbit.zoom(factor);
  }

  /** @param {number[]} numbers as in `data-view` */
  setView(numbers) {
    this.orbit.numbers = numbers;
  }

  /** Draw once before the screen's next picture, however often it is asked for. */
  draw() {
    if (this.isWaiting || !this.gpu) return;
    this.isWaiting = true;
    requestAnimationFrame(() => {
      this.isWaiting = false;
      this.drawNow();
    });
  }

  /** Draw without waiting for the screen's next picture. */
  drawNow() {
    if (this.gpu && this.canvas.clientWidth) this.render(this.gpu);
  }

  /** Look at whom the reader follows; at the pair as closely as the map does. */
  follow() {
    const pose = agentByNumber(state.follow, data.agents)?.poses[state.frame];
    if (pose) this.look(pose[0] / 100, pose[1] / 100, 34);
    if (state.follow !== "pair") return;
    const [one, other] = pair.map((actor) => actor.states[state.frame]).filter((position) => position !== null);
    if (!one || !other) return;
    const apart = Math.hypot(one[0] - other[0], one[1] - other[1]) / 100;
    this.look((one[0] + other[0]) / 200, (one[1] + other[1]) / 200, 1.1 * apart + 24);
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} distance
   */
  look(x, y, distance) {
    this.orbit.target = this.onGround(x, y);
    this.orbit.setDistance(distance / this.zoomed);
  }

  /** @param {Gpu} gpu */
  render(gpu) {
    const ratio = state.sharpness * (window.devicePixelRatio || 1);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const [wide, tall] = [Math.round(width * ratio), Math.round(height * ratio)];
    const hasOtherSize = this.canvas.width !== wide || this.canvas.height !== tall;
    if (hasOtherSize) Object.assign(this.canvas, { width: wide, height: tall });
    this.follow();
    this.ink = inkOf(this.canvas);
    this.isDark = this.ink[0] > 0.5;
    this.collect();
    for (const kind of [...ORDER, /** @type {Kind} */ ("picture")]) gpu.fill(kind, this.kinds[kind]);
    gpu.begin(this.orbit.matrix(width / height), [wide, tall], ratio);
    gpu.draw("picture", { shade: this.isDark ? 0.34 : 1 });
    for (const kind of ORDER) gpu.draw(kind, kind === "points" ? { near: POINT_NEAR } : {});
    this.canvas.dataset.view = this.orbit.numbers.join(" ");
    this.writeNames(width, height);
  }

  /** Collect what is drawn at the frame. */
  collect() {
    for (const numbers of Object.values(this.kinds)) numbers.count = 0;
    this.addRoad();
    this.addGrid();
    this.addPoints();
    if (state.layers.trails) for (const actor of data.actors) this.addTrail(actor);
    for (const actor of data.actors) this.addActor(actor);
    this.addAgents();
    this.addSights();
    if (state.layers.prediction) this.addForeseen();
    if (data.impact) this.addImpact(data.impact);
  }

  /**
   * Return the colour of thin lines and points; on a dark page it is lighter. Boxes keep their colours.
   * @param {string} color
   */
  thin(color) {
    return this.isDark ? lightened(channelsOf(color)) : channelsOf(color);
  }

  /**
   * @param {Vector} from
   * @param {Vector} to
   * @param {Color} color
   * @param {number} width
   * @param {number} alpha
   */
  line(from, to, color, width = 1, alpha = 1) {
    this.kinds.lines.add(...from, ...to, ...color, alpha, width);
  }

  /**
   * @param {Vector[]} corners
   * @param {Color} color
   * @param {number} alpha
   */
  triangle(corners, color, alpha) {
    for (const corner of corners) this.kinds.faces.add(...corner, ...color, alpha);
  }

  addRoad() {
    if (!data.road || !state.layers.road) return;
    const { left, top, width, height } = data.road;
    for (const [right, down] of [[0, 0], [1, 0], [0, 1], [0, 1], [1, 0], [1, 1]]) {
      const point = this.onGround((left + right * width) / 100, (top - down * height) / 100);
      this.kinds.picture.add(...point, right, down);
    }
  }

  addGrid() {
    const [x, y] = this.orbit.target.map((coordinate) => Math.round(coordinate / GRID_METRES) * GRID_METRES);
    const color = channelsOf(data.colors.grid);
    const at = (/** @type {number} */ across, /** @type {number} */ along) => this.onGround(across, along, 0.03);
    for (let step = -GRID_REACH; step <= GRID_REACH; step += GRID_METRES) {
      this.line(at(x + step, y - GRID_REACH), at(x + step, y + GRID_REACH), color, 1, 0.25);
      this.line(at(x - GRID_REACH, y + step), at(x + GRID_REACH, y + step), color, 1, 0.25);
    }
  }

  /** Add LiDAR points, in the colours of their agents or by their height above the ground. */
  addPoints() {
    const missing = [];
    const heights = data.colors.heights.map((color) => changed(this.thin(color), (channel) => SHADE * channel));
    for (const number of state.clouds) {
      const cloud = this.cloud(number);
      const agent = data.agents[number];
      if (cloud) this.kinds.points.addAll(this.drawnCloud(number, cloud, this.thin(agent.color), heights));
      else if (cloud === null) missing.push(agent.title);
    }
    byId("space-note").textContent = missing.length ? `No LiDAR at this frame: ${missing.join(", ")}` : "";
  }

  /**
   * Return the places and colours of a cloud's points; they are kept, since the scene is drawn often at one frame.
   * @param {number} agent
   * @param {Int16Array} cloud
   * @param {Color} color
   * @param {Color[]} heights
   */
  drawnCloud(agent, cloud, color, heights) {
    const look = `${state.pointsBy} ${this.isDark}`;
    const drawn = this.drawnClouds.get(agent);
    if (drawn?.cloud === cloud && drawn.look === look) return drawn.points;
    const points = new Float32Array((cloud.length / 3) * 7);
    for (let index = 0, at = 0; index < cloud.length; index += 3, at += 7) {
      const [x, y, z] = [cloud[index] / 100, cloud[index + 1] / 100, cloud[index + 2] / 100];
      const share = (z - ground.heightAt(x, y) - HEIGHTS[0]) / (HEIGHTS[1] - HEIGHTS[0]);
      points.set([x, y, z], at);
      points.set(state.pointsBy === "height" ? mixed(heights, share) : color, at + 3);
      points[at + 6] = 1;
    }
    this.drawnClouds.set(agent, { cloud, look, points });
    return points;
  }

  /**
   * Return an agent's cloud; while a server has not given it yet, the one before.
   * @param {number} agent
   */
  cloud(agent) {
    const cloud = sources.points(agent, state.frame);
    if (cloud !== undefined) this.lastClouds.set(agent, cloud);
    return this.lastClouds.get(agent);
  }

  /** @param {Actor} actor */
  addTrail(actor) {
    const color = channelsOf(actor.color);
    /** @type {(of: ActorState) => Vector} */
    const pointOf = (of) => [of[0] / 100, of[1] / 100, (of[4] - actor.height / 2) / 100 + 0.08];
    const newest = state.frame;
    for (let frame = Math.max(1, newest - TRAIL_FRAMES + 1); frame <= newest; frame += 1) {
      const [before, after] = [actor.states[frame - 1], actor.states[frame]];
      if (before === null || after === null || (before[0] === after[0] && before[1] === after[1])) continue;
      const alpha = 0.15 + 0.7 * (1 - (newest - frame) / TRAIL_FRAMES);
      this.line(pointOf(before), pointOf(after), color, actor.role === "other" ? 1.2 : 2, alpha);
    }
  }

  /**
   * Add a glass box whose front is darker, with an arrow on its roof.
   * @param {Actor} actor
   */
  addActor(actor) {
    const now = actor.states[state.frame];
    if (now === null) return;
    const corners = cornersOf(actor, now).map((corner) => changed(corner, (coordinate) => coordinate / 100));
    const color = channelsOf(actor.color);
    const thick = actor.role === "other" ? 0.7 : 1.2;
    const isLit = actor.id === state.lit;
    for (const [from, to] of isLit ? EDGES : []) this.line(corners[from], corners[to], this.ink, thick + 2);
    for (const [from, to] of EDGES) this.line(corners[from], corners[to], color, thick);
    for (const [number, [a, b, c, d]] of FACES.entries()) {
      const alpha = (actor.role === "other" ? 0.18 : 0.32) + (number ? 0 : 0.3);
      for (const triangle of [[a, b, c], [a, c, d]]) this.triangle(triangle.map((corner) => corners[corner]), color, alpha);
    }
    const middle = (/** @type {number} */ one, /** @type {number} */ other) => middleOf(corners[one], corners[other]);
    this.triangle([middle(0, 1), middle(0, 4), middle(1, 5)], color, 0.85);
  }

  /** Add each agent's camera that is shown beside, and the pole of the infrastructure. */
  addAgents() {
    for (const card of cards) {
      const camera = cameraOf(card);
      const color = this.thin(card.agent.color);
      if (camera) this.addFrustum(camera, color, card.figure.classList.contains("large"));
      if (actorOf(card.agent, data.actors, state.frame)) continue;
      const [x, y] = card.agent.poses[state.frame];
      const foot = this.onGround(x / 100, y / 100);
      const top = camera ? camera.poses[state.frame][2] / 100 : foot[2] + POLE_HEIGHT;
      this.line(foot, [foot[0], foot[1], top], color, 2);
    }
  }

  /**
   * @param {Camera} camera
   * @param {Color} color
   * @param {boolean} isLarge
   */
  addFrustum(camera, color, isLarge) {
    const pose = camera.poses[state.frame];
    const eye = eyeOf(pose);
    const corners = frustumCorners(camera, pose, isLarge ? FRUSTUM_DEPTH.large : FRUSTUM_DEPTH.small);
    for (const [number, corner] of corners.entries()) {
      const next = corners[(number + 1) % 4];
      this.line(eye, corner, color, isLarge ? 0.9 : 0.6, 0.9);
      this.line(corner, next, color, isLarge ? 0.9 : 0.6, 0.9);
      if (isLarge) this.triangle([eye, corner, next], color, 0.06);
    }
  }

  /** Add lines from the agents to what they see: those that the reader chose, and to the highlighted actor. */
  addSights() {
    for (const [number, agent] of data.agents.entries()) {
      const own = actorOf(agent, data.actors, state.frame)?.states[state.frame];
      const [x, y] = agent.poses[state.frame];
      const from = this.onGround(x / 100, y / 100, POLE_HEIGHT);
      if (own) from[2] = own[4] / 100;
      for (const actor of data.actors) {
        const isShown = state.sight === "all" || state.sight === String(number) || actor.id === state.lit;
        const now = actor.states[state.frame];
        if (!isShown || now === null || !isSeen(actor, state.frame, number)) continue;
        this.line(from, centreInMetres(now), this.thin(agent.color), 0.7, 0.7);
      }
    }
  }

  addForeseen() {
    for (const { points, color } of state.foreseen.flatMap((sample) => sample.places)) {
      for (const [x, y] of points) this.addRing(x / 100, y / 100, this.thin(color));
    }
    for (const { points, color, opacity = 1, dashed, filled } of linesAt(state.foreseen, state.frame)) {
      const corners = points.map(([x, y]) => this.onGround(x / 100, y / 100, 0.2));
      for (const [number, corner] of filled ? corners.slice(2).entries() : []) {
        this.triangle([corners[0], corners[number + 1], corner], this.thin(color), 0.3 * opacity);
      }
      for (const [number, corner] of corners.slice(1).entries()) {
        this.line(corners[number], corner, this.thin(color), dashed ? 1.5 : 3, 0.2 + 0.8 * opacity);
      }
    }
  }

  /**
   * Return a place beside another one, just above the ground.
   * @param {number} x
   * @param {number} y
   * @param {number} reach
   * @param {number} angle
   */
  beside(x, y, reach, angle) {
    return this.onGround(x + reach * Math.cos(angle), y + reach * Math.sin(angle), 0.15);
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {Color} color
   */
  addRing(x, y, color) {
    const at = (/** @type {number} */ step) => this.beside(x, y, RING_METRES, (step * Math.PI) / 12);
    for (let step = 0; step < 24; step += 2) this.line(at(step), at(step + 1.3), color, 1);
  }

  /** @param {Point} point */
  addImpact(point) {
    const [x, y] = [point[0] / 100, point[1] / 100];
    const [inner, outer] = data.countdown[state.frame] === 0 ? [2.5, 5] : [0.6, 1.4];
    const color = channelsOf(data.colors.pair);
    for (let ray = 0; ray < 8; ray += 1) {
      const angle = (ray * Math.PI) / 4;
      this.line(this.beside(x, y, inner, angle), this.beside(x, y, outer, angle), color, 1.5);
    }
  }

  /**
   * Return the names of the pair, the agents and the highlighted actor, and where they stand.
   */
  names() {
    const { agents, ids } = state.layers;
    const names = [];
    for (const actor of data.actors) {
      const now = actor.states[state.frame];
      if (now === null) continue;
      const isLit = actor.id === state.lit;
      const hasId = ids || isLit || (agents && actor.role === "pair" && !actor.tag);
      const words = isLit ? actor.title : [agents && actor.tag, hasId && actor.id].filter(Boolean).join(" ");
      /** @type {Vector} */
      const top = [now[0] / 100, now[1] / 100, (now[4] + actor.height / 2) / 100];
      if (words) names.push({ words, top, color: actor.color, isLit });
    }
    for (const agent of data.agents) {
      if (!agents || actorOf(agent, data.actors, state.frame)) continue;
      const [x, y] = agent.poses[state.frame];
      const top = this.onGround(x / 100, y / 100, POLE_HEIGHT + 0.5);
      names.push({ words: agent.short, top, color: agent.color, isLit: false });
    }
    return names.sort((one, other) => Number(other.isLit) - Number(one.isLit));
  }

  /**
   * Write names above what they name; one that would lie on another goes higher.
   * @param {number} width
   * @param {number} height
   */
  writeNames(width, height) {
    /** @type {Rectangle[]} */
    const occupied = [];
    const labels = [];
    for (const { words, top, color, isLit } of this.names()) {
      const pixel = this.orbit.pixel(top, width, height);
      const wide = 7 * words.length + 12;
      const rectangle = pixel && placeOver(pixel, wide, occupied, [width, height]);
      if (!rectangle) continue;
      occupied.push(rectangle);
      const label = made("span", { className: isLit ? "tag lit" : "tag", textContent: words });
      const [x, y] = rectangle;
      Object.assign(label.style, { left: `${x}px`, top: `${y}px`, width: `${wide}px`, borderColor: color });
      labels.push(label);
    }
    byId("space-names").replaceChildren(...labels);
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  actorAt(x, y) {
    return actorInSpace(data.actors, state.frame, this.orbit, x, y, this.canvas.clientWidth, this.canvas.clientHeight);
  }
}

/**
 * @param {Vector} one
 * @param {Vector} other
 * @returns {Vector}
 */
function middleOf(one, other) {
  return [(one[0] + other[0]) / 2, (one[1] + other[1]) / 2, (one[2] + other[2]) / 2];
}

/**
 * Return the colour of an element's letters.
 * @param {Element} element
 * @returns {Color}
 */
function inkOf(element) {
  const [red, green, blue] = getComputedStyle(element).color.match(/[\d.]+/g) ?? [0, 0, 0];
  return [Number(red) / 255, Number(green) / 255, Number(blue) / 255];
}

export const space = new Space(byId("space", HTMLCanvasElement));
