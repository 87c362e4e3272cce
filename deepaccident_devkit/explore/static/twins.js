// Two replays side by side, in step: what one plays or shows, the other does too.

const pair = document.getElementById("twins");
const frames = [...pair.querySelectorAll("iframe")];
const shift = Number(pair.dataset.shift); // of a frame's number in the second one
const step = document.getElementById("step");
const first = new URLSearchParams(location.search).get("frame");
let leads = null; // whose move the other one follows

const slider = (frame) => frame.contentDocument.getElementById("scrubber");
const at = (frame) => Number(slider(frame).value);

function follow(mover) {
  if (!step.checked || (leads !== null && leads !== mover)) return;
  const other = frames[1 - frames.indexOf(mover)];
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

function ready(frame) {
  if (!frame.contentWindow || !frame.contentWindow.go) return;
  frame.contentDocument.addEventListener("moment", () => follow(frame));
  if (frame === frames[0] && Number(first) > 0) frame.contentWindow.go(Number(first) - 1);
  if (frames.every((each) => each.contentWindow.go)) follow(frames[0]);
}
for (const frame of frames) {
  frame.addEventListener("load", () => ready(frame));
  if (frame.contentDocument && frame.contentDocument.readyState === "complete") ready(frame);
}
