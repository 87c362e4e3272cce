import assert from "node:assert/strict";
import { test } from "node:test";
import {
  changedQuery,
  frameOfAddress,
  picturesOfAddress,
  viewOfAddress,
  viewText,
} from "../../deepaccident_devkit/plugins/explore/static/addresses.js";
import { nextEntry } from "../../deepaccident_devkit/plugins/explore/static/entries.js";
import { queryOf } from "../../deepaccident_devkit/plugins/explore/static/filters.js";
import {
  frameInStep,
  isSameView,
  numbersOf,
  viewInStep,
} from "../../deepaccident_devkit/plugins/explore/static/steps.js";

test("keys go along the entries and stop at the ends", () => {
  assert.deepEqual([nextEntry(0, 1, 3), nextEntry(2, 1, 3), nextEntry(1, -1, 3), nextEntry(0, -1, 3)], [1, 2, 0, 0]);
  assert.deepEqual([nextEntry(-1, 1, 3), nextEntry(-1, -1, 3)], [0, 2]);
});

test("the address of the list has only what is not as usual", () => {
  const usual = [["q", ""], ["sort", "name"], ["order", "up"], ["view", "grid"]];
  assert.equal(queryOf(usual), "");
  assert.equal(queryOf([["town", "A"], ["town", "B"], ["q", "a>=1"], ["sort", "name"]]), "town=A&town=B&q=a%3E%3D1");
});

test("a moment has a frame in the twin, or the nearest that exists", () => {
  assert.deepEqual([0, 5, 39].map((frame) => frameInStep(frame, 3, 39)), [3, 8, 39]);
  assert.equal(frameInStep(1, -3, 39), 0);
});

test("a view of the twin shows the same part of the world", () => {
  assert.deepEqual(viewInStep([1, 2, 5.5], [10, -10]), [11, -8, 5.5]);
  assert.deepEqual(viewInStep([1, 2, 3, 0.5], [10, -10, 1]), [11, -8, 4, 0.5]);
  assert.deepEqual([isSameView([1, 2], [1, 2 + 1e-9]), isSameView([1, 2], [1, 2.1])], [true, false]);
  assert.deepEqual(numbersOf("1 -2.5"), [1, -2.5]);
});

const cameras = [{ pictures: [null, null, "a"] }, { pictures: [null, "b", "c"] }];

test("an address names a frame from 1 on", () => {
  assert.deepEqual(["1", "3"].map((text) => frameOfAddress(text, cameras, 3)), [0, 2]);
});

test("without a frame a partial download opens where it has most pictures", () => {
  for (const text of [null, "", "x", "0", "-1", "1.5"]) assert.equal(frameOfAddress(text, cameras, 3), 2);
  assert.equal(frameOfAddress(null, [{ pictures: ["a", "b"] }], 2), 0);
  assert.equal(frameOfAddress(null, [], 2), 0);
});

test("a view is written with two decimals and read again", () => {
  assert.equal(viewText([1, -2.345, 5.5]), "1.00,-2.35,5.50");
  assert.deepEqual(viewOfAddress("1.00,-2.34,5.50"), [1, -2.34, 5.5]);
  for (const text of [null, "", "1,2", "1,2,x", "1,2,0", "1,2,-3", "1,2,3,4"]) assert.equal(viewOfAddress(text), null);
});

test("an address names agents and their cameras", () => {
  assert.deepEqual(picturesOfAddress("ego_vehicle:back,,other_vehicle:front left,x"), [
    { agent: "ego_vehicle", title: "back" },
    { agent: "other_vehicle", title: "front left" },
  ]);
  assert.deepEqual(picturesOfAddress(null), []);
});

test("an address keeps what is not changed, and empty choices", () => {
  const query = changedQuery("?model=a&frame=3", { frame: null, follow: "", large: "ego" });
  assert.equal(query, "model=a&follow=&large=ego");
});
