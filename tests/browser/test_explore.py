"""The explorer, used as a reader uses it: filter, open, play, step, compare, save; it asks only its
own server.
"""

import json
import shutil
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

import numpy as np
import pytest
from chromium import Browser
from evaluation_runs import stored_run
from processes import wait_for
from replay_page import accident
from selenium.webdriver.common.keys import Keys

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import twin_of
from deepaccident_devkit.evaluation.runs import save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.explore import Explorer, export_pages, make_app
from deepaccident_devkit.plugins.explore.serving import Served, serving
from deepaccident_devkit.render.captions import scenario_words

pytestmark = pytest.mark.slow


HOSTILE = "Town05_type001_subtype0001_scenario00077<img src=x onerror=window.hit=1>\"'&#x41;"
WIDTHS = ((1280, 720), (390, 800))


class Pages(Browser):
    """A browser that has the cookie of a server, and the server's addresses."""

    def __init__(self, browser: Browser, served: Served) -> None:
        super().__init__(browser.driver)
        self.served = served
        self.open(served.url, *WIDTHS[0])

    def go(self, path: str, size: tuple[int, int] = WIDTHS[0]) -> None:
        self.open(f"{self.served.origin}/{path}", *size)

    def here(self) -> str:
        return str(self.driver.current_url).removeprefix(self.served.origin)

    def click(self, selector: str) -> None:
        self.script(f"document.querySelector({json.dumps(selector)}).click()")

    def shown(self) -> list[str]:
        """The tokens of the scenarios in the list."""
        names = self.value(
            "[...document.querySelectorAll('a.entry')].map((each) => "
            "decodeURIComponent(each.pathname))"
        )
        return [name.strip("/").removeprefix("scenario/") for name in names]

    def tick(self, name: str, value: str) -> None:
        self.script("window.old = true")
        self.driver.find_element("css selector", f"input[name={name}][value={value}]").click()
        self.wait("!window.old && document.readyState === 'complete'")

    def elsewhere(self) -> list[str]:
        """The addresses asked for that are not the server's."""
        return [url for url in self.requests() if not url.startswith(f"{self.served.origin}/")]


