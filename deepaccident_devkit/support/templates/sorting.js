// A click on the heading of a column sorts the table's rows by it; another click reverses the order.

import { keyOf, ordered } from "./order.js";

/**
 * @param {HTMLTableElement} table
 * @param {HTMLTableCellElement[]} headings
 * @param {number} column
 */
function sort(table, headings, column) {
  const isAscending = headings[column].getAttribute("aria-sort") !== "ascending";
  for (const heading of headings) heading.removeAttribute("aria-sort");
  headings[column].setAttribute("aria-sort", isAscending ? "ascending" : "descending");
  const [body] = table.tBodies;
  const keyOfRow = (/** @type {HTMLTableRowElement} */ row) => {
    const cell = row.cells[column];
    return keyOf(cell.textContent ?? "", cell.dataset.key);
  };
  body.append(...ordered([...body.rows], keyOfRow, isAscending));
}

/** @type {NodeListOf<HTMLTableElement>} */
const tables = document.querySelectorAll("table.sortable");
for (const table of tables) {
  const rows = table.tHead?.rows;
  if (!rows) continue;
  const headings = [...rows[rows.length - 1].cells];
  for (const [column, heading] of headings.entries()) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => sort(table, headings, column));
  }
}
