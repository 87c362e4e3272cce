// Buttons that copy code.

for (const button of document.querySelectorAll(".copy")) {
  button.addEventListener("click", async () => {
    const said = document.getElementById("copied");
    try {
      await navigator.clipboard.writeText(button.dataset.text);
      said.textContent = "copied";
    } catch {
      said.textContent = button.dataset.text; // no clipboard here: the reader copies it himself
    }
  });
}
