// The list of scenarios: what is chosen is shown at once.

import { queryOf } from "./filters.js";

const FOCUS = "explore-focus";

/**
 * What has the focus before the list is loaded again, and how far it is scrolled. `value` tells checkboxes apart.
 * @typedef {{ focus: { name: string, value: string | null } | null, scroll: number }} Position
 */

/** @param {HTMLFormElement} form */
function send(form) {
  /** @type {[string, string][]} */
  const choices = [...new FormData(form)].map(([name, value]) => [name, String(value)]);
  /** @type {Position} */
  const position = { focus: focusIn(document.activeElement), scroll: scrollY };
  sessionStorage.setItem(FOCUS, JSON.stringify(position));
  location.assign(`${form.getAttribute("action")}?${queryOf(choices)}`);
}

/** @param {Element | null} element */
function focusIn(element) {
  if (element instanceof HTMLInputElement && element.type === "checkbox") {
    return { name: element.name, value: element.value };
  }
  const hasName = element instanceof HTMLInputElement || element instanceof HTMLSelectElement;
  return hasName && element.name ? { name: element.name, value: null } : null;
}

/**
 * Go on where a reader who uses the keyboard was.
 * @param {HTMLFormElement} form
 */
function restore(form) {
  /** @type {Position | null} */
  const position = JSON.parse(sessionStorage.getItem(FOCUS) ?? "null");
  sessionStorage.removeItem(FOCUS);
  if (!position) return;
  const { focus } = position;
  for (const element of form.elements) {
    if (!focus || !(element instanceof HTMLInputElement || element instanceof HTMLSelectElement)) continue;
    if (element.name !== focus.name || (focus.value !== null && element.value !== focus.value)) continue;
    const facet = element.closest("details");
    if (facet) facet.open = true;
    element.focus({ preventScroll: true });
    break;
  }
  scrollTo(0, position.scroll);
}

const filters = document.getElementById("filters");
if (filters instanceof HTMLFormElement) {
  filters.addEventListener("change", (event) => {
    if (event.target instanceof Element && event.target.id !== "query") send(filters);
  });
  filters.addEventListener("submit", (event) => {
    event.preventDefault();
    send(filters);
  });
  restore(filters);
}
