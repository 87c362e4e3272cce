// The filters of the list of scenarios, as they stand in its address.

/** @type {Record<string, string>} */
const USUAL = { q: "", sort: "name", order: "up", view: "grid" };

/**
 * Return the query of the list's address: only what is not as usual.
 * @param {Iterable<[name: string, value: string]>} choices
 */
export function queryOf(choices) {
  const query = new URLSearchParams();
  for (const [name, value] of choices) if (USUAL[name] !== value) query.append(name, value);
  return query.toString();
}
