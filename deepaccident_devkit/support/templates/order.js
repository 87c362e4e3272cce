// The order of table rows by the keys of their cells.

/** @typedef {string | number | null} Key a text, a number, or null for an unknown value */

/**
 * Return the key of a cell: its `data-key`, a number or empty for an unknown value, or else its text.
 * @param {string} text
 * @param {string} [key]
 * @returns {Key}
 */
export function keyOf(text, key) {
  if (key === undefined) return text.trim();
  return key === "" ? null : Number(key);
}

/**
 * Compare two known keys: numbers by value, texts by the alphabet and the numbers in them.
 * @param {string | number} one
 * @param {string | number} other
 */
function compare(one, other) {
  if (typeof one === "number" && typeof other === "number") return one - other;
  return String(one).localeCompare(String(other), "en", { numeric: true });
}

/**
 * Return items in the order of their keys. Unknown keys are last, and equal ones keep their order, in both directions.
 * @template Item
 * @param {Item[]} items
 * @param {(item: Item) => Key} keyOfItem
 * @param {boolean} isAscending
 */
export function ordered(items, keyOfItem, isAscending) {
  /** @type {{ item: Item, key: string | number }[]} */
  const known = [];
  /** @type {Item[]} */
  const unknown = [];
  for (const item of items) {
    const key = keyOfItem(item);
    if (key === null) unknown.push(item);
    else known.push({ item, key });
  }
  const sign = isAscending ? 1 : -1;
  known.sort((one, other) => sign * compare(one.key, other.key));
  return [...known.map((entry) => entry.item), ...unknown];
}
