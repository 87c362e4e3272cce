// What the reader looks at in the address, and the other way round, so that a colleague opens the same view. After the
// scripts of the replay, whose names it uses.

const given = new URLSearchParams(location.search);
const momentLink = document.getElementById("moment");
const ticks = [...document.querySelectorAll('[id^="layer-"], [id^="cloud-"], #boxes')];
const selects = ["follow", "sight", "scene", "points-by"].map(byId);
const usual = new Map([...ticks.map((box) => [box.id, box.checked]), ...selects.map((each) => [each.id, each.value])]);
const viewOf = () => [ground.x, ground.y, ground.scale].map((each) => each.toFixed(2)).join(",");
const usualView = viewOf();

function set(control, value) {
  control.value = value;
  if (control.value !== value) control.value = usual.get(control.id) || ""; // there is no such choice here
  control.dispatchEvent(new Event("change"));
}

// from the address

const frameGiven = Number(given.get("frame"));
const pictured = data.countdown.map((_, frame) => data.cameras.flat().filter((each) => each.pictures[frame] !== null).length);
if (Number.isInteger(frameGiven) && frameGiven > 0) go(frameGiven - 1);
else if (!pictured[0]) go(pictured.indexOf(Math.max(...pictured))); // of a partial download where most pictures are
const large = data.agents.findIndex((agent) => agent.name === given.get("large"));
if (large >= 0) enlarge(String(large));
for (const select of selects) if (given.has(select.id)) set(select, given.get(select.id));
const changed = (given.get("changed") || "").split(",");
for (const box of ticks.filter((each) => changed.includes(each.id))) if (box.checked === usual.get(box.id)) box.click();
for (const each of (given.get("pictures") || "").split(",")) {
  const [agent, title] = each.split(":");
  const card = cards.find((one) => one.agent.name === agent);
  if (card && card.available.some((camera) => camera.title === title)) set(card.select, title);
}
const place = (given.get("view") || "").split(",").map(Number);
if (place.length === 3 && place.every(Number.isFinite) && place[2] > 0 && state.follow === "") {
  [ground.x, ground.y, ground.scale] = place;
  ground.draw();
}
if (given.get("cameras") === "all") document.getElementById("every").open = true;

// to the address

function remember() {
  const now = new URLSearchParams(location.search);
  const write = (name, value) => (value ? now.set(name, value) : now.delete(name));
  const agentOf = (number) => (number === "" ? "" : data.agents[Number(number)].name);
  write("frame", state.frame ? String(state.frame + 1) : "");
  write("large", agentOf(state.large));
  for (const select of selects) {
    if (select.value === usual.get(select.id)) now.delete(select.id);
    else now.set(select.id, select.value); // empty is a choice, too
  }
  write("changed", ticks.filter((box) => box.checked !== usual.get(box.id)).map((box) => box.id).join(","));
  const chosen = cards.filter((card) => card.chosen).map((card) => `${card.agent.name}:${card.chosen}`);
  write("pictures", chosen.join(","));
  write("view", state.follow === "" && viewOf() !== usualView ? viewOf() : "");
  write("cameras", document.getElementById("every").open ? "all" : "");
  const query = now.toString();
  history.replaceState(null, "", query ? `?${query}` : location.pathname);
  momentLink.href = `moment/${agentOf(state.large || data.automatic.agents[state.frame])}/${state.frame + 1}`;
}
remember();
// While it plays the address stays: browsers refuse many changes a second.
let later = null;
function rememberSoon() {
  clearTimeout(later);
  later = setTimeout(remember, 200);
}
document.addEventListener("moment", rememberSoon);
for (const kind of ["pointerup", "wheel", "keyup", "click"]) document.addEventListener(kind, rememberSoon);
document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-frame]");
  if (!button || button.tagName !== "BUTTON") return;
  go(Number(button.dataset.frame) - 1);
  document.querySelector(".stage").scrollIntoView();
});
