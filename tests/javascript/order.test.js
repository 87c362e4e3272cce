import assert from "node:assert/strict";
import { test } from "node:test";
import { keyOf, ordered } from "../../deepaccident_devkit/support/templates/order.js";

function sorted(keys, isAscending = true) {
  return ordered(keys, (key) => key, isAscending);
}

test("a cell's key is its number, unknown, or its text", () => {
  const keys = [keyOf("1.5 s", "1.5"), keyOf("–", ""), keyOf(" Town03\n"), keyOf("0", "0")];
  assert.deepEqual(keys, [1.5, null, "Town03", 0]);
});

test("numbers are sorted by value", () => {
  assert.deepEqual(sorted([10, 9, -1, 0]), [-1, 0, 9, 10]);
  assert.deepEqual(sorted([10, 9, -1, 0], false), [10, 9, 0, -1]);
});

test("texts are sorted by the numbers in them", () => {
  assert.deepEqual(sorted(["Town10", "Town2", "a"]), ["a", "Town2", "Town10"]);
});

test("unknown values are last in both directions", () => {
  assert.deepEqual(sorted([null, 2, null, 1]), [1, 2, null, null]);
  assert.deepEqual(sorted([null, 2, null, 1], false), [2, 1, null, null]);
  assert.deepEqual(sorted([]), []);
});

test("rows with equal keys keep their order in both directions", () => {
  const rows = [["a", 1], ["b", 0], ["c", 1]];
  const names = (isAscending) => ordered(rows, ([, key]) => key, isAscending).map(([name]) => name);
  assert.deepEqual([names(true), names(false)], [["b", "a", "c"], ["a", "c", "b"]]);
});
