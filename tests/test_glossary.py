"""docs/glossary.md follows from the table of human names."""

from types import ModuleType

import pytest
from support.repository_scripts import load_script

from deepaccident_devkit.evaluation.runs.setups import TASKS


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_script("docs/make_glossary.py")


def test_the_page_is_up_to_date(script: ModuleType) -> None:
    assert script.PAGE.read_text(encoding="utf-8") == script.page(), (
        "run: python docs/make_glossary.py"
    )


def test_the_page_has_every_headline_and_protocol(script: ModuleType) -> None:
    page = script.page()
    for evaluator in TASKS.values():
        for row in evaluator.result_class.rows:
            assert f"`{script.metric_identifier(row)}`" in page or not row.is_headline
        for protocol in evaluator.protocols:
            assert f"`{protocol}`" in page


def test_the_page_is_short(script: ModuleType) -> None:
    words = [word for word in script.page().split() if any(map(str.isalnum, word))]
    assert len(words) <= 1000
