// What is known of actors at a frame: who sees them, how fast they are, which of them is an agent.

/** @import { Actor, ActorState, Agent, Alarm, Colors, Sample } from "./types.js" */

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
 * @param {string} verdict
 * @param {Colors} colors
 */
export function verdictColor(verdict, colors) {
  if (verdict === "TP" || verdict === "TN") return colors.right;
  if (verdict === "FN") return colors.missed;
  return verdict === "not judged" ? colors.grid : colors.false;
}

/**
 * Return the colour of a sample's mark. Where a task draws the sample, it is red if an alarm fires, or something collides.
 * @param {Sample} sample
 * @param {Colors} colors
 */
export function sampleColor(sample, colors) {
  if (!sample.lines) return verdictColor(sample.verdict, colors);
  const isGrave = sample.alarm ? sample.alarm.fires : sample.places?.some((place) => place.color === colors.pair);
  return isGrave ? colors.pair : colors.points;
}

/**
 * Return the lines that samples draw at a frame: passing ones only at the frame of their sample.
 * @param {Sample[]} samples
 * @param {number} frame
 */
export function linesAt(samples, frame) {
  return samples.flatMap((sample) => (sample.lines ?? []).filter((line) => !line.passing || sample.frame === frame));
}

/**
 * @param {Alarm} alarm
 * @param {Colors} colors
 */
export function alarmColor(alarm, colors) {
  return alarm.right ? colors.right : colors.false;
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
 * An alarm, the letters of the agents that raise it, and the actors that it names.
 * @typedef {Alarm & { by: string[], names: string }} JoinedAlarm
 */

/**
 * Join the alarms of agents that predict the same. Actors are named unless they are the colliding pair.
 * @param {Sample[]} samples
 * @param {Agent[]} agents
 * @param {number[]} pair ids
 */
export function joinedAlarms(samples, agents, pair) {
  /** @type {Map<string, JoinedAlarm>} */
  const byText = new Map();
  for (const { agent, alarms } of samples) {
    for (const alarm of alarms) {
      const isPair = alarm.actors.length === 2 && alarm.actors.every((id) => pair.includes(id));
      const names = alarm.actors.length && !isPair ? `: ${alarm.actors.join(", ")}` : "";
      const [one, other] = alarm.places;
      const middle = [Math.round((one[0] + other[0]) / 400), Math.round((one[1] + other[1]) / 400)];
      const key = [alarm.right, alarm.time, names, ...middle].join(" ");
      const joined = byText.get(key);
      if (joined) joined.by.push(agents[agent].short);
      else byText.set(key, { ...alarm, names, by: [agents[agent].short] });
    }
  }
  return [...byText.values()];
}
