// Two replays side by side, in step: what one plays, shows or looks at, the other does too. The controls of the
// first one play.

import { frameInStep, isSameView, numbersOf, viewInStep } from "./steps.js";

/** @typedef {{ frame: HTMLIFrameElement, document: Document }} Replay */

const CHANGES = ["pointerdown", "wheel", "keydown", "click", "change"];

const twins = document.getElementById("twins");
const frames = [...document.querySelectorAll("iframe")];
const shift = Number(twins?.dataset.shift); // of a frame's number in the second replay
const offset = numbersOf(twins?.dataset.offset); // from the second one's places to the first one's, metres
const step = document.getElementById("step");
const first = Number(new URLSearchParams(location.search).get("frame"));
/** @type {HTMLIFrameElement | null} the replay whose move the other one follows */
let leader = null;
let touched = frames[0];
/** @type {number | undefined} */
let timer;

function isInStep() {
  return step instanceof HTMLInputElement && step.checked;
}

/**
 * Return the document of a replay; null until it plays.
 * @param {HTMLIFrameElement} frame
 */
function replayIn(frame) {
  const inside = frame.contentDocument;
  return inside?.querySelector("canvas[data-view]") ? inside : null;
}

/** @param {HTMLIFrameElement} frame */
function beside(frame) {
  return frames[1 - frames.indexOf(frame)];
}

/** @param {Document} replay */
function sliderOf(replay) {
  return /** @type {HTMLInputElement} */ (replay.getElementById("scrubber"));
}

/** @param {Document} replay */
function frameOf(replay) {
  return Number(sliderOf(replay).value);
}

/**
 * @param {Document} replay
 * @returns {NodeListOf<HTMLCanvasElement>}
 */
function canvasesOf(replay) {
  return replay.querySelectorAll("canvas[data-view]");
}

/**
 * Show a frame in a replay.
 * @param {Document} replay
 * @param {number} frame
 */
function go(replay, frame) {
  replay.dispatchEvent(new CustomEvent("go", { detail: frame }));
}

/**
 * Show the moment of one replay in the other one, too.
 * @param {HTMLIFrameElement} mover
 */
function follow(mover) {
  if (!isInStep() || (leader !== null && leader !== mover)) return;
  const [one, other] = [replayIn(mover), replayIn(beside(mover))];
  if (!one || !other) return;
  leader = mover;
  const frame = frameInStep(frameOf(one), mover === frames[0] ? shift : -shift, Number(sliderOf(other).max));
  if (frame !== frameOf(other)) go(other, frame);
  leader = null;
  rememberSoon();
}

/** Keep the frame of the first replay in the address. */
function rememberSoon() {
  clearTimeout(timer);
  timer = setTimeout(() => {
    const replay = replayIn(frames[0]);
    const frame = replay ? frameOf(replay) : 0;
    history.replaceState(null, "", frame ? `?frame=${frame + 1}` : location.pathname);
  }, 200);
}

/** Show the views of the replay that the reader touched last in the other one: both are in the same world. */
function share() {
  const [one, other] = [replayIn(touched), replayIn(beside(touched))];
  if (!isInStep() || !one || !other) return;
  const sign = touched === frames[0] ? -1 : 1;
  for (const { id, dataset } of canvasesOf(one)) {
    const view = viewInStep(numbersOf(dataset.view), offset.map((coordinate) => sign * coordinate));
    const otherView = numbersOf(other.getElementById(id)?.dataset.view);
    if (!isSameView(view, otherView)) other.dispatchEvent(new CustomEvent("look", { detail: { id, view } }));
  }
}

/**
 * Begin with a replay that has been loaded.
 * @param {HTMLIFrameElement} frame
 */
function begin(frame) {
  const replay = replayIn(frame);
  if (!replay) return;
  replay.addEventListener("moment", () => follow(frame));
  for (const kind of CHANGES) {
    replay.addEventListener(kind, () => (touched = frame), { capture: true, passive: true });
  }
  const observer = new MutationObserver(share);
  observer.observe(replay.body, { attributes: true, attributeFilter: ["data-view"], subtree: true });
  if (frame === frames[0] && first > 0) go(replay, first - 1);
  if (frame === frames[1]) {
    replay.addEventListener("keydown", playInFirst, true);
    hideControls();
  }
  const replays = frames.map(replayIn);
  if (replays.includes(null)) return;
  follow(frames[0]);
  touched = frames.find(followsPair) ?? frames[0];
  share();
}

/** @param {HTMLIFrameElement} frame */
function followsPair(frame) {
  const select = frame.contentDocument?.getElementById("follow");
  return /** @type {HTMLSelectElement | null | undefined} */ (select)?.value === "pair";
}

/** @param {KeyboardEvent} event */
function playInFirst(event) {
  if (!isInStep() || event.key !== " ") return;
  event.preventDefault();
  event.stopPropagation();
  replayIn(frames[0])?.getElementById("play")?.click();
}

/** In step the second replay has no controls of its own. */
function hideControls() {
  frames[1].contentDocument?.body.classList.toggle("led", isInStep());
}

step?.addEventListener("change", () => {
  hideControls();
  share();
});
for (const frame of frames) {
  frame.addEventListener("load", () => begin(frame));
  if (frame.contentDocument?.readyState === "complete") begin(frame);
}
