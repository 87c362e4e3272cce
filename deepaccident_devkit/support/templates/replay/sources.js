// Where pictures and LiDAR points come from: the page itself, or the server that gives the page (`data.served`).

/** @import { Agent, Camera, ReplayData } from "./types.js" */

const KEPT_CLOUDS = 400;
const WIDTHS = { large: 960, small: 320 }; // of the pictures that a server is asked for, pixels

export class Sources {
  /**
   * @param {ReplayData} data
   * @param {() => void} onCloud called when points of a server have arrived
   */
  constructor(data, onCloud) {
    this.data = data;
    this.served = data.served ?? null;
    this.onCloud = onCloud;
    /** @type {Map<string, Int16Array | null | undefined>} */
    this.clouds = new Map();
  }

  /**
   * Return the address of a camera's picture of a frame that has one.
   * @param {Agent} agent
   * @param {Camera} camera
   * @param {number} frame
   * @param {boolean} isLarge
   */
  picture(agent, camera, frame, isLarge) {
    if (!this.served) return `data:image/jpeg;base64,${camera.pictures[frame]}`;
    const width = isLarge ? WIDTHS.large : WIDTHS.small;
    return `${this.served.folder}images/${agent.name}/${camera.channel}/${frame + 1}?width=${width}`;
  }

  /** The numbers of the agents that have points at any frame. */
  get withPoints() {
    const clouds = this.served ? this.served.points : this.data.points || [];
    return this.data.agents.map((_, agent) => agent).filter((agent) => clouds[agent]);
  }

  /**
   * Return an agent's points, x, y, z, x, y, z, … in centimetres; null where there are none, undefined while they are
   * loaded. Any first part of them is spread over the whole cloud.
   * @param {number} agent its number
   * @param {number} frame
   */
  points(agent, frame) {
    const key = `${agent}/${frame}`;
    if (!this.clouds.has(key)) this.load(key, agent, frame);
    return this.clouds.get(key);
  }

  /**
   * @param {string} key
   * @param {number} agent
   * @param {number} frame
   */
  load(key, agent, frame) {
    if (!this.served) {
      const cloud = this.data.points?.[agent]?.[frame];
      this.clouds.set(key, cloud ? decodedCloud(cloud) : null);
    } else if (this.served.points[agent]?.[frame]) {
      this.ask(key, `${this.served.folder}points/${this.data.agents[agent].name}/${frame + 1}`);
    } else this.clouds.set(key, null);
  }

  /**
   * Ask the server for a cloud; the one that was asked for first is forgotten if there are many.
   * @param {string} key
   * @param {string} address
   */
  async ask(key, address) {
    this.clouds.set(key, undefined);
    const [first] = this.clouds.keys();
    if (this.clouds.size > KEPT_CLOUDS) this.clouds.delete(first);
    try {
      const answer = await fetch(address);
      this.clouds.set(key, decodedCloud(answer.ok ? await answer.text() : ""));
      this.onCloud();
    } catch {
      this.clouds.delete(key); // the server has ended; the next look asks again
    }
  }
}

/**
 * Return the numbers of a cloud: little-endian int16 in base64.
 * @param {string} text
 */
export function decodedCloud(text) {
  const characters = atob(text);
  const view = new DataView(Uint8Array.from(characters, (character) => character.charCodeAt(0)).buffer);
  return Int16Array.from({ length: view.byteLength / 2 }, (_, index) => view.getInt16(2 * index, true));
}
