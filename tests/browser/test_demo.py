"""The page of `deepaccident demo`, opened as its reader opens it."""

from pathlib import Path

import pytest
from chromium import Browser

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("width", [1280, 700])
def test_the_page_shows_pictures_replay_and_report(width: int, made_demo: tuple[Path, str], browser: Browser) -> None:
    out, _ = made_demo
    browser.open(out / "index.html", width)
    assert browser.script("return document.compatMode") == "CSS1Compat"
    assert browser.script("return document.images.length") == 4
    assert browser.script("return [...document.images].filter((each) => !each.naturalWidth).length") == 0
    assert browser.overflowing() == []
    assert browser.script("return document.documentElement.scrollWidth") <= width
    frames = browser.driver.find_elements("tag name", "iframe")
    titles = []
    for frame in frames:
        browser.driver.execute_script("arguments[0].scrollIntoView()", frame)  # the browser loads it when it is near
        browser.driver.switch_to.frame(frame)
        titles.append(browser.script("return document.title"))
        assert browser.script("return document.documentElement.scrollWidth <= innerWidth")
        browser.driver.switch_to.default_content()
    assert [title.split(":")[0] for title in titles] == ["Accident replay", "DeepAccident evaluation"]
    assert browser.complaints() == []
    assert [each for each in browser.requests() if not each.startswith(out.as_uri())] == []
