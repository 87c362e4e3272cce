// The parts of a page that take longer: they are loaded one after the other when the rest is there.

async function load() {
  /** @type {NodeListOf<HTMLElement>} */
  const places = document.querySelectorAll("[data-part]");
  for (const place of places) {
    try {
      const answer = await fetch(place.dataset.part ?? "");
      const text = await answer.text();
      if (answer.ok) place.innerHTML = text; // the server escapes all names; scripts in it would not run
      else place.textContent = "This cannot be told.";
    } catch {
      place.textContent = "The server has ended.";
      break;
    }
  }
}

load();
