"""The pages of the demo, evaluation reports and safety reports, opened as readers open them."""

from pathlib import Path

import pytest
from support.chromium import Browser
from support.evaluation_runs import PARTIAL, evaluation_run

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.safety import safety_report
from deepaccident_devkit.plugins.safety.page import save_safety_report
from deepaccident_devkit.render.evaluation import save_report
from deepaccident_devkit.selection.samples import samples

pytestmark = pytest.mark.slow


def test_the_page_shows_pictures_replay_and_report(
    made_demo: tuple[Path, str], browser: Browser
) -> None:
    out, _ = made_demo
    browser.open(out / "index.html", 700)
    num_pictures = 4 + (out / "model_1s_before.png").is_file()  # it needs PyTorch
    assert browser.value("document.images.length") == num_pictures
    assert browser.faults() == {}

    titles = []
    for frame in browser.driver.find_elements("tag name", "iframe"):
        # the browser loads a frame when it is near
        browser.driver.execute_script("arguments[0].scrollIntoView()", frame)
        browser.driver.switch_to.frame(frame)
        titles.append(browser.value("document.title").split(":")[0])
        assert browser.value("document.documentElement.scrollWidth <= innerWidth")
        browser.driver.switch_to.default_content()
    assert titles == ["Town10HD, clear noon", "DeepAccident evaluation"]
    assert browser.complaints() == []
    assert [url for url in browser.requests() if not url.startswith(out.as_uri())] == []


OPEN_DETAILS_SCRIPT = (
    "document.querySelectorAll('details').forEach((details) => { details.open = true; });"
)


LONG_NAME = "a_name_without_any_blank_that_is_much_longer_than_a_telephone_is_wide_" * 3
SETUPS = (
    EvaluationSetup(task="motion"),
    EvaluationSetup(task="accident", protocol="paper"),
    EvaluationSetup(task="detection", protocol="released_iou"),
    EvaluationSetup(task="warning", protocol="clean"),
)


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """Every second sample of the ego and the infrastructure."""
    all_tokens = samples(da_motion, "train", "evaluate", "paper", scope="all")
    agents = ("ego_vehicle", "infrastructure")
    return [token for token in all_tokens if token.split("/")[-2] in agents][::2]


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: setup.task)
def test_a_report_opens_without_a_complaint(
    setup: EvaluationSetup,
    da_motion: DeepAccident,
    tokens: list[str],
    browser: Browser,
    tmp_path: Path,
) -> None:
    meta = {"method": LONG_NAME, "paper": {LONG_NAME: [LONG_NAME, 1.5]}}
    run = evaluation_run(da_motion, setup, tokens, partial=PARTIAL, meta=meta)
    page = save_report(run, tmp_path)

    for width in (1200, 400):
        browser.open(page, width)
        browser.script(OPEN_DETAILS_SCRIPT)
        assert (browser.faults(), browser.requests()) == ({}, [page.as_uri()])
        assert browser.value("document.images.length") >= 2


@pytest.fixture(scope="module")
def safety_page(da_b: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    report = safety_report(da_b, workers=1)
    folder = tmp_path_factory.mktemp("safety")
    return save_safety_report(report, folder, dataset=da_b, replays=1, workers=1)[-1]


def test_a_safety_report_opens_without_a_complaint(
    safety_page: Path, browser: Browser, scheme: str
) -> None:
    for width in (1280, 400):
        browser.open(safety_page, width)
        browser.script(OPEN_DETAILS_SCRIPT)
        assert browser.faults() == {}
        assert browser.requests() == [safety_page.as_uri()]
        assert browser.scheme() == scheme


def test_a_link_leads_to_a_replay(safety_page: Path, browser: Browser) -> None:
    browser.open(safety_page, 1280)
    browser.script("document.querySelector('.sortable a').click()")
    assert " hits " in browser.driver.title
