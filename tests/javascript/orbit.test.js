import assert from "node:assert/strict";
import { test } from "node:test";
import { FIELD_OF_VIEW, Orbit } from "../../deepaccident_devkit/support/templates/replay/orbit.js";
import { assertClose } from "./scene.js";

function orbit(...numbers) {
  return Object.assign(new Orbit(), { numbers });
}

const FROM_ABOVE = orbit(0, 0, 0, -Math.PI / 2, Math.PI / 2, 10);
const FROM_SOUTH = orbit(10, 20, 1, -Math.PI / 2, 0, 30);

test("from above north is up", () => {
  assertClose(FROM_ABOVE.axes.flat(), [1, 0, 0, 0, 1, 0, 0, 0, -1]);
  assertClose(FROM_ABOVE.eye, [0, 0, 10]);
});

test("from the south it looks to the north", () => {
  assertClose(FROM_SOUTH.eye, [10, -10, 1]);
  assertClose(FROM_SOUTH.axes.flat(), [1, 0, 0, 0, 0, 1, 0, 1, 0]);
});

test("the target is in the middle of the picture", () => {
  assertClose(FROM_SOUTH.pixel([10, 20, 1], 400, 200), [200, 100]);
});

test("the field of view is that of the height", () => {
  const reach = 10 * Math.tan(FIELD_OF_VIEW / 2); // at a distance of 10 m from the middle to the upper edge
  assertClose(FROM_ABOVE.pixel([0, reach, 0], 400, 200), [200, 0]);
  assertClose(FROM_ABOVE.pixel([reach, -reach, 0], 400, 200), [300, 200]);
});

test("what is behind the eye, or too near, has no pixel", () => {
  assert.equal(FROM_ABOVE.pixel([0, 0, 20], 400, 200), null);
  assert.equal(FROM_ABOVE.pixel([0, 0, 9.8], 400, 200), null);
  assert.notEqual(FROM_ABOVE.pixel([0, 0, 9.6], 400, 200), null);
});

test("the ray of a pixel leads to what the pixel shows", () => {
  const view = orbit(3, -4, 1, 0.7, 0.4, 25);
  const point = [6, -9, 2];
  const [x, y] = view.pixel(point, 640, 480);
  const ray = view.ray(x, y, 640, 480);
  const distance = (point[2] - view.eye[2]) / ray[2];
  assertClose(view.eye.map((coordinate, axis) => coordinate + distance * ray[axis]), point);
});

test("the matrix agrees with the pixels", () => {
  const view = orbit(3, -4, 1, 0.7, 0.4, 25);
  const point = [6, -9, 2, 1];
  const matrix = view.matrix(640 / 480);
  const row = (number) => point.reduce((sum, coordinate, column) => sum + coordinate * matrix[4 * column + number], 0);
  const [x, y, w] = [row(0), row(1), row(3)];
  assertClose([(1 + x / w) * 320, (1 - y / w) * 240], view.pixel(point.slice(0, 3), 640, 480), 1e-3);
});

test("turning stops above the horizon and straight above", () => {
  const view = new Orbit();
  view.turnBy(0.5, 10);
  assertClose([view.turn, view.rise], [-Math.PI / 2 - 0.5, Math.PI / 2]);
  view.turnBy(0, -10);
  assert.equal(view.rise, 0.05);
});

test("the distance has limits", () => {
  const view = orbit(0, 0, 0, 0, 1, 60);
  view.zoom(2);
  assert.equal(view.distance, 30);
  view.zoom(1000);
  assert.equal(view.distance, 4);
  view.setDistance(5000);
  assert.equal(view.distance, 900);
});

test("moving by the height of the picture moves by what it shows", () => {
  const view = orbit(0, 0, 0, -Math.PI / 2, Math.PI / 2, 10);
  view.move(200, 0, 200);
  assertClose(view.target, [-20 * Math.tan(FIELD_OF_VIEW / 2), 0, 0]);
  view.move(-200, 200, 200);
  assertClose(view.target, [0, 20 * Math.tan(FIELD_OF_VIEW / 2), 0]);
});

test("a view is set by the numbers that it has", () => {
  const numbers = [1, 2, 3, 0.4, 0.5, 60];
  assert.deepEqual(orbit(...numbers).numbers, numbers);
});
