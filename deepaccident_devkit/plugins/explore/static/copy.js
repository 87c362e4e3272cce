// Buttons that copy code.

/** @type {NodeListOf<HTMLElement>} */
const buttons = document.querySelectorAll(".copy");
for (const button of buttons) {
  button.addEventListener("click", async () => {
    const text = button.dataset.text ?? "";
    const answer = document.getElementById("copied");
    if (!answer) return;
    try {
      await navigator.clipboard.writeText(text);
      answer.textContent = "copied";
    } catch {
      answer.textContent = text; // there is no clipboard: readers copy the text themselves
    }
  });
}
