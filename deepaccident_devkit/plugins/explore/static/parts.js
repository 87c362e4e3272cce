// The parts of a page that take longer: asked for one after the other, when the rest is there.

for (const place of document.querySelectorAll("[data-part]")) {
  try {
    const answer = await fetch(place.dataset.part);
    const text = await answer.text();
    if (answer.ok) place.innerHTML = text; // made by the server, which escapes all names; scripts in it would not run
    else place.textContent = "This cannot be told.";
  } catch {
    place.textContent = "The server has ended.";
    break;
  }
}
