"""Reports of evaluations, opened as a reader opens them: from a file, on a screen and on a telephone."""

from pathlib import Path

import pytest
from chromium import Browser
from evaluation_runs import PARTIAL, evaluation_run

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.motion import samples
from deepaccident_devkit.render.evaluation import save_report

pytestmark = pytest.mark.slow

LONG = "a_name_without_any_blank_that_is_much_longer_than_a_telephone_is_wide_" * 3
SETUPS = (
    EvaluationSetup(task="motion"),
    EvaluationSetup(task="accident", protocol="paper"),
    EvaluationSetup(task="detection", protocol="released_iou"),
    EvaluationSetup(task="warning", protocol="clean"),
)


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    listed = samples(da_motion, "train", "evaluate", "paper", scope="all")
    return [token for token in listed if token.split("/")[-2] in ("ego_vehicle", "infrastructure")][::2]


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: setup.task)
def test_a_report_opens_without_a_complaint(
    setup: EvaluationSetup, da_motion: DeepAccident, tokens: list[str], browser: Browser, tmp_path: Path
) -> None:
    run = evaluation_run(da_motion, setup, tokens, partial=PARTIAL, meta={"method": LONG, "paper": {LONG: [LONG, 1.5]}})
    page = save_report(run, tmp_path)
    for width in (1200, 400):
        browser.open(page, width)
        browser.script("document.querySelectorAll('details').forEach((each) => { each.open = true; });")
        assert browser.script("return document.compatMode") == "CSS1Compat"
        assert browser.script("return [...document.images].filter((each) => !each.naturalWidth).length") == 0
        assert browser.script("return document.images.length") >= 2
        assert browser.overflowing() == []
        assert browser.script("return document.documentElement.scrollWidth") <= width
        assert browser.complaints() == []
        assert browser.requests() == [page.as_uri()]
