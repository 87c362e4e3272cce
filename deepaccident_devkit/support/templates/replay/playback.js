// Playing the recording, and the time that the page shows.

import { Clock, clampedFrame, countdownText, secondsText } from "./clock.js";
import { data, last } from "./data.js";
import { byId } from "./elements.js";
import { show } from "./refresh.js";
import { state } from "./state.js";

const clock = new Clock(data.period, last);
const scrubber = byId("scrubber", HTMLInputElement);
scrubber.max = String(last);
scrubber.addEventListener("input", () => step(Number(scrubber.value) - state.frame));

/**
 * Show a frame.
 * @param {number} frame
 */
export function go(frame) {
  state.frame = clampedFrame(frame, last);
  show();
}

/** @param {number} now milliseconds */
function tick(now) {
  if (!state.playing) return;
  const frame = clock.frameAt(now, state.frame, state.speed);
  if (frame === last) state.playing = false;
  if (frame !== state.frame || !state.playing) go(frame);
  requestAnimationFrame(tick);
}

/**
 * Play or pause; at the end it plays from the beginning.
 * @param {boolean} playing
 */
export function play(playing) {
  state.playing = playing;
  clock.restart();
  if (playing && state.frame === last) state.frame = 0;
  show();
  if (playing) requestAnimationFrame(tick);
}

/**
 * Pause, and go some frames forward or back.
 * @param {number} frames
 */
export function step(frames) {
  if (state.playing) play(false);
  go(state.frame + frames);
}

/** @param {number} speed */
export function setSpeed(speed) {
  state.speed = speed;
  clock.restart();
}

/** Show the time of the frame. */
export function showTime() {
  const countdown = data.countdown[state.frame];
  const seconds = secondsText(state.frame, data.period);
  scrubber.value = String(state.frame);
  scrubber.setAttribute("aria-valuetext", `frame ${state.frame + 1}, ${seconds} seconds`);
  byId("time").textContent = `${seconds} s, frame ${state.frame + 1} / ${last + 1}`;
  byId("countdown").textContent = countdownText(countdown);
  document.body.classList.toggle("impact", countdown === 0);
  byId("announcement").textContent = countdown === 0 ? "Impact" : "";
  byId("play").textContent = state.playing ? "Pause" : "Play";
  byId("play").setAttribute("aria-pressed", String(state.playing));
}
