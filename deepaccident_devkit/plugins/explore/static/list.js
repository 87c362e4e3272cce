// The list of scenarios: what is chosen is shown at once.

const form = document.getElementById("filters");
const FOCUS = "explore-focus";

// Only what is not as usual is part of the address.
function send() {
  const given = new URLSearchParams();
  for (const [name, value] of new FormData(form)) {
    const usual = { q: "", sort: "name", order: "up", view: "grid" };
    if (usual[name] !== value) given.append(name, value);
  }
  const focused = document.activeElement;
  const place = focused && focused.name ? [focused.name, focused.type === "checkbox" ? focused.value : null] : null;
  sessionStorage.setItem(FOCUS, JSON.stringify({ place, scroll: form.querySelector("aside").scrollTop, y: scrollY }));
  location.assign(`${form.getAttribute("action")}?${given}`);
}

form.addEventListener("change", (event) => {
  if (event.target.id !== "query") send();
});
form.addEventListener("submit", (event) => {
  event.preventDefault();
  send();
});

// A reader who uses the keyboard goes on where he was.
const kept = JSON.parse(sessionStorage.getItem(FOCUS) || "null");
sessionStorage.removeItem(FOCUS);
if (kept) {
  const [name, value] = kept.place || [];
  const found = [...form.elements].find((each) => each.name === name && (value === null || each.value === value));
  if (found) {
    const facet = found.closest("details");
    if (facet) facet.open = true;
    found.focus({ preventScroll: true });
  }
  scrollTo(0, kept.y);
}
