import assert from "node:assert/strict";
import { test } from "node:test";
import { decodedCloud, Sources } from "../../deepaccident_devkit/support/templates/replay/sources.js";

const CLOUD = "AQD+/ywB"; // 1, -2, 300
const AGENTS = [{ name: "ego_vehicle" }, { name: "other_vehicle" }];

test("a cloud is little-endian int16", () => {
  assert.deepEqual([...decodedCloud(CLOUD)], [1, -2, 300]);
  assert.deepEqual([...decodedCloud("")], []);
});

test("a page has its own pictures and points", () => {
  const sources = new Sources({ agents: AGENTS, points: [null, [CLOUD, null]] }, () => {});
  assert.equal(sources.picture(AGENTS[0], { pictures: ["abc"] }, 0, true), "data:image/jpeg;base64,abc");
  assert.deepEqual(sources.withPoints, [1]);
  assert.deepEqual([...sources.points(1, 0)], [1, -2, 300]);
  assert.deepEqual([sources.points(1, 1), sources.points(0, 0)], [null, null]);
  assert.deepEqual(new Sources({ agents: AGENTS, points: null }, () => {}).withPoints, []);
});

function servedSources(fetched, onCloud = () => {}) {
  globalThis.fetch = fetched;
  const served = { folder: "at/", points: [[true, false], null] };
  return new Sources({ agents: AGENTS, points: null, served }, onCloud);
}

test("a server has pictures of two sizes", () => {
  const sources = servedSources(() => {});
  const addresses = [true, false].map((isLarge) => sources.picture(AGENTS[1], { channel: "Camera_Front" }, 4, isLarge));
  assert.deepEqual(addresses, [
    "at/images/other_vehicle/Camera_Front/5?width=960",
    "at/images/other_vehicle/Camera_Front/5?width=320",
  ]);
});

test("a server is asked once for a cloud, and where it has any", async () => {
  const asked = [];
  const arrived = new Promise((resolve) => {
    const sources = servedSources(async (address) => {
      asked.push(address);
      return { ok: true, text: async () => CLOUD };
    }, () => resolve(sources));
    assert.deepEqual([sources.points(0, 0), sources.points(0, 0), sources.points(0, 1), sources.points(1, 0)], [
      undefined,
      undefined,
      null,
      null,
    ]);
  });
  const sources = await arrived;
  assert.deepEqual([...sources.points(0, 0)], [1, -2, 300]);
  assert.deepEqual(asked, ["at/points/ego_vehicle/1"]);
});

test("a server that has ended is asked again", async () => {
  let count = 0;
  const sources = servedSources(async () => {
    count += 1;
    throw new TypeError("failed to fetch");
  });
  sources.points(0, 0);
  await new Promise(setImmediate);
  sources.points(0, 0);
  assert.equal(count, 2);
});
