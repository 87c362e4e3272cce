// Actors, agents and comparisons that several tests use.
import assert from "node:assert/strict";

/** An actor of 4 × 2 × 1 metres with the states that are given; nobody sees it. */
export function actor(id, ...states) {
  return {
    id,
    title: `car ${id}`,
    category: "car",
    role: "other",
    tag: "",
    color: "#000000",
    length: 400,
    width: 200,
    height: 100,
    states,
    seen: states.map(() => 0),
  };
}

/** The state of an actor that stands at x, y, z (cm) and heads into a direction (mrad). */
export function state(x, y, z = 50, yaw = 0) {
  return [x, y, yaw, 0, z, 0, 0];
}

export const QUARTER_TURN = 500 * Math.PI; // mrad

/** Numbers are equal but for rounding. */
export function assertClose(actual, expected, tolerance = 1e-9) {
  assert.equal(actual.length, expected.length);
  for (const [index, value] of [...actual].entries()) {
    assert.ok(Math.abs(value - expected[index]) <= tolerance, `${[...actual]} is not ${expected}`);
  }
}
