import assert from "node:assert/strict";
import { test } from "node:test";
import {
  gridStep,
  MapView,
  middleOf,
  multiples,
  shapeOf,
} from "../../deepaccident_devkit/support/templates/replay/map_view.js";
import { actor, assertClose, QUARTER_TURN, state } from "./scene.js";

function view(x, y, scale, width = 200, height = 100) {
  return Object.assign(new MapView(), { x, y, scale, width, height });
}

test("x is to the right and y up", () => {
  assert.deepEqual(view(10, 20, 5).pixel([1000, 2000]), [100, 50]);
  assert.deepEqual(view(10, 20, 5).pixel([1100, 2200]), [105, 40]);
});

test("all places are shown with a margin, on the smaller side of the canvas", () => {
  const map = new MapView();
  map.showAll([[0, -1000], [10000, 1000]]);
  assert.deepEqual([map.x, map.y, map.span], [50, 0, 116]);
  map.fit(232, 58);
  assert.equal(map.scale, 0.5);
});

test("a single place is shown with 30 metres around it", () => {
  const map = new MapView();
  map.showAll([[500, 500]]);
  assert.deepEqual([map.x, map.y, map.span], [5, 5, 46]);
});

test("a canvas of another size keeps the scale", () => {
  const map = view(0, 0, 5);
  map.fit(400, 300);
  assert.deepEqual([map.scale, map.width, map.height], [5, 400, 300]);
});

test("a canvas that was hidden is fitted when it is shown", () => {
  const map = new MapView();
  map.showAll([[0, 0], [10000, 0]]);
  map.fit(0, 0);
  map.fit(116, 116);
  assert.equal(map.scale, 1);
});

test("the pair is in the middle", () => {
  const map = view(0, 0, 5, 132, 66);
  map.showPair(state(0, 0), state(2000, 1000));
  assert.deepEqual([map.x, map.y, map.scale], [10, 5, 1]);
});

test("zooming has limits, and moving follows the pointer", () => {
  const map = view(0, 0, 5);
  map.move(10, 20);
  assert.deepEqual([map.x, map.y], [-2, 4]);
  map.zoom(2);
  assert.equal(map.scale, 10);
  map.zoom(100);
  assert.equal(map.scale, 120);
  map.zoom(1e-6);
  assert.equal(map.scale, 0.5);
});

test("small actors stay large enough to be found", () => {
  assert.deepEqual(view(0, 0, 10).size(actor(1), ""), [40, 20]);
  assert.deepEqual(view(0, 0, 1).size(actor(1), ""), [5, 5]);
  assert.deepEqual(view(0, 0, 1).size(actor(1), "circle"), [9, 9]);
});

test("the extent of an actor follows its yaw", () => {
  assertClose(view(0, 0, 10).extent(actor(1), state(0, 0), ""), [80, 40, 120, 60]);
  assertClose(view(0, 0, 10).extent(actor(1), state(0, 0, 0, QUARTER_TURN), ""), [90, 30, 110, 70]);
});

test("only some categories have marks", () => {
  const markers = { cyclist: "D", pedestrian: "o", motorcycle: "^", other: "x" };
  const categories = ["cyclist", "pedestrian", "motorcycle", "other", "car"];
  const shapes = categories.map((category) => shapeOf({ ...actor(1), category }, markers));
  assert.deepEqual(shapes, ["diamond", "circle", "triangle", "", ""]);
});

test("the lines of the grid are at least 24 pixels apart", () => {
  assert.deepEqual([100, 2.4, 1.2, 0.5].map((scale) => gridStep(10, scale)), [10, 10, 20, 80]);
  assert.deepEqual(multiples(-12, 25, 10), [-10, 0, 10, 20]);
});

test("the middle of two places", () => {
  assert.deepEqual(middleOf([[0, 10], [4, -20]]), [2, -5]);
  assert.deepEqual(middleOf([[3, 4]]), [3, 4]);
});
