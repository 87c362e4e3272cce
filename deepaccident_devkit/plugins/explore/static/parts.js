// The parts of a page that take longer: they are loaded one after the other when the rest is there.

async function load() {
  /** @type {NodeListOf<HTMLElement>} */
  const elements = document.querySelectorAll("[data-part]");
  for (const element of elements) {
    try {
      const answer = await fetch(element.dataset.part ?? "");
      const text = await answer.text();
      if (answer.ok) element.innerHTML = text; // the server escapes all names; scripts in it would not run
      else element.textContent = "This cannot be told.";
    } catch {
      element.textContent = "The server has ended.";
      break;
    }
  }
}

load();
