import assert from "node:assert/strict";
import { test } from "node:test";
import { axesOf, cornersOf, EDGES, GroundPlane } from "../../deepaccident_devkit/support/templates/replay/boxes.js";
import { actor, assertClose, QUARTER_TURN, state } from "./scene.js";

test("the axes of a level box follow its yaw", () => {
  assertClose(axesOf(state(0, 0)).flat(), [1, 0, 0, 0, 1, 0, 0, 0, 1]);
  assertClose(axesOf(state(0, 0, 0, QUARTER_TURN)).flat(), [0, 1, 0, -1, 0, 0, 0, 0, 1]);
});

test("a box is tilted as its road is", () => {
  assertClose(axesOf([0, 0, 0, 0, 0, 600, 0]).flat(), [0.8, 0, -0.6, 0, 1, 0, 0.6, 0, 0.8]);
  assertClose(axesOf([0, 0, QUARTER_TURN, 0, 0, 600, 0]).flat(), [0, 1, 0, -0.8, 0, 0.6, 0.6, 0, 0.8]);
});

test("the front corners come first", () => {
  const corners = cornersOf(actor(1), state(1000, 2000, 50));
  assert.deepEqual(corners.slice(0, 4).map(([x]) => x), [1200, 1200, 1200, 1200]);
  assert.deepEqual(corners[0], [1200, 2100, 100]);
  assert.deepEqual(corners[6], [800, 1900, 0]);
});

test("an edge joins corners that differ along one axis", () => {
  const corners = cornersOf(actor(1), state(0, 0));
  for (const [from, to] of EDGES) {
    const differing = corners[from].filter((value, axis) => value !== corners[to][axis]);
    assert.equal(differing.length, 1);
  }
});

test("the ground is the plane below the actors", () => {
  const low = (x, y, metres) => state(x * 100, y * 100, metres * 100 + 50);
  const actors = [actor(1, low(0, 0, 1), null), actor(2, low(10, 0, 2)), actor(3, low(0, 10, -1), low(10, 10, 0))];
  const ground = GroundPlane.below(actors);
  assertClose(ground.plane, [1, 0.1, -0.2]);
  assertClose([ground.heightAt(5, 5)], [0.5]);
});

test("the ground below a single actor, and below none, is level", () => {
  assertClose(GroundPlane.below([actor(1, state(300, 400, 250))]).plane, [2, 0, 0]);
  assertClose(GroundPlane.below([actor(1, null)]).plane, [0, 0, 0]);
});
