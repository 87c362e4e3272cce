// A page that waits for work in the background: it loads itself again when a piece of that work is done.

const POLL = 1000; // milliseconds

function isTyping() {
  return document.activeElement !== null && document.activeElement.matches("input[type=search]");
}

/**
 * Ask what is still being computed, until that is less than the page waits for.
 * @param {HTMLElement} element
 * @param {string[]} titles of what the page waits for
 */
async function look(element, titles) {
  try {
    const answer = await fetch(element.dataset.waiting ?? "");
    /** @type {string[]} */
    const left = await answer.json();
    const isUnchanged = titles.every((title) => left.includes(title));
    if (isTyping() || isUnchanged) setTimeout(() => look(element, titles), POLL);
    else location.reload();
  } catch {
    element.textContent = "The server has ended.";
  }
}

/** @type {NodeListOf<HTMLElement>} */
const elements = document.querySelectorAll("[data-titles]");
for (const element of elements) {
  /** @type {string[]} */
  const titles = JSON.parse(element.dataset.titles ?? "[]");
  if (titles.length) setTimeout(() => look(element, titles), POLL);
}
