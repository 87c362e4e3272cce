import assert from "node:assert/strict";
import { test } from "node:test";
import {
  areaInPicture,
  cameraAxes,
  cornersInCamera,
  edgesInPicture,
  extentOf,
  eyeOf,
  frustumCorners,
  isAhead,
  pathOf,
  pixelOf,
} from "../../deepaccident_devkit/support/templates/replay/projection.js";
import { actor, assertClose, state } from "./scene.js";

const UP = [0, 0, 0, 10000, 0, 0, 0]; // the camera at the origin looks along z
const HALF = 5000;
const FORWARD = [0, 0, 100, HALF, -HALF, HALF, -HALF]; // a metre above the origin it looks along x, with z upwards
const camera = { title: "front", lens: [200, 100, 100, 100, 100, 50], poses: [UP], pictures: [] };

function edges(box, now, pose = UP) {
  return edgesInPicture(camera, cornersInCamera(pose, box, now));
}

test("a camera without rotation has the axes of the world", () => {
  assertClose(cameraAxes(UP).flat(), [1, 0, 0, 0, 1, 0, 0, 0, 1]);
});

test("a camera that looks along x has right at −y and down at −z", () => {
  assertClose(cameraAxes(FORWARD).flat(), [0, -1, 0, 0, 0, -1, 1, 0, 0]);
});

test("what is straight ahead is at the principal point", () => {
  assert.deepEqual(pixelOf(camera, [0, 0, 500]), [100, 50]);
  assert.deepEqual(pixelOf(camera, [100, -200, 400]), [125, 0]);
});

test("a box ahead of the camera has twelve edges around its centre", () => {
  const ends = edges(actor(1), state(0, 0, 1050));
  assert.equal(ends.length, 12);
  // half of 4 × 2 × 1 metres; the nearest face is 10 m away
  assertClose(extentOf(ends.flat()), [80, 40, 120, 60]);
});

test("a box is seen from its side in the axes of the camera", () => {
  const [left, top, right, bottom] = extentOf(edges(actor(1), state(1200, 0, 50), FORWARD).flat());
  assertClose([left, right], [90, 110]); // 2 m wide, 10 m away
  assertClose([top, bottom], [50, 60]); // from the height of the camera a metre down
});

test("a box behind the camera has no edge", () => {
  assert.deepEqual(edges(actor(1), state(0, 0, -1000)), []);
});

test("a box beside, above or below the picture has no edge", () => {
  const places = [[100000, 0], [-100000, 0], [0, 100000], [0, -100000]];
  for (const [x, y] of places) assert.deepEqual(edges(actor(1), state(x, y, 1000)), []);
});

test("a box around the camera is cut off 10 cm ahead of it", () => {
  const ends = edges({ ...actor(1), height: 2000 }, state(0, 0, 0));
  assert.equal(ends.length, 8); // the four edges of the lower face are behind the camera
  const cut = ends.flat().filter(([x, y]) => Math.abs(x - 100) > 200 || Math.abs(y - 50) > 200);
  assert.equal(cut.length, 4);
  assertClose(extentOf(cut), [100 - 2000, 50 - 1000, 100 + 2000, 50 + 1000]);
});

test("only what is more than 10 cm ahead is ahead", () => {
  assert.deepEqual([[0, 0, 10], [0, 0, 10.1], [0, 0, -20]].map(isAhead), [false, true, false]);
});

test("the frustum of a camera ends at the corners of its picture", () => {
  assertClose(frustumCorners(camera, UP, 10).flat(), [-10, -5, 10, 10, -5, 10, 10, 5, 10, -10, 5, 10]);
  assert.deepEqual(eyeOf(FORWARD), [0, 0, 1]);
});

test("a path has one decimal", () => {
  assert.equal(pathOf([[1, 2.04], [-3.06, 4]]), "M1.0 2.0L-3.1 4.0");
});

test("an area is cut off 10 cm ahead of the camera, and is empty behind it", () => {
  const triangle = [[0, 0, 1010], [0, 0, -990], [100, 0, 1010]];
  assertClose(areaInPicture(camera, triangle).flat(), [100, 50, 100, 50, 600, 50, 100 + 10000 / 1010, 50]);
  assert.deepEqual(areaInPicture(camera, triangle.map(([x, y, z]) => [x, y, z - 1010])), []);
});
