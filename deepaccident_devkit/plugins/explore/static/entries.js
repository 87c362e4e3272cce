// Moving along the entries of a list by keys.

/**
 * Return the number of the entry to go to; from none, the first or, with step -1, the last one.
 * @param {number} at the number of the entry that has the focus; -1 for none
 * @param {1 | -1} step
 * @param {number} count of entries; there may be none
 */
export function nextEntry(at, step, count) {
  if (at < 0) return step > 0 ? 0 : count - 1;
  return Math.min(count - 1, Math.max(0, at + step));
}
