// The table of who sees whom, and the sentences about the colliding pair and the highlighted actor.

import { isSeen, seenByText, speedText } from "./actors.js";
import { data, pair } from "./data.js";
import { byId, chip, made } from "./elements.js";
import { choose, point } from "./lit.js";
import { litActor, state } from "./state.js";

/** @import { Actor } from "./types.js" */

/** Make the headings of a table's columns, one for each agent. */
export function agentHeadings() {
  return data.agents.map((agent) =>
    made("th", { scope: "col", title: agent.title }, chip(agent.color, "round"), agent.short),
  );
}

const rows = data.actors.map((actor) => {
  const cells = data.agents.map(() => made("td", {}));
  const row = made("tr", {}, made("th", { scope: "row" }, chip(actor.color), actor.title), ...cells);
  row.addEventListener("pointerenter", () => point(actor));
  row.addEventListener("pointerleave", () => point(null));
  row.addEventListener("click", () => choose(actor));
  return { actor, row, cells };
});
byId("seen").append(
  made("thead", {}, made("tr", {}, made("th", { scope: "col", textContent: "actor" }), ...agentHeadings())),
  made("tbody", {}, ...rows.map((actorRow) => actorRow.row)),
);

/**
 * Return the mark of an actor in the column of an agent.
 * @param {Actor} actor
 * @param {number} agent
 */
function markOf(actor, agent) {
  if (actor.states[state.frame] === null) return "";
  if (data.agents[agent].actor === actor.id) return "self";
  return isSeen(actor, state.frame, agent) ? "●" : "–";
}

/** Show who sees whom at the frame. */
export function showSeen() {
  for (const { actor, row, cells } of rows) {
    row.classList.toggle("absent", actor.states[state.frame] === null);
    for (const [agent, cell] of cells.entries()) {
      const text = markOf(actor, agent);
      if (cell.textContent !== text) cell.textContent = text;
    }
  }
  const sentences = pair.flatMap((actor) => {
    const now = actor.states[state.frame];
    if (now === null) return [];
    return [`${actor.title}, ${speedText(now)}: ${seenByText(actor, state.frame, data.agents)}.`];
  });
  byId("pair").textContent = sentences.join(" ");
}

/** Show which actor is highlighted. */
export function showLit() {
  const lit = litActor();
  byId("lit").classList.toggle("nobody", !lit);
  for (const { actor, row } of rows) row.classList.toggle("lit", actor.id === state.lit);
  byId("lit").textContent = lit ? litText(lit) : "Point at an actor in any view: all views show it.";
}

/** @param {Actor} actor */
function litText(actor) {
  const now = actor.states[state.frame];
  if (now === null) return `${actor.title}: not annotated at this moment.`;
  return `${actor.title}: ${speedText(now)}, ${seenByText(actor, state.frame, data.agents)}.`;
}