@pytest.fixture(scope="module")
def root(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session's release with a hostile name, a broken scenario, and some images that were not
    downloaded.

    They are all of an agent, and of the scenario with the hostile name all but those of the frames
    3 and 6.
    """
    copy = tmp_path_factory.mktemp("explored") / "a release"
    shutil.copytree(release_root, copy, ignore=shutil.ignore_patterns(".deepaccident"))
    normal = min(copy.glob("type1_*_normal/ego_vehicle/calib/*"))
    kind, name = normal.parents[2], normal.name
    for folder in kind.glob("*/*/*"):
        if folder.name == name:
            target = folder.with_name(HOSTILE)
            shutil.copytree(folder, target)
            for path in target.iterdir():
                path.rename(path.with_name(path.name.replace(name, HOSTILE)))
    shutil.copy(kind / "meta" / f"{name}.txt", kind / "meta" / f"{HOSTILE}.txt")
    broken = max(copy.glob("type1_*_accident/ego_vehicle/label/*"))
    next(broken.iterdir()).write_bytes(b"no label\n")
    for folder in copy.glob("*/other_vehicle_behind/Camera_*"):
        shutil.rmtree(folder)
    for path in (
        *kind.glob("*/Camera_*/*img*/*_00[12].jpg"),
        *kind.glob("*/Camera_*/*img*/*_00[45].jpg"),
    ):
        path.unlink()
    return copy


@pytest.fixture(scope="module")
def dataset(root: Path) -> DeepAccident:
    return DeepAccident("v1", root, verbose=False, on_error="skip")


@pytest.fixture(scope="module")
def explorer(dataset: DeepAccident, da_motion: DeepAccident) -> Explorer:
    explorer = Explorer(dataset)
    explorer.begin()
    assert explorer.jobs.wait(60)
    return explorer


@pytest.fixture(scope="module")
def served(explorer: Explorer) -> Iterator[Served]:
    with serving(make_app(explorer)) as running:
        yield running


@pytest.fixture
def pages(browser: Browser, served: Served) -> Iterator[Pages]:
    """A browser that has the cookie; at the end it has not complained, nor asked anybody else."""
    pages = Pages(browser, served)
    yield pages
    assert (pages.complaints(), pages.elsewhere()) == ([], [])


def scenario_page(token: str, query: str = "") -> str:
    return f"scenario/{quote(token)}/{query}"


def tokens(scenarios: Iterable[Any]) -> list[str]:
    return [each["token"] for each in scenarios]


def test_the_token_leaves_the_address(browser: Browser, served: Served) -> None:
    browser.driver.delete_all_cookies()
    browser.open(f"{served.origin}/", 1280)
    assert "printed" in browser.value("document.body.innerText")
    browser.open(served.url, 1280)
    assert (browser.driver.current_url, "Scenarios" in browser.driver.title) == (
        f"{served.origin}/",
        True,
    )
    assert served.token not in json.dumps(browser.driver.get_cookies())


def test_filters_and_the_back_button(pages: Pages, dataset: DeepAccident) -> None:
    every, collided = tokens(dataset.scenario), tokens(dataset.find(collision=True))
    assert pages.shown() == every
    pages.tick("collision", "true")
    assert (pages.shown(), pages.here()) == (collided, "/?collision=true")
    assert pages.value("document.activeElement.value") == "true"  # the keyboard goes on there
    pages.tick("collision", "false")
    assert pages.shown() == every
    pages.driver.back()
    pages.wait("location.search === '?collision=true'")
    wait_for(lambda: pages.shown() == collided)
    pages.wait(
        "[...document.images].length && [...document.images].every((each) => "
        "each.naturalWidth === 320)"
    )


def test_a_query_tells_its_errors_in_place(pages: Pages, dataset: DeepAccident) -> None:
    pages.driver.find_element("id", "query").send_keys("length>=5; wether=Clear", Keys.ENTER)
    pages.wait("document.getElementById('query').getAttribute('aria-invalid') === 'true'")
    assert "wether" in pages.value("document.getElementById('faults').textContent")
    box = pages.driver.find_element("id", "query")
    box.clear()
    box.send_keys("collision=true", Keys.ENTER)
    pages.wait("location.search === '?q=collision%3Dtrue'")
    assert pages.shown() == tokens(dataset.find("collision=true"))


def test_the_keyboard_is_enough(pages: Pages, dataset: DeepAccident) -> None:
    """From the list to the impact and back, without the mouse."""
    first, second = dataset.scenario[:2]
    last = first["num_frames"] - 1
    pages.press("/")
    assert pages.value("document.activeElement.id") == "query"
    pages.script("document.activeElement.blur()")
    pages.press("j", Keys.ENTER)
    pages.wait("document.getElementById('scrubber')")
    assert pages.here().startswith(f"/{scenario_page(first['token'])}")
    for key, frame in ((Keys.ARROW_RIGHT, 1), (Keys.END, last)):
        pages.press(key)
        assert pages.frame() == frame
    pages.press(Keys.ARROW_LEFT)
    pages.wait(f"location.search === '?frame={last}'")
    pages.press("n")
    pages.wait(f"document.title.startsWith({json.dumps(scenario_words(second))})")
    pages.driver.back()
    pages.wait(f"document.title.startsWith({json.dumps(scenario_words(first))})")
    assert pages.frame() == last - 1


PARTS_THERE = (
    "[...document.querySelectorAll('[data-part]')].every((each) => !each.querySelector('.waits'))"
)


def test_a_scenario_shows_all(pages: Pages, dataset: DeepAccident) -> None:
    token = accident(dataset)
    pages.go(scenario_page(token, "?frame=3&cameras=all"))
    assert pages.frame() == 2
    pages.wait("document.querySelectorAll('#every .pictured').length === 30")
    loaded = "[...document.querySelectorAll('#every img')].filter((each) => !each.hidden)"
    pages.wait(f"{loaded}.every((each) => each.complete && each.naturalWidth === 64)")
    grey = "[...document.querySelectorAll('#every .none')].filter((each) => !each.hidden).length"
    assert (pages.value(f"{loaded}.length"), pages.value(grey)) == (
        24,
        6,
    )  # an agent's images were not downloaded
    drawn = "document.getElementById('ground').toDataURL()"
    before = pages.value(drawn)
    pages.click("#layer-points")
    pages.wait(f"{drawn} !== {json.dumps(before)}")
    pages.wait(PARTS_THERE)
    assert (
        pages.value("document.querySelector('[data-part$=story]').innerText")
        == dataset.describe(token).text
    )
    pages.click("[data-part$=pairs] button")
    number = pages.value("document.querySelector('[data-part$=pairs] button').dataset.frame")
    assert pages.frame() == int(number) - 1


def test_a_picture_of_another_moment_is_veiled(pages: Pages, dataset: DeepAccident) -> None:
    (token,) = [each["token"] for each in dataset.scenario if each["name"] == HOSTILE]
    pages.go(scenario_page(token, "?cameras=all"))
    # the first frame with pictures
    pages.wait("document.querySelector('#every figure') && location.search.includes('frame=3')")
    told = {}
    for frame in (3, 5, 1, 6):
        pages.go_to(frame - 1)
        figures = "['#cards figure', '#every figure'].map((each) => document.querySelector(each))"
        where = (
            "(each) => [each.classList.contains('veiled'), "
            "each.querySelector('.where').textContent]"
        )
        told[frame] = pages.value(f"{figures}.map({where})")
    veiled = {
        3: [False, "front"],
        5: [True, "front, 0.2 s earlier"],
        1: [True, "front, 0.2 s later"],
        6: [False, "front"],
    }
    assert told == {frame: [each, each] for frame, each in veiled.items()}


def test_an_address_says_what_is_looked_at(pages: Pages, dataset: DeepAccident) -> None:
    """A colleague who opens it sees the same: moment, large camera, layers, LiDARs, cameras and
    part of the scene.
    """
    pages.go(scenario_page(accident(dataset)))
    pages.go_to(2)
    for button in ("#layer-trails", "#cloud-infrastructure", "#closer"):
        pages.click(button)
    values = (
        ("#large", "2"),
        ("#cards select", "back"),
        ("#scene", "space"),
        ("#points-by", "height"),
    )
    for select, value in values:
        control = f"document.querySelector('{select}')"
        pages.script(f"{control}.value = '{value}'; {control}.dispatchEvent(new Event('change'))")
    pages.wait(
        "['changed=', 'pictures=', 'view=', 'points-by='].every((each) => "
        "location.search.includes(each))"
    )
    looks = """[...['scrubber', 'large', 'follow', 'scene', 'points-by'].map((id) => document.getElementById(id).value),
        [...document.querySelectorAll('#clouds input')].map((each) => each.checked),
        [...document.querySelectorAll('#layers input')].map((each) => each.checked),
        document.querySelector('#cards select').value,
        location.search]"""  # noqa: E501
    view = "document.getElementById('ground').dataset.view.split(' ').map(Number)"
    seen, seen_view = pages.value(looks), pages.value(view)
    assert seen[:6] == ["2", "2", "", "space", "height", [True] * 4 + [False]]
    pages.go(pages.here()[1:])
    pages.wait("document.getElementById('scrubber').value === '2'")
    assert (pages.value(looks), pages.value(view)) == (seen, pytest.approx(seen_view, abs=0.01))


def test_a_twin_goes_in_step(pages: Pages, dataset: DeepAccident, explorer: Explorer) -> None:
    record, twin = next(
        (each, twin_of(dataset, each))
        for each in dataset.find(collision=True)
        if twin_of(dataset, each)
    )
    pages.go(scenario_page(record["token"], "twin"))
    replays = "[...document.querySelectorAll('iframe')].map((each) => each.contentDocument)"
    pages.wait(f"{replays}.every((each) => each.querySelector('canvas[data-view]'))")
    shift, last = (
        int(pages.value("document.getElementById('twins').dataset.shift")),
        record["num_frames"] - 1,
    )

    def led(leader: int, frame: int) -> int:
        """The frame of the other replay after one has gone to a frame."""
        pages.go_to(frame, f"document.querySelectorAll('iframe')[{leader}].contentDocument")
        document = f"document.querySelectorAll('iframe')[{1 - leader}].contentDocument"
        return int(pages.value(f"{document}.getElementById('scrubber').value"))

    def of_both(words: str) -> list[Any]:
        """What an expression gives of each replay's document."""
        every = "[...document.querySelectorAll('iframe')].map((each) => each.contentDocument)"
        return list(pages.value(f"{every}.map((document) => {words})"))

    def views() -> Any:
        """(2, 3) the middle of each map, metres of the world, and the pixels of a metre."""
        told = of_both("document.getElementById('ground').dataset.view.split(' ').map(Number)")
        origins = [explorer.recording(each).origin for each in (record["token"], twin["token"])]
        return np.array(told) + np.pad(origins, ((0, 0), (0, 1)))

    assert led(0, 3) == min(last, max(0, 3 + shift))
    assert led(1, 2) == min(last, max(0, 2 - shift))
    for replay in (1, 0):
        before = views()
        np.testing.assert_allclose(before[0], before[1])
        pages.script(
            f"document.querySelectorAll('iframe')[{replay}].contentDocument.getElementById('closer').click()"
        )
        wait_for(lambda old=before: (views()[:, 2] > old[:, 2]).all())
    _, stays = of_both("Number(document.getElementById('scrubber').value)")
    pages.click("#step")
    assert led(0, 0) == stays


def test_hostile_names_are_text(pages: Pages, dataset: DeepAccident) -> None:
    (token,) = [each["token"] for each in dataset.scenario if each["name"] == HOSTILE]
    assert HOSTILE in pages.value("document.body.innerText").replace("\u200b", "")
    pages.go(scenario_page(token))
    pages.wait("document.querySelector('#scenario').textContent")
    pages.wait(PARTS_THERE)
    assert token in pages.value("document.body.innerText")
    pages.go(f"?q={quote('name=' + HOSTILE)}&view=table")
    assert pages.value("[window.hit === undefined, document.querySelectorAll('img').length]") == [
        True,
        0,
    ]


def test_nothing_reaches_beyond_the_window(
    pages: Pages, dataset: DeepAccident, scheme: str
) -> None:
    own = [scenario_page(accident(dataset), more) for more in ("", "twin", "moment/ego_vehicle/2")]
    for size, address in product(WIDTHS, ("", "?view=table", *own, "models/", "release/")):
        pages.go(address, size)
        assert (pages.overflowing(), pages.complaints(), pages.scheme()) == ([], [], scheme), (
            address
        )


@pytest.fixture(scope="module")
def judged(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Two bundles of the same samples, one of them without its results, and results without a
    bundle.
    """
    folder = tmp_path_factory.mktemp("judged")
    setup = EvaluationSetup(task="accident", protocol="boxes")
    run, _ = stored_run(da_motion, setup, folder / "first.json")
    save_run(run, folder / "first", include_results=True)
    save_run(run, folder / "second")
    stored_run(da_motion, EvaluationSetup(task="motion"), folder / "maps")
    explorer = Explorer(
        da_motion,
        bundles=[folder / "first", folder / "second"],
        results=[folder / "maps" / "results.json"],
    )
    explorer.begin()
    assert explorer.jobs.wait(120)
    with serving(make_app(explorer)) as running:
        yield running


def test_a_models_samples_and_two_side_by_side(browser: Browser, judged: Served) -> None:
    pages = Pages(browser, judged)
    pages.go("model/first/")
    pages.click('a[href*="by="]')
    pages.wait("document.querySelector('a.entry')")
    pages.go("model/first/samples")
    pages.click("a.entry")
    pages.wait(
        "document.images.length >= 1 && [...document.images].every((each) => "
        "each.naturalWidth > 300)"
    )
    pages.go("compare/first/second/")
    pages.wait("document.querySelector('a.entry')")
    pages.click("a.entry")
    pages.wait("location.pathname.includes('/sample/')")
    assert (pages.complaints(), pages.elsewhere()) == ([], [])


COLUMN = """
const table = document.querySelector('.sortable');
const column = [...table.tHead.rows[0].cells].findIndex((each) => each.textContent === '%s');
return [...table.tBodies[0].rows].map((row) => row.cells[column].textContent);
"""
CLICK = (
    "[...document.querySelectorAll('.sortable button')].find((each) => "
    "each.textContent === '%s').click();"
)


@pytest.fixture(scope="module")
def index(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a release with images; the name of its folder has a blank and what addresses escape."""
    return export_pages(da, tmp_path_factory.mktemp("export") / "for a talk #1 100%", workers=1)


def own_page(index: Path, dataset: DeepAccident) -> Path:
    return index.parent / accident(dataset) / "index.html"


def asked_for(browser: Browser) -> set[Path]:
    return {Path(unquote(urlsplit(address).path)) for address in browser.requests()}


def wait_for_replay(browser: Browser) -> None:
    """Go into the frame, when its scripts have run."""
    browser.driver.switch_to.frame(browser.driver.find_element("css selector", "iframe"))
    wait_for(
        lambda: browser.script(
            "return document.getElementById('time').textContent.includes('frame 1')"
        )
    )


def test_it_opens_and_plays_without_a_complaint(
    index: Path, da: DeepAccident, browser: Browser, scheme: str
) -> None:
    for page in (index, own_page(index, da)):
        browser.open(page, 400)
        assert (browser.faults(), browser.scheme()) == ({}, scheme)
        if page != index:
            wait_for_replay(browser)
            browser.driver.find_element("id", "play").click()
            wait_for(lambda: browser.frame() > 0)
            browser.driver.switch_to.default_content()
        asked = asked_for(browser)
        assert {
            path for path in asked if not path.is_relative_to(index.parent) or not path.is_file()
        } == set()
        assert browser.complaints() == []


def test_a_click_sorts(index: Path, browser: Browser) -> None:
    browser.open(index, 1280)
    names = browser.script(COLUMN % "scenario")
    for heading, key in (
        ("least TTC (s)", float),
        ("lead, all (s)", float),
        ("visibility", lambda _: 0),
    ):
        browser.script(CLICK % heading)
        column = browser.script(COLUMN % heading)
        known = [value for value in column if value != "–"]
        assert column == sorted(known, key=key) + ["–"] * (
            len(column) - len(known)
        )  # unknown ones are last
    for _ in range(2):
        browser.script(CLICK % "scenario")
    assert (browser.script(COLUMN % "scenario"), browser.complaints()) == (
        sorted(names, reverse=True),
        [],
    )
