"""`Browser`: open a page in headless Chromium and read its console, its requests and its layout."""

import json
import time
from pathlib import Path
from typing import Any

OVERFLOW_SCRIPT = """
const width = document.documentElement.clientWidth;
const scrolls = (element) => element && (element.classList.contains('wide') || scrolls(element.parentElement));
return [...document.querySelectorAll('body *')]
  .filter((element) => !element.ownerSVGElement)  // a drawing is cut off at its edges
  .filter((element) => element.getBoundingClientRect().right > width + 1 && !scrolls(element.parentElement))
  .map((element) => element.outerHTML.slice(0, 200));
"""  # noqa: E501


class Browser:
    """One chromium for all tests; pages are opened one after the other."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, page: Path | str, width: int, height: int = 900) -> None:
        """Open a file or an address in a window of a width and height, in pixels, as on a screen of
        that size.
        """
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        for kind in ("browser", "performance"):
            self.driver.get_log(kind)  # what came before is not this page's
        self.driver.get(page if isinstance(page, str) else page.resolve().as_uri())

    def complaints(self) -> list[str]:
        """Return the console messages since the page was opened, warnings included.

        A processor without a graphics card waits for WebGL, which is not one of them.
        """
        messages = [entry["message"] for entry in self.driver.get_log("browser")]
        return [message for message in messages if "GPU stall due to ReadPixels" not in message]

    def requests(self) -> list[str]:
        """Return the addresses requested since the page was opened, its own first.

        Without embedded data and the browser's own start page, which may still be loading.
        """
        urls = []
        for entry in self.driver.get_log("performance"):
            event = json.loads(entry["message"])["message"]
            if event["method"] == "Network.requestWillBeSent":
                urls.append(event["params"]["request"]["url"])
        return [url for url in urls if not url.startswith(("data:", "chrome:"))]

    def script(self, code: str) -> Any:
        """Run JavaScript and return its result."""
        return self.driver.execute_script(code)

    def value(self, expression: str) -> Any:
        """Evaluate a JavaScript expression."""
        return self.script(f"return {expression}")

    def frame(self) -> int:
        """Return the frame that a replay shows, from 0 on."""
        return int(self.value("document.getElementById('scrubber').value"))

    def go_to(self, frame: int, document: str = "document") -> None:
        """Let a replay show a frame, from 0 on; `document` is the expression of its document."""
        self.script(f"{document}.dispatchEvent(new CustomEvent('go', {{ detail: {frame} }}))")

    def faults(self) -> dict[str, Any]:
        """Return by kind what no page may have: overflow, console messages, missing pictures."""
        self.script("for (const image of document.images) image.loading = 'eager'")
        self.wait("[...document.images].every((image) => image.complete)")
        missing_pictures = (
            "[...document.images].filter((image) => image.src && "
            "!image.naturalWidth).map((image) => image.outerHTML)"
        )
        excess_width_px = self.value("document.documentElement.scrollWidth - innerWidth")
        faults = {
            "overflows": self.overflowing(),
            "is wider than the window": max(0, excess_width_px),
            "complains": self.complaints(),
            "is not loaded": self.value(missing_pictures),
        }
        return {kind: fault for kind, fault in faults.items() if fault}

    def wait(self, condition: str, seconds: float = 60.0) -> Any:
        """Wait until a JavaScript expression is true and return its value; fail if it never is."""
        deadline = time.monotonic() + seconds
        while not (result := self.value(condition)):
            assert time.monotonic() < deadline, f"waited in vain for {condition}"
            time.sleep(0.05)
        return result

    def press(self, *keys: str) -> None:
        """Press keys, one after the other, where the focus is."""
        from selenium.webdriver import ActionChains

        ActionChains(self.driver).send_keys(*keys).perform()

    def overflowing(self) -> list[str]:
        """Return the elements beyond the right edge that are not in a box that scrolls (`wide`)."""
        elements: list[str] = self.script(OVERFLOW_SCRIPT)
        return elements

    def scheme(self) -> str:
        """Return `dark` if the page has light letters, otherwise `light`."""
        text_color = self.value("getComputedStyle(document.body).color")
        red, green, blue = map(int, text_color[4:-1].split(","))
        return "dark" if red + green + blue > 3 * 128 else "light"
