// Keys of all pages: "/" goes to the query, "n" and "p" to the next and previous page or sample, j and k along entries.

const links = () => [...document.querySelectorAll("a.entry")];

function along(step) {
  const all = links();
  const at = all.indexOf(document.activeElement);
  const next = all[at < 0 ? (step > 0 ? 0 : all.length - 1) : Math.min(all.length - 1, Math.max(0, at + step))];
  if (next) next.focus();
}

function follow(relation) {
  const link = document.querySelector(`a[rel="${relation}"]`);
  if (link) link.click();
}

const keys = {
  "/": () => document.getElementById("query")?.focus(),
  n: () => follow("next"),
  p: () => follow("prev"),
  j: () => along(1),
  k: () => along(-1),
};
document.addEventListener("keydown", (event) => {
  if (event.target.closest("input, select, textarea")) return;
  if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});
