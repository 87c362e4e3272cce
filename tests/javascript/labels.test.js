import assert from "node:assert/strict";
import { test } from "node:test";
import {
  overlap,
  placeAbove,
  placeBeside,
  placeOver,
} from "../../deepaccident_devkit/support/templates/replay/labels.js";

const CANVAS = [100, 100];

test("rectangles that only touch have nothing in common", () => {
  assert.equal(overlap([0, 0, 10, 10], [5, 8, 20, 20]), 10);
  assert.equal(overlap([0, 0, 10, 10], [10, 0, 20, 10]), 0);
  assert.equal(overlap([0, 0, 10, 10], [20, 20, 30, 30]), 0);
});

test("a label stands above what it names, or on the next side that is free", () => {
  const box = [40, 40, 60, 60];
  const above = placeBeside(box, [20, 10], [], CANVAS);
  assert.deepEqual(above, [40, 27, 60, 37]);
  assert.deepEqual(placeBeside(box, [20, 10], [above], CANVAS), [63, 45, 83, 55]);
});

test("a label is not cut off where another side has room", () => {
  assert.deepEqual(placeBeside([40, 0, 60, 10], [20, 10], [], CANVAS), [63, 0, 83, 10]);
});

test("a label that has no free place hides the least, and is not cut off", () => {
  const box = [40, 40, 60, 60];
  assert.deepEqual(placeBeside(box, [20, 10], [[0, 0, 100, 100]], CANVAS), [40, 27, 60, 37]);
  assert.deepEqual(placeBeside(box, [20, 10], [[0, 0, 100, 81], [0, 83, 100, 100]], CANVAS), [40, 75, 60, 85]);
});

test("a tag is above its box", () => {
  const pixels = [[50, 50], [70, 60]];
  const tag = placeAbove(pixels, [20, 10], [], CANVAS, 1);
  assert.deepEqual(tag, [50, 38, 70, 48]);
  assert.deepEqual(placeAbove(pixels, [20, 10], [tag], CANVAS, 1), [73, 38, 93, 48]);
});

test("a tag stays in the picture, even of a box that is partly outside", () => {
  assert.deepEqual(placeAbove([[-50, -50], [500, 20]], [20, 10], [], CANVAS, 1), [40, 0, 60, 10]);
  assert.deepEqual(placeAbove([[90, 200], [99, 300]], [20, 10], [], CANVAS, 1), [80, 88, 100, 98]);
});

test("a tag without a free place is in the middle", () => {
  assert.deepEqual(placeAbove([[50, 50]], [20, 10], [[0, 0, 100, 100]], CANVAS, 1), [40, 38, 60, 48]);
});

test("a name goes higher where it would lie on another one", () => {
  const name = placeOver([50, 50], 20, [], CANVAS);
  assert.deepEqual(name, [40, 30, 60, 47]);
  assert.deepEqual(placeOver([50, 50], 20, [name], CANVAS), [40, 12, 60, 29]);
});

test("a name that would be cut off is left out", () => {
  assert.equal(placeOver([50, 10], 20, [], CANVAS), null);
  assert.equal(placeOver([5, 50], 20, [], CANVAS), null);
  assert.equal(placeOver([95, 50], 20, [], CANVAS), null);
  assert.equal(placeOver([50, 50], 20, [[0, 0, 100, 100]], CANVAS), null);
});
