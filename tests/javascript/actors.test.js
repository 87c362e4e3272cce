import assert from "node:assert/strict";
import { test } from "node:test";
import {
  actorOf,
  agentByNumber,
  isSeen,
  joinedPlaces,
  lastBefore,
  linesAt,
  nextActor,
  samplesByFrame,
  seenByText,
  speedText,
} from "../../deepaccident_devkit/support/templates/replay/actors.js";
import { actor, state } from "./scene.js";

const AGENTS = [
  { title: "ego", short: "E", actor: 1 },
  { title: "other", short: "O", actor: 2 },
  { title: "infrastructure", short: "I", actor: null },
];

function seen(...masks) {
  return { ...actor(7, ...masks.map(() => state(0, 0))), seen: masks };
}

test("a bit of the mask says whether an agent sees an actor", () => {
  const frames = seen(0b101, 0b010);
  assert.deepEqual([0, 1, 2].map((agent) => isSeen(frames, 0, agent)), [true, false, true]);
  assert.deepEqual([0, 1, 2].map((agent) => isSeen(frames, 1, agent)), [false, true, false]);
});

test("sentences name who sees an actor and how fast it is", () => {
  assert.equal(seenByText(seen(0b101), 0, AGENTS), "seen by ego, infrastructure");
  assert.equal(seenByText(seen(0), 0, AGENTS), "seen by nobody else");
  assert.equal(speedText([0, 0, 0, 123, 0, 0, 0]), "12.3 m/s");
  assert.equal(speedText([0, 0, 0, 0, 0, 0, 0]), "0.0 m/s");
  assert.equal(speedText([0, 0, 0, null, 0, 0, 0]), "speed unknown");
});

test("an agent is an actor only where that is annotated", () => {
  const actors = [actor(1, state(0, 0), null), actor(2, state(0, 0), state(0, 0))];
  assert.equal(actorOf(AGENTS[0], actors, 0), actors[0]);
  assert.equal(actorOf(AGENTS[0], actors, 1), undefined);
  assert.equal(actorOf(AGENTS[2], actors, 0), undefined);
});

test("an option without a number is no agent", () => {
  assert.equal(agentByNumber("1", AGENTS), AGENTS[1]);
  for (const text of ["", "pair", "3", "01"]) assert.equal(agentByNumber(text, AGENTS), undefined);
});

test("the next actor is the next one that is annotated, round and round", () => {
  const actors = [actor(1, state(0, 0)), actor(2, null), actor(3, state(0, 0))];
  const next = (chosen, step) => nextActor(actors, 0, chosen, step)?.id;
  assert.deepEqual([next(1, 1), next(3, 1), next(3, -1), next(1, -1)], [3, 1, 1, 3]);
  assert.deepEqual([next(null, 1), next(null, -1)], [1, 3]);
  assert.deepEqual([next(2, 1), next(2, -1)], [1, 3]); // the chosen one is gone
  assert.equal(nextActor([actor(1, null)], 0, null, 1), undefined);
});

test("between evaluated frames the last one before counts", () => {
  assert.deepEqual([9, 10, 15, 20, 30].map((frame) => lastBefore([10, 20], frame)), [null, 10, 10, 20, 20]);
  assert.equal(lastBefore([], 3), null);
});

test("samples are grouped by frame", () => {
  const samples = [{ frame: 3, agent: 0 }, { frame: 3, agent: 1 }, { frame: 5, agent: 0 }];
  assert.deepEqual([...samplesByFrame(samples)], [[3, samples.slice(0, 2)], [5, [samples[2]]]]);
});

function place(note, x, y = 0) {
  return { note, label: "predicted collision", color: "#000000", points: [[x, y], [x + 200, y]] };
}

test("agents that mark the same place with the same words have one note", () => {
  const samples = [
    { agent: 0, places: [place("in 1.5 s", 0)] },
    { agent: 1, places: [place("in 1.5 s", 10), place("in 2.0 s", 0)] },
    { agent: 2, places: [place("in 1.5 s", 1000), place("in 1.5 s", 0, 1000)] },
  ];
  const joined = joinedPlaces(samples, AGENTS).map(({ by, note }) => [by.join(" "), note]);
  assert.deepEqual(joined, [["E O", "in 1.5 s"], ["O", "in 2.0 s"], ["I", "in 1.5 s"], ["I", "in 1.5 s"]]);
});

test("a shape is plain while it is predicted, faint before, and gone afterwards", () => {
  const lines = [{ filled: true, frames: [5, 9] }, { opacity: 1 }];
  const looks = [4, 5, 9, 10].map((frame) => linesAt([{ lines }], frame).map((line) => Boolean(line.filled)));
  assert.deepEqual(looks, [[false, false], [true, false], [true, false], [false]]);
  assert.ok(linesAt([{ lines }], 4)[0].opacity < 0.5);
});
