// A page that waits for work in the background: it loads itself again when a piece of that work is done.

const POLL = 1000; // milliseconds

function isTyping() {
  return document.activeElement !== null && document.activeElement.matches("input[type=search]");
}

/**
 * Ask what is still being computed, until that is less than the page waits for.
 * @param {HTMLElement} place
 * @param {string[]} titles of what the page waits for
 */
async function look(place, titles) {
  try {
    const answer = await fetch(place.dataset.waiting ?? "");
    /** @type {string[]} */
    const left = await answer.json();
    const isUnchanged = titles.every((title) => left.includes(title));
    if (isTyping() || isUnchanged) setTimeout(() => look(place, titles), POLL);
    else location.reload();
  } catch {
    place.textContent = "The server has ended.";
  }
}

/** @type {NodeListOf<HTMLElement>} */
const places = document.querySelectorAll("[data-titles]");
for (const place of places) {
  /** @type {string[]} */
  const titles = JSON.parse(place.dataset.titles ?? "[]");
  if (titles.length) setTimeout(() => look(place, titles), POLL);
}
