// Keys of all pages: "/" goes to the query, n and p to the next and previous page or sample, j and k along the entries.

import { nextEntry } from "./entries.js";

/** @param {1 | -1} step */
function goAlong(step) {
  /** @type {HTMLAnchorElement[]} */
  const entries = [...document.querySelectorAll("a.entry")].filter((entry) => entry instanceof HTMLAnchorElement);
  const at = entries.findIndex((entry) => entry === document.activeElement);
  entries[nextEntry(at, step, entries.length)]?.focus();
}

/** @param {"next" | "prev"} relation */
function follow(relation) {
  const link = document.querySelector(`a[rel="${relation}"]`);
  if (link instanceof HTMLAnchorElement) link.click();
}

/** @type {Record<string, () => void>} */
const keys = {
  "/": () => document.getElementById("query")?.focus(),
  n: () => follow("next"),
  p: () => follow("prev"),
  j: () => goAlong(1),
  k: () => goAlong(-1),
};
document.addEventListener("keydown", (event) => {
  if (event.target instanceof Element && event.target.closest("input, select, textarea")) return;
  if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});
