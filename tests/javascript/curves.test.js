import assert from "node:assert/strict";
import { test } from "node:test";
import { barExtent, curvePath, known, runs } from "../../deepaccident_devkit/support/templates/replay/curves.js";

test("a curve runs from 1.5 pixels below its upper edge to 1.5 above its lower one", () => {
  assert.equal(curvePath([0, 5, 10], 10, 20), "M0 18.5L1 10.0L2 1.5");
});

test("a curve has gaps where values are unknown", () => {
  assert.equal(curvePath([null, 0, null, 10, 10, null], 10, 20), "M1 18.5M3 1.5L4 1.5");
  assert.equal(curvePath([null, null], 10, 20), "");
});

test("values beyond the limit stay at the upper edge", () => {
  assert.equal(curvePath([20], 10, 20), "M0 1.5");
});

test("runs are from their first to their last frame", () => {
  assert.deepEqual(runs(5, (frame) => frame !== 2), [[0, 1], [3, 5]]);
  assert.deepEqual(runs(5, (frame) => frame === 5), [[5, 5]]);
  assert.deepEqual(runs(5, () => true), [[0, 5]]);
  assert.deepEqual(runs(5, () => false), []);
  assert.deepEqual(runs(0, () => true), [[0, 0]]);
});

test("a bar reaches half a frame beyond its frames, but not beyond the recording", () => {
  assert.deepEqual(barExtent(3, 4, 10), { x: 2.5, width: 2 });
  assert.deepEqual(barExtent(0, 0, 10), { x: 0, width: 0.5 });
  assert.deepEqual(barExtent(10, 10, 10), { x: 9.5, width: 0.5 });
  assert.deepEqual(barExtent(0, 10, 10), { x: 0, width: 10 });
  assert.deepEqual(barExtent(0, 0, 0), { x: 0, width: 0.5 });
});

test("zero is a known value", () => {
  assert.deepEqual(known([null, 0, 1]), [0, 1]);
});
