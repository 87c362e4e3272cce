// Controls by which the reader chooses what is shown; each brings the page up to date.

import { byId, made } from "./elements.js";
import { show } from "./refresh.js";

/**
 * Fill a <select>.
 * @param {HTMLSelectElement} element
 * @param {[value: string, text: string][]} options
 * @param {string} chosen
 * @param {(value: string) => void} onChange
 */
export function selection(element, options, chosen, onChange) {
  element.append(...options.map(([value, text]) => made("option", { value, textContent: text })));
  element.value = chosen;
  element.addEventListener("change", () => {
    onChange(element.value);
    show();
  });
}

/**
 * Add a checkbox to a group.
 * @param {string} group its id
 * @param {string} id
 * @param {string} title
 * @param {boolean} checked
 * @param {(checked: boolean) => void} onChange
 */
export function addCheckbox(group, id, title, checked, onChange) {
  const box = made("input", { type: "checkbox", checked, id });
  box.addEventListener("change", () => {
    onChange(box.checked);
    show();
  });
  byId(group).append(made("label", {}, box, ` ${title}`));
}
