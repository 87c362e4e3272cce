"""`Browser`: a page opened in chromium without a window; what it says, asks for, and looks like."""

import json
import time
from pathlib import Path
from typing import Any

OVERFLOWING = """
const width = document.documentElement.clientWidth;
const scrolls = (element) => element && (element.classList.contains('wide') || scrolls(element.parentElement));
return [...document.querySelectorAll('body *')]
  .filter((each) => !each.ownerSVGElement)  // a drawing is cut off at its edges
  .filter((each) => each.getBoundingClientRect().right > width + 1 && !scrolls(each.parentElement))
  .map((each) => each.outerHTML.slice(0, 200));
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
        """What the console says since the page was opened, warnings too.

        Not that a processor without a graphics card waits for its WebGL pictures.
        """
        told = [entry["message"] for entry in self.driver.get_log("browser")]
        return [each for each in told if "GPU stall due to ReadPixels" not in each]

    def requests(self) -> list[str]:
        """The addresses asked for since the page was opened, its own first.

        Not data that stand in the page, nor the browser's own start page, which may still be on its
        way.
        """
        events = [
            json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")
        ]
        asked = [each["params"] for each in events if each["method"] == "Network.requestWillBeSent"]
        return [
            each["request"]["url"]
            for each in asked
            if not each["request"]["url"].startswith(("data:", "chrome:"))
        ]

    def script(self, code: str) -> Any:
        """What JavaScript returns."""
        return self.driver.execute_script(code)

    def value(self, expression: str) -> Any:
        """What a JavaScript expression gives."""
        return self.script(f"return {expression}")

    def frame(self) -> int:
        """The frame that a replay shows, from 0 on."""
        return int(self.value("document.getElementById('scrubber').value"))

    def go_to(self, frame: int, document: str = "document") -> None:
        """Let a replay show a frame, from 0 on; `document` is the expression of its document."""
        self.script(f"{document}.dispatchEvent(new CustomEvent('go', {{ detail: {frame} }}))")

    def faults(self) -> dict[str, Any]:
        """What no page may have, by kind: what overflows, what the console says, pictures that are
        not loaded.
        """
        pictures = (
            "[...document.images].filter((each) => each.src && "
            "!each.naturalWidth).map((each) => each.outerHTML)"
        )
        wide = self.value("document.documentElement.scrollWidth - innerWidth")
        found = {
            "overflows": self.overflowing(),
            "is wider than the window": max(0, wide),
            "complains": self.complaints(),
            "is not loaded": self.value(pictures),
        }
        return {kind: each for kind, each in found.items() if each}

    def wait(self, condition: str, seconds: float = 60.0) -> Any:
        """What a JavaScript expression gives as soon as that is true; fails if it never is."""
        end = time.monotonic() + seconds
        while not (found := self.script(f"return {condition}")):
            assert time.monotonic() < end, f"waited in vain for {condition}"
            time.sleep(0.05)
        return found

    def press(self, *keys: str) -> None:
        """Press keys, one after the other, where the focus is."""
        from selenium.webdriver import ActionChains

        ActionChains(self.driver).send_keys(*keys).perform()

    def overflowing(self) -> list[str]:
        """Elements that reach beyond the right edge, outside of boxes that scroll (class
        `wide`).
        """
        found: list[str] = self.script(OVERFLOWING)
        return found

    def scheme(self) -> str:
        """`dark` if the page has light letters, else `light`."""
        ink = self.script("return getComputedStyle(document.body).color")
        return "dark" if sum(map(int, ink[4:-1].split(","))) > 3 * 128 else "light"
