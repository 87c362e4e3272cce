import assert from "node:assert/strict";
import { test } from "node:test";
import {
  Clock,
  clampedFrame,
  countdownText,
  frameAtShare,
  secondsText,
  shareOf,
} from "../../deepaccident_devkit/support/templates/replay/clock.js";

test("a clock counts periods from its first tick", () => {
  const clock = new Clock(0.1, 39);
  const frames = [1000, 1099, 1100, 1250, 1300].map((now) => clock.frameAt(now, 5, 1));
  assert.deepEqual(frames, [5, 5, 6, 7, 8]); // 0.3 / 0.1 is a little less than 3
});

test("speed multiplies the frames", () => {
  const frames = [0.1, 0.5, 2].map((speed) => {
    const clock = new Clock(0.1, 39);
    clock.frameAt(0, 0, speed);
    return clock.frameAt(1000, 0, speed);
  });
  assert.deepEqual(frames, [1, 5, 20]);
});

test("after a restart a clock counts from the frame that is shown", () => {
  const clock = new Clock(0.1, 39);
  clock.frameAt(0, 0, 1);
  assert.equal(clock.frameAt(500, 0, 1), 5);
  clock.restart();
  assert.deepEqual([clock.frameAt(600, 5, 2), clock.frameAt(700, 5, 2)], [5, 7]);
});

test("a clock stops at the last frame", () => {
  const clock = new Clock(0.1, 3);
  assert.deepEqual([0, 300, 10000].map((now) => clock.frameAt(now, 2, 1)), [2, 3, 3]);
  assert.equal(new Clock(0.1, 0).frameAt(0, 0, 1), 0);
});

test("frames outside of the recording are clamped", () => {
  assert.deepEqual([-1, 0, 39, 40].map((frame) => clampedFrame(frame, 39)), [0, 0, 39, 39]);
});

test("a share of the strip is a frame, and a frame a share", () => {
  assert.deepEqual([0, 0.12, 0.13, 0.5, 1].map((share) => frameAtShare(share, 4)), [0, 0, 1, 2, 4]);
  assert.deepEqual([shareOf(1, 4), shareOf(4, 4), shareOf(0, 0)], [0.25, 1, 0]);
});

test("times are written with one decimal", () => {
  assert.deepEqual([secondsText(0, 0.1), secondsText(3, 0.1), secondsText(39, 0.1)], ["0.0", "0.3", "3.9"]);
});

test("the countdown tells an impact, the time before it and that there is none", () => {
  assert.deepEqual([3.44, 0, null].map(countdownText), ["3.4 s to impact", "0.0 s – impact", "no impact"]);
});
