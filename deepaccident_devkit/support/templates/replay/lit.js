// The actor that the reader points at or has chosen, in any view: all views name it and light it up.

function light() {
  const wanted = state.pointed === null ? state.chosen : state.pointed;
  if (wanted === state.lit) return;
  state.lit = wanted;
  showCameras();
  showEvery();
  showLit();
  ground.draw();
  space.draw();
}

const numberOf = (actor) => (actor ? actor.id : null);

function point(actor) {
  state.pointed = numberOf(actor);
  light();
}

/** Choose an actor; the same one again, or none, ends it. */
function choose(actor) {
  state.chosen = numberOf(actor) === state.chosen ? null : numberOf(actor);
  state.pointed = null;
  light();
}

/** The next actor that is there, by the order of the table. */
function chooseNext(step) {
  const there = data.actors.filter((actor) => actor.states[state.frame] !== null);
  const at = there.findIndex((actor) => actor.id === state.chosen);
  if (there.length) choose(there[(at + step + there.length + (at < 0 && step < 0 ? 1 : 0)) % there.length]);
}

function seenBy(actor) {
  const names = data.agents.filter((_, bit) => actor.seen[state.frame] & (1 << bit)).map((agent) => agent.title);
  return `seen by ${names.join(", ") || "nobody else"}`;
}

const speedOf = (now) => (now[3] === null ? "speed unknown" : `${(now[3] / 10).toFixed(1)} m/s`);

function showLit() {
  const actor = data.actors.find((each) => each.id === state.lit);
  const now = actor && actor.states[state.frame];
  byId("lit").classList.toggle("nobody", !actor);
  for (const { actor: own, row } of rows) row.classList.toggle("lit", own.id === state.lit);
  if (!actor) byId("lit").textContent = "Point at an actor in any view: all views show it.";
  else if (!now) byId("lit").textContent = `${actor.title}: not annotated at this moment.`;
  else byId("lit").textContent = `${actor.title}: ${speedOf(now)}, ${seenBy(actor)}.`;
}

// in a camera's picture

/** The nearest actor whose box a pointer is on, in the picture of a card. */
function actorIn(card, event) {
  const box = card.boxes.getBoundingClientRect();
  const [width, height] = card.size || [0, 0];
  const x = ((event.clientX - box.left) / box.width) * width;
  const y = ((event.clientY - box.top) / box.height) * height;
  const within = ({ place }) => place[0] <= x && x <= place[2] && place[1] <= y && y <= place[3];
  const hit = (card.places || []).filter(within);
  return hit.length ? hit.reduce((best, each) => (each.away < best.away ? each : best)).actor : null;
}

/** Point and choose in the picture of a card; what else a click does, `otherwise` does. */
function lightIn(card, element, otherwise) {
  element.addEventListener("pointermove", (event) => point(actorIn(card, event)));
  element.addEventListener("pointerleave", () => point(null));
  element.addEventListener("click", (event) => {
    const actor = event.detail ? actorIn(card, event) : null; // of a key, it has no place
    if (actor) choose(actor);
    if (!actor || !card.figure.classList.contains("large")) otherwise();
  });
}

for (const { actor, row } of rows) {
  row.addEventListener("pointerenter", () => point(actor));
  row.addEventListener("pointerleave", () => point(null));
  row.addEventListener("click", () => choose(actor));
}
