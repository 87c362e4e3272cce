// Two replays side by side, in step: what one plays, shows or looks at, the other does too. The first one's controls play.

const pair = document.getElementById("twins");
const frames = [...pair.querySelectorAll("iframe")];
const shift = Number(pair.dataset.shift); // of a frame's number in the second one
const offset = pair.dataset.offset.split(" ").map(Number); // from the second one's places to the first one's, metres
const step = document.getElementById("step");
const first = new URLSearchParams(location.search).get("frame");
let leads = null; // whose move the other one follows
let touched = frames[0];

const slider = (frame) => frame.contentDocument.getElementById("scrubber");
const at = (frame) => Number(slider(frame).value);
const beside = (frame) => frames[1 - frames.indexOf(frame)];
const numbers = (text) => (text || "").split(" ").map(Number);
const canvases = (frame) => [...frame.contentDocument.querySelectorAll("canvas[data-view]")];

function follow(mover) {
  if (!step.checked || (leads !== null && leads !== mover)) return;
  const other = beside(mover);
  if (!other.contentWindow.go) return;
  leads = mover;
  const wanted = at(mover) + (mover === frames[0] ? shift : -shift);
  const clamped = Math.min(Number(slider(other).max), Math.max(0, wanted));
  if (clamped !== at(other)) other.contentWindow.go(clamped);
  leads = null;
  const query = at(frames[0]) ? `?frame=${at(frames[0]) + 1}` : location.pathname;
  clearTimeout(follow.later);
  follow.later = setTimeout(() => history.replaceState(null, "", query), 200);
}

// Both recordings are in the same world: the views of the replay that the reader touched last lead the other one's.
function share() {
  if (!step.checked || !frames.every((each) => each.contentWindow.look)) return;
  const other = beside(touched);
  const sign = touched === frames[0] ? -1 : 1;
  for (const { id, dataset } of canvases(touched)) {
    const wanted = numbers(dataset.view).map((each, place) => each + sign * (offset[place] || 0));
    const there = numbers(other.contentDocument.getElementById(id).dataset.view);
    const same = wanted.every((each, place) => Math.abs(each - there[place]) < 1e-6);
    if (!same) other.contentWindow.look(id, wanted);
  }
}

function ready(frame) {
  if (!frame.contentWindow || !frame.contentWindow.go) return;
  const inside = frame.contentDocument;
  inside.addEventListener("moment", () => follow(frame));
  for (const kind of ["pointerdown", "wheel", "keydown", "click", "change"]) {
    inside.addEventListener(kind, () => (touched = frame), { capture: true, passive: true });
  }
  const watched = new MutationObserver(share);
  watched.observe(inside.body, { attributes: true, attributeFilter: ["data-view"], subtree: true });
  if (frame === frames[0] && Number(first) > 0) frame.contentWindow.go(Number(first) - 1);
  if (frame === frames[1]) {
    inside.addEventListener("keydown", playInFirst, true);
    lead();
  }
  if (!frames.every((each) => each.contentWindow.go)) return;
  follow(frames[0]);
  const pairs = (each) => each.contentDocument.getElementById("follow").value === "pair";
  touched = frames.find(pairs) || frames[0];
  share();
}

function playInFirst(event) {
  if (!step.checked || event.key !== " ") return;
  event.preventDefault();
  event.stopPropagation();
  frames[0].contentDocument.getElementById("play").click();
}

// In step the second one has no controls of its own.
function lead() {
  frames[1].contentDocument.body.classList.toggle("led", step.checked);
}

step.addEventListener("change", () => {
  lead();
  share();
});
for (const frame of frames) {
  frame.addEventListener("load", () => ready(frame));
  if (frame.contentDocument && frame.contentDocument.readyState === "complete") ready(frame);
}
