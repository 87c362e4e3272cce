// What is known of actors at a frame: who sees them, how fast they are, which of them is an agent.

import { middleOf } from "./map_view.js";

/** @import { Actor, ActorState, Agent, DrawnLine, DrawnPlace, Sample } from "./types.js" */

const FAINT = 0.1; // opacity of what is predicted for a later frame
const CLOSE = 200; // centimetres

/**
 * @param {Actor} actor
 * @param {number} frame
 * @param {number} agent its number
 */
export function isSeen(actor, frame, agent) {
  return (actor.seen[frame] & (1 << agent)) !== 0;
}

/**
 * Return the agents that see an actor.
 * @param {Actor} actor
 * @param {number} frame
 * @param {Agent[]} agents
 */
export function seersOf(actor, frame, agents) {
  return agents.filter((_, number) => isSeen(actor, frame, number));
}

/**
 * @param {Actor} actor
 * @param {number} frame
 * @param {Agent[]} agents
 */
export function seenByText(actor, frame, agents) {
  const names = seersOf(actor, frame, agents).map((agent) => agent.title);
  return `seen by ${names.join(", ") || "nobody else"}`;
}

/** @param {ActorState} state */
export function speedText(state) {
  return state[3] === null ? "speed unknown" : `${(state[3] / 10).toFixed(1)} m/s`;
}

/**
 * Return the actor that an agent is, if a label has it at this frame.
 * @param {Agent} agent
 * @param {Actor[]} actors
 * @param {number} frame
 */
export function actorOf(agent, actors, frame) {
  return actors.find((actor) => actor.id === agent.actor && actor.states[frame] !== null);
}

/**
 * Return the agent that the number in a text stands for, as the options of a <select> have it.
 * @param {string} text
 * @param {Agent[]} agents
 */
export function agentByNumber(text, agents) {
  return agents.find((_, number) => String(number) === text);
}

/**
 * Return the actor after (or, with step -1, before) the chosen one, of those that are annotated at a frame.
 * @param {Actor[]} actors
 * @param {number} frame
 * @param {number | null} chosen an id
 * @param {1 | -1} step
 * @returns {Actor | undefined}
 */
export function nextActor(actors, frame, chosen, step) {
  const present = actors.filter((actor) => actor.states[frame] !== null);
  const position = present.findIndex((actor) => actor.id === chosen);
  if (position < 0) return step > 0 ? present[0] : present[present.length - 1];
  return present[(position + step + present.length) % present.length];
}

// predictions

/**
 * Return the lines that samples draw at a frame. Those that are predicted for a later frame are faint, and those for an
 * earlier one are left out.
 * @param {Sample[]} samples
 * @param {number} frame
 * @returns {DrawnLine[]}
 */
export function linesAt(samples, frame) {
  return samples.flatMap(({ lines }) =>
    lines.flatMap((line) => {
      const [first, last] = line.frames ?? [frame, frame];
      if (frame > last) return [];
      return [frame < first ? { ...line, opacity: FAINT, filled: false } : line];
    }),
  );
}

/**
 * Return the samples of each frame.
 * @param {Sample[]} samples
 */
export function samplesByFrame(samples) {
  /** @type {Map<number, Sample[]>} */
  const byFrame = new Map();
  for (const sample of samples) byFrame.set(sample.frame, [...(byFrame.get(sample.frame) || []), sample]);
  return byFrame;
}

/**
 * Return the last of some frames that is not after another one; null if all are.
 * @param {Iterable<number>} frames
 * @param {number} frame
 */
export function lastBefore(frames, frame) {
  const before = [...frames].filter((sampleFrame) => sampleFrame <= frame);
  return before.length ? Math.max(...before) : null;
}

/**
 * A marked place, and the letters of the agents whose predictions have it.
 * @typedef {DrawnPlace & { by: string[] }} JoinedPlace
 */

/**
 * Join the places of agents that say the same about points that are close to each other.
 * @param {Sample[]} samples
 * @param {Agent[]} agents
 */
export function joinedPlaces(samples, agents) {
  /** @type {Map<string, JoinedPlace>} */
  const byText = new Map();
  for (const { agent, places } of samples) {
    for (const place of places) {
      const middle = middleOf(place.points).map((coordinate) => Math.round(coordinate / CLOSE));
      const key = [place.note, place.label, place.color, ...middle].join(" ");
      const joined = byText.get(key);
      if (joined) joined.by.push(agents[agent].short);
      else byText.set(key, { ...place, by: [agents[agent].short] });
    }
  }
  return [...byText.values()];
}
