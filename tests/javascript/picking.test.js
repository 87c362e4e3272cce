import assert from "node:assert/strict";
import { test } from "node:test";
import { MapView } from "../../deepaccident_devkit/support/templates/replay/map_view.js";
import { Orbit } from "../../deepaccident_devkit/support/templates/replay/orbit.js";
import {
  actorInPicture,
  actorInSpace,
  actorOnMap,
  distanceToBox,
} from "../../deepaccident_devkit/support/templates/replay/picking.js";
import { actor, QUARTER_TURN, state } from "./scene.js";

const AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];

// the map: 10 pixels a metre, the origin at 100, 50

const MAP = Object.assign(new MapView(), { scale: 10, width: 200, height: 100 });

function onMap(actors, x, y, frame = 0) {
  return actorOnMap(actors, frame, MAP, {}, x, y)?.id ?? null;
}

test("an actor is picked inside of its outline and up to 6 pixels beside it", () => {
  const actors = [actor(1, state(0, 0))]; // 40 × 20 pixels
  assert.deepEqual([100, 120, 126, 127].map((x) => onMap(actors, x, 50)), [1, 1, 1, null]);
  assert.deepEqual([40, 34, 33].map((y) => onMap(actors, 100, y)), [1, 1, null]);
  assert.equal(onMap(actors, 125, 65), null); // the corner: 5 and 5 pixels are more than 6
});

test("the outline is turned with the actor", () => {
  const actors = [actor(1, state(0, 0, 50, QUARTER_TURN))];
  assert.deepEqual([onMap(actors, 100, 25), onMap(actors, 118, 50)], [1, null]);
  const diagonal = [actor(1, state(0, 0, 50, QUARTER_TURN / 2))];
  assert.deepEqual([onMap(diagonal, 115, 35), onMap(diagonal, 115, 65)], [1, null]);
});

test("of overlapping outlines the first one is picked, else the nearest", () => {
  const actors = [actor(1, state(0, 0)), actor(2, state(100, 0)), actor(3, state(0, -250))];
  assert.equal(onMap(actors, 105, 50), 1); // inside of 1 and 2
  assert.equal(onMap(actors, 125, 50), 2); // inside of 2, beside 1
  assert.equal(onMap(actors, 100, 64), 3); // 1 pixel beside 3, 4 beside 1
});

test("an actor that is not annotated at the frame is not picked", () => {
  const actors = [actor(1, state(0, 0), null)];
  assert.deepEqual([onMap(actors, 100, 50, 0), onMap(actors, 100, 50, 1), onMap([], 100, 50)], [1, null, null]);
});

// the scene, from 100 m straight above

const ABOVE = Object.assign(new Orbit(), { numbers: [0, 0, 0, -Math.PI / 2, Math.PI / 2, 100] });

function inSpace(actors, point, frame = 0) {
  const [x, y] = ABOVE.pixel(point, 400, 200);
  return actorInSpace(actors, frame, ABOVE, x, y, 400, 200)?.id ?? null;
}

test("in the scene the nearest box on the ray is picked", () => {
  const actors = [actor(1, state(0, 0, 50)), actor(2, state(0, 0, 500)), actor(3, state(3000, 0, 50))];
  assert.equal(inSpace(actors, [0, 0, 0]), 2);
  assert.equal(inSpace(actors, [30, 0, 0.5]), 3);
  assert.equal(inSpace(actors, [0, 30, 0]), null);
});

test("in the scene a box is picked up to 6 pixels beside it", () => {
  const actors = [actor(1, state(0, 0, 50))]; // 6 pixels are 6 × 96.6 / 200 = 2.9 m
  assert.deepEqual([4.7, 5.1].map((x) => inSpace(actors, [x, 0, 0.5])), [1, null]);
});

test("in the scene an actor that is not annotated is not picked", () => {
  assert.equal(inSpace([actor(1, null)], [0, 0, 0]), null);
});

test("a ray meets a box at its nearest face", () => {
  assert.equal(distanceToBox(AXES, [1, 1, 1], [5, 0, 0], [1, 0, 0]), 4);
  assert.equal(distanceToBox(AXES, [1, 1, 1], [5, 0, 0], [0.5, 0, 0]), 8);
  assert.equal(distanceToBox(AXES, [1, 1, 1], [4, 4, 0], [1, 1, 0]), 3);
});

test("a ray that begins in a box meets it at once", () => {
  assert.equal(distanceToBox(AXES, [1, 1, 1], [0.5, 0, 0], [1, 0, 0]), 0);
});

test("a ray misses boxes behind it and beside it", () => {
  assert.equal(distanceToBox(AXES, [1, 1, 1], [-5, 0, 0], [1, 0, 0]), null);
  assert.equal(distanceToBox(AXES, [1, 1, 1], [5, 2, 0], [1, 0, 0]), null);
  assert.equal(distanceToBox(AXES, [1, 1, 1], [5, 0, 0], [1, 0.5, 0]), null);
});

test("in a picture the nearest of overlapping boxes is picked", () => {
  const boxes = [
    { actor: actor(1), place: [0, 0, 100, 100], distance: 2000 },
    { actor: actor(2), place: [50, 50, 150, 150], distance: 1000 },
  ];
  const pixels = [[10, 10], [60, 60], [100, 100], [150, 150], [151, 60]];
  const picked = pixels.map(([x, y]) => actorInPicture(boxes, x, y)?.id);
  assert.deepEqual(picked, [1, 2, 2, 2, undefined]);
  assert.equal(actorInPicture([], 0, 0), null);
});
