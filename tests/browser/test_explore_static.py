"""Pages as files, opened from a disk as a reader opens them: nothing else is asked for, tables sort, replays play."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from chromium import Browser
from evaluation_runs import stored_run
from processes import wait_for
from replay_page import accident

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs import save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.explore import export_pages

pytestmark = pytest.mark.slow

COLUMN = """
const table = document.querySelector('.sortable');
const column = [...table.tHead.rows[0].cells].findIndex((each) => each.textContent === '%s');
return [...table.tBodies[0].rows].map((row) => row.cells[column].textContent);
"""
CLICK = "[...document.querySelectorAll('.sortable button')].find((each) => each.textContent === '%s').click();"


@pytest.fixture(scope="module")
def index(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a release with images; the name of its folder has a blank and what addresses escape."""
    return export_pages(da, tmp_path_factory.mktemp("export") / "for a talk #1 100%", workers=1)


@pytest.fixture(scope="module")
def judged(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("judged")
    run, _ = stored_run(da_motion, EvaluationSetup(task="accident", protocol="boxes"), folder / "first.json")
    bundle = save_run(run, folder / "first", include_results=True)
    return export_pages(da_motion, folder / "out", bundles=[bundle], workers=1)


def own_page(index: Path, dataset: DeepAccident) -> Path:
    return index.parent / accident(dataset) / "index.html"


def asked_for(browser: Browser) -> set[Path]:
    return {Path(unquote(urlsplit(address).path)) for address in browser.requests()}


def wait_for_replay(browser: Browser) -> None:
    """Go into the frame, when its scripts have run."""
    browser.driver.switch_to.frame(browser.driver.find_element("css selector", "iframe"))
    wait_for(lambda: browser.script("return document.getElementById('time').textContent.includes('frame 1')"))


def test_it_opens_without_a_complaint(index: Path, da: DeepAccident, browser: Browser, scheme: str) -> None:
    for page in (index, own_page(index, da)):
        for width in (1280, 400):
            browser.open(page, width)
            assert browser.overflowing() == []
            assert browser.scheme() == scheme
            assert browser.script("return [...document.images].filter((each) => !each.naturalWidth).length") == 0
            if page != index:
                wait_for_replay(browser)
                browser.driver.switch_to.default_content()
            asked = asked_for(browser)
            assert {path for path in asked if not path.is_relative_to(index.parent)} == set()
            assert {path for path in asked if not path.is_file()} == set()
            of_all = {"pages.css", "explore.css", "keys.js"} | ({"sorting.js"} if page == index else set())
            assert of_all < {path.name for path in asked}
            assert browser.complaints() == []


def test_a_click_sorts(index: Path, browser: Browser) -> None:
    browser.open(index, 1280)
    names = browser.script(COLUMN % "scenario")
    for heading in ("least TTC (s)", "lead, all (s)", "visibility"):
        browser.script(CLICK % heading)
        known = [value for value in browser.script(COLUMN % heading) if value != "–"]
        if heading != "visibility":
            assert [*map(float, known)] == sorted(map(float, known))
        assert browser.script(COLUMN % heading)[: len(known)] == known  # unknown ones are last
    browser.script(CLICK % "scenario")
    browser.script(CLICK % "scenario")
    assert browser.script(COLUMN % "scenario") == sorted(names, reverse=True)
    assert browser.complaints() == []


def test_keys_lead_from_page_to_page(index: Path, browser: Browser) -> None:
    browser.open(index, 1280)
    tokens = browser.script(COLUMN % "scenario")
    body = browser.driver.find_element("css selector", "body")
    body.send_keys("j")
    browser.script("document.activeElement.click()")
    wait_for(lambda: tokens[0] in browser.driver.title)
    for key, token in (("n", tokens[1]), ("p", tokens[0])):
        browser.driver.find_element("css selector", "body").send_keys(key)
        wait_for(lambda token=token: token in browser.driver.title)
    browser.driver.find_element("link text", "All scenarios").click()
    wait_for(lambda: browser.driver.title.startswith(f"{len(tokens)} scenarios"))


def test_the_replay_plays_in_its_frame(index: Path, da: DeepAccident, browser: Browser) -> None:
    browser.open(own_page(index, da), 1280)
    wait_for_replay(browser)
    assert browser.script("return [...document.images].filter((each) => each.src && !each.naturalWidth).length") == 0
    browser.driver.find_element("id", "play").click()
    wait_for(lambda: int(browser.script("return document.getElementById('scrubber').value")) > 0)
    browser.driver.switch_to.default_content()
    browser.driver.find_element("link text", "The replay alone").click()
    wait_for(lambda: "Accident replay" in browser.driver.title)
    assert browser.complaints() == []


def test_predictions_and_verdicts_are_shown(judged: Path, da_motion: DeepAccident, browser: Browser) -> None:
    browser.open(own_page(judged, da_motion), 1280)
    assert browser.overflowing() == []
    wait_for_replay(browser)
    assert not browser.script("return document.getElementById('verdict').hidden")
    browser.driver.switch_to.default_content()
    assert browser.complaints() == []
