// Keeps what the reader looks at in the address, and shows what the address says, so that a colleague sees the same. It
// stands after the script of the replay, and reads and sets the replay's own controls.

import { changedQuery, frameOfAddress, picturesOfAddress, viewOfAddress, viewText } from "./addresses.js";

/** @import { ReplayData } from "../../../support/templates/replay/types.js" */

const DELAY = 200; // milliseconds: browsers refuse many changes of the address in a second

const address = new URLSearchParams(location.search);
/** @type {ReplayData} */
const data = JSON.parse(document.getElementById("data")?.textContent ?? "");
const large = selectOf("large");
const selects = ["follow", "sight", "scene", "points-by"].map(selectOf);
/** @type {HTMLInputElement[]} */
const checkboxes = [...document.querySelectorAll('[id^="layer-"], [id^="cloud-"], #boxes')].filter(
  (element) => element instanceof HTMLInputElement,
);
/** @type {HTMLElement[]} the pictures of the agents */
const figures = [...document.querySelectorAll("#cards figure")].filter((element) => element instanceof HTMLElement);
const allCameras = /** @type {HTMLDetailsElement} */ (document.getElementById("every"));
const usualChecks = new Map(checkboxes.map((box) => [box.id, box.checked]));
const usualValues = new Map(selects.map((select) => [select.id, select.value]));
const usualView = viewText(mapView());

/** @param {string} id */
function selectOf(id) {
  return /** @type {HTMLSelectElement} */ (document.getElementById(id));
}

/** Return the frame that is shown. */
function shownFrame() {
  return Number(/** @type {HTMLInputElement} */ (document.getElementById("scrubber")).value);
}

/** Return the numbers of the map's view. */
function mapView() {
  return (document.getElementById("ground")?.dataset.view ?? "").split(" ").map(Number);
}

/** @param {number} frame */
function go(frame) {
  document.dispatchEvent(new CustomEvent("go", { detail: frame }));
}

/**
 * Choose an option as a reader does; what is usual if there is no such option.
 * @param {HTMLSelectElement} select
 * @param {string} value
 */
function choose(select, value) {
  select.value = value;
  if (select.value !== value) select.value = usualValues.get(select.id) ?? "";
  select.dispatchEvent(new Event("change"));
}

// from the address

const frame = frameOfAddress(address.get("frame"), data.cameras.flat(), data.countdown.length);
if (frame) go(frame);
const largeAgent = data.agents.findIndex((agent) => agent.name === address.get("large"));
if (largeAgent >= 0) choose(large, String(largeAgent));
for (const select of selects) {
  const value = address.get(select.id);
  if (value !== null) choose(select, value);
}
const changed = (address.get("changed") ?? "").split(",");
for (const box of checkboxes) {
  if (changed.includes(box.id) && box.checked === usualChecks.get(box.id)) box.click();
}
for (const { agent, title } of picturesOfAddress(address.get("pictures"))) {
  const select = figures.find((figure) => figure.dataset.agent === agent)?.querySelector("select");
  if (select && [...select.options].some((option) => option.value === title)) choose(select, title);
}
const view = viewOfAddress(address.get("view"));
if (view && selectOf("follow").value === "") {
  document.dispatchEvent(new CustomEvent("look", { detail: { id: "ground", view } }));
}
if (address.get("cameras") === "all") allCameras.open = true;

// to the address

/** @param {string} number of an agent */
function nameOf(number) {
  return data.agents[Number(number)].name;
}

/** Return the cameras that the reader has chosen, as the address has them. */
function chosenCameras() {
  return figures.flatMap((figure) => {
    const title = figure.querySelector("select")?.value;
    return title ? [`${figure.dataset.agent}:${title}`] : [];
  });
}

function remember() {
  const now = shownFrame();
  const shown = viewText(mapView());
  const isMoved = selectOf("follow").value === "" && shown !== usualView;
  const switched = checkboxes.filter((box) => box.checked !== usualChecks.get(box.id));
  /** @type {Record<string, string | null>} */
  const values = {
    frame: now ? String(now + 1) : null,
    large: large.value === "" ? null : nameOf(large.value),
    changed: switched.map((box) => box.id).join(",") || null,
    pictures: chosenCameras().join(",") || null,
    view: isMoved ? shown : null,
    cameras: allCameras.open ? "all" : null,
  };
  for (const { id, value } of selects) values[id] = value === usualValues.get(id) ? null : value; // may be empty
  const query = changedQuery(location.search, values);
  history.replaceState(null, "", query ? `?${query}` : location.pathname);
  const agent = nameOf(large.value || String(data.automatic.agents[now]));
  document.getElementById("moment")?.setAttribute("href", `moment/${agent}/${now + 1}`);
}

remember();
/** @type {number | undefined} */
let timer;

function rememberSoon() {
  clearTimeout(timer);
  timer = setTimeout(remember, DELAY);
}

document.addEventListener("moment", rememberSoon);
for (const kind of ["pointerup", "wheel", "keyup", "click"]) document.addEventListener(kind, rememberSoon);
document.addEventListener("click", (event) => {
  const button = event.target instanceof Element && event.target.closest("[data-frame]");
  if (!(button instanceof HTMLButtonElement)) return;
  go(Number(button.dataset.frame) - 1);
  document.querySelector(".stage")?.scrollIntoView();
});
