// A page that waits for work in the background: it loads itself again when a piece of that work is done.

const POLL = 1000; // milliseconds
const isTyping = () => document.activeElement !== null && document.activeElement.matches("input[type=search]");

for (const place of document.querySelectorAll("[data-titles]")) {
  const wanted = JSON.parse(place.dataset.titles);
  const look = async () => {
    try {
      const left = await (await fetch(place.dataset.waiting)).json();
      if (isTyping() || wanted.every((title) => left.includes(title))) setTimeout(look, POLL);
      else location.reload();
    } catch {
      place.textContent = "The server has ended.";
    }
  };
  if (wanted.length) setTimeout(look, POLL);
}
