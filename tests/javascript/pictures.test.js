import assert from "node:assert/strict";
import { test } from "node:test";
import {
  hasPictures,
  isOutdated,
  pictureFrame,
  pictureTitle,
} from "../../deepaccident_devkit/support/templates/replay/pictures.js";

function camera(...pictures) {
  return { title: "front", pictures };
}

test("the last picture before a frame stands for it, or else the first one", () => {
  const some = camera(null, "a", null, "b", null);
  assert.deepEqual([0, 1, 2, 3, 4].map((frame) => pictureFrame(some, frame)), [1, 1, 1, 3, 3]);
  assert.equal(pictureFrame(camera(null, null), 1), -1);
});

test("a camera without a picture has none", () => {
  assert.deepEqual([camera(null, 1), camera(null), camera()].map(hasPictures), [true, false, false]);
});

test("a picture of another moment says of which", () => {
  const titles = [[5, 5], [5, 2], [0, 2]].map(([frame, pictured]) => pictureTitle(camera(), frame, pictured, 0.1));
  assert.deepEqual(titles, ["front", "front, 0.3 s earlier", "front, 0.2 s later"]);
});

test("without a server a picture may be half a second old", () => {
  const old = camera("a", null, null, null, null, null, null);
  assert.deepEqual([0, 5, 6].map((frame) => isOutdated(old, frame, 0.1, false)), [false, false, true]);
  assert.deepEqual([0, 1].map((frame) => isOutdated(old, frame, 0.1, true)), [false, true]);
});
