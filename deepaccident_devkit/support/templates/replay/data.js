// The data that the page plays.

import { GroundPlane } from "./boxes.js";
import { byId } from "./elements.js";
import { refresh } from "./refresh.js";
import { Sources } from "./sources.js";

/** @import { ReplayData } from "./types.js" */

/** @type {ReplayData} */
export const data = JSON.parse(byId("data").textContent ?? "");
/** What the actors stand on. */
export const ground = GroundPlane.below(data.actors);
export const last = data.countdown.length - 1;
export const pair = data.actors.filter((actor) => actor.role === "pair");
export const sources = new Sources(data, () => refresh("points"));
/** @type {[value: string, text: string][]} */
export const agentOptions = data.agents.map((agent, number) => [String(number), agent.title]);
