import { test } from "node:test";
import { changed, channelsOf, lightened, mixed } from "../../deepaccident_devkit/support/templates/replay/colors.js";
import { assertClose } from "./scene.js";

test("channels are from 0 to 1", () => {
  assertClose(channelsOf("#ff0033"), [1, 0, 0.2]);
});

test("colours are mixed between their neighbours, and not beyond the ends", () => {
  const colors = [[0, 0, 0], [1, 0, 0], [1, 1, 0.5]];
  assertClose(mixed(colors, 0.25), [0.5, 0, 0]);
  assertClose(mixed(colors, 0.75), [1, 0.5, 0.25]);
  assertClose(mixed(colors, -1), [0, 0, 0]);
  assertClose(mixed(colors, 2), [1, 1, 0.5]);
});

test("a lighter colour is nearer to white", () => {
  assertClose(lightened([0, 0.5, 1]), [0.3, 0.65, 1]);
});

test("all channels are changed", () => {
  assertClose(changed([0.1, 0.2, 0.3], (channel) => 2 * channel), [0.2, 0.4, 0.6]);
});
