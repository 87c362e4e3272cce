"use strict";

// Where pictures and LiDAR points are: in the page itself or, of a page that a server gives (`data.served`), there.

const KEPT_CLOUDS = 400;
const WIDE = { large: 960, small: 320 }; // pixels of the pictures that a server is asked for

class Sources {
  constructor(data, arrived) {
    this.data = data;
    this.served = data.served || null;
    this.arrived = arrived;
    this.clouds = new Map();
  }

  // The address of a camera's picture of a frame that has one.
  picture(agent, camera, frame, large) {
    if (!this.served) return `data:image/jpeg;base64,${camera.pictures[frame]}`;
    const width = large ? WIDE.large : WIDE.small;
    return `${this.served.folder}images/${agent.name}/${camera.channel}/${frame + 1}?width=${width}`;
  }

  // The agents, by number, that have points at any frame.
  get withPoints() {
    const clouds = this.served ? this.served.points : this.data.points || [];
    return this.data.agents.map((_, bit) => bit).filter((bit) => clouds[bit]);
  }

  // Points of an agent, x, y, z, x, y, z, … in decimetres; null where there are none, undefined as long as they are on
  // their way.
  points(bit, frame) {
    const key = `${bit}/${frame}`;
    if (!this.clouds.has(key)) this.get(key, bit, frame);
    return this.clouds.get(key);
  }

  get(key, bit, frame) {
    const there = (this.served ? this.served : this.data).points[bit][frame];
    if (there === true) this.ask(key, bit, frame);
    else this.clouds.set(key, typeof there === "string" ? decodedCloud(there) : null);
  }

  ask(key, bit, frame) {
    this.clouds.set(key, undefined);
    if (this.clouds.size > KEPT_CLOUDS) this.clouds.delete(this.clouds.keys().next().value);
    fetch(`${this.served.folder}points/${this.data.agents[bit].name}/${frame + 1}`)
      .then((answer) => (answer.ok ? answer.text() : ""))
      .then((coded) => {
        this.clouds.set(key, decodedCloud(coded));
        this.arrived();
      })
      .catch(() => this.clouds.delete(key)); // the server has ended; another look asks again
  }
}

// Little-endian int16 from base64: x, y, z, x, y, z, …, decimetres.
function decodedCloud(coded) {
  const text = atob(coded);
  const view = new DataView(Uint8Array.from(text, (character) => character.charCodeAt(0)).buffer);
  return Int16Array.from({ length: view.byteLength / 2 }, (_, index) => view.getInt16(2 * index, true));
}
