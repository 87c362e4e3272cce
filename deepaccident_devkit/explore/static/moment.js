// The moment of the replay in the address, and the other way round, so that a colleague opens the same one. After the
// scripts of the replay, whose names it uses.

const given = new URLSearchParams(location.search);
const number = Number(given.get("frame"));
const momentLink = document.getElementById("moment");
if (Number.isInteger(number) && number > 0) go(number - 1);
if (given.get("large") && data.agents.some((agent) => agent.name === given.get("large"))) {
  enlarge(String(data.agents.findIndex((agent) => agent.name === given.get("large"))));
}
if (given.get("cameras") === "all") document.getElementById("every").open = true;

function remember() {
  const now = new URLSearchParams(location.search);
  const set = (name, value) => (value ? now.set(name, value) : now.delete(name));
  set("frame", state.frame ? String(state.frame + 1) : "");
  set("large", state.large === "" ? "" : data.agents[Number(state.large)].name);
  set("cameras", document.getElementById("every").open ? "all" : "");
  const query = now.toString();
  history.replaceState(null, "", query ? `?${query}` : location.pathname);
  const agent = data.agents[state.large === "" ? data.automatic.agents[state.frame] : Number(state.large)];
  momentLink.href = `moment/${agent.name}/${state.frame + 1}`;
}
remember();
// While it plays the address stays: browsers refuse many changes a second.
let later = null;
document.addEventListener("moment", () => {
  clearTimeout(later);
  later = setTimeout(remember, 200);
});
document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-frame]");
  if (!button || button.tagName !== "BUTTON") return;
  go(Number(button.dataset.frame) - 1);
  document.querySelector(".stage").scrollIntoView();
});
