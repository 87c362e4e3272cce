"""The safety report, opened as a reader opens it: it asks for nothing, sorts by a click, and leads to replays."""

from pathlib import Path

import pytest
from chromium import Browser

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.safety import safety_report
from deepaccident_devkit.safety.page import save_safety_report

pytestmark = pytest.mark.slow

COLUMN = """
const headings = [...document.querySelector('.sortable').tHead.rows[1].cells];
const column = headings.findIndex((each) => each.textContent === '%s');
return [...document.querySelector('.sortable').tBodies[0].rows].map((row) => row.cells[column].textContent);
"""
CLICK = """
[...document.querySelectorAll('.sortable button')].find((each) => each.textContent === '%s').click();
"""


@pytest.fixture(scope="module")
def page(da_b: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    report = safety_report(da_b, workers=1)
    return save_safety_report(report, tmp_path_factory.mktemp("safety"), dataset=da_b, replays=1, workers=1)[-1]


def test_it_opens_without_a_complaint(page: Path, browser: Browser, scheme: str) -> None:
    for width in (1280, 400):
        browser.open(page, width)
        browser.script("document.querySelectorAll('details').forEach((each) => { each.open = true; });")
        assert browser.overflowing() == []
        assert browser.complaints() == []
        assert browser.requests() == [page.as_uri()]
        assert browser.script("return [...document.images].filter((each) => !each.naturalWidth).length") == 0
    assert browser.scheme() == scheme


def test_a_click_sorts(page: Path, browser: Browser) -> None:
    browser.open(page, 1280)
    browser.script(CLICK % "closing")
    values = [*map(float, browser.script(COLUMN % "closing"))]
    assert len(values) >= 3
    assert len(set(values)) > 1
    assert values == sorted(values)
    browser.script(CLICK % "closing")
    assert [*map(float, browser.script(COLUMN % "closing"))] == values[::-1]
    browser.script(CLICK % "scenario")
    names = browser.script(COLUMN % "scenario")
    assert names == sorted(names)
    assert browser.complaints() == []


def test_a_link_leads_to_a_replay(page: Path, browser: Browser) -> None:
    browser.open(page, 1280)
    browser.script("document.querySelector('.sortable a').click()")
    assert "Accident replay" in browser.driver.title
