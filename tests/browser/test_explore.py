"""The explorer, used as a reader uses it: filter, open, play, step, compare and save; it only
requests pages of its own server.
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
from selenium.webdriver.common.keys import Keys
from support.chromium import Browser
from support.evaluation_runs import stored_run
from support.linux_processes import wait_for
from support.replay_page import accident_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import twin_of
from deepaccident_devkit.evaluation.runs import save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.explore import Explorer, export_pages, make_app
from deepaccident_devkit.plugins.explore.serving import Served, serving
from deepaccident_devkit.render.captions import scenario_words

pytestmark = pytest.mark.slow


HOSTILE_NAME = "Town05_type001_subtype0001_scenario00077<img src=x onerror=window.hit=1>\"'&#x41;"
WINDOW_SIZES = ((1280, 720), (390, 800))


class Pages(Browser):
    """A browser with a server's addresses and its cookie."""

    def __init__(self, browser: Browser, served: Served) -> None:
        super().__init__(browser.driver)
        self.served = served
        self.open(served.url, *WINDOW_SIZES[0])

    def go(self, path: str, size: tuple[int, int] = WINDOW_SIZES[0]) -> None:
        """Open a page of the server, in a window of a width and height in pixels."""
        self.open(f"{self.served.origin}/{path}", *size)

    def address(self) -> str:
        """Return the current address without the server's part."""
        return str(self.driver.current_url).removeprefix(self.served.origin)

    def click(self, selector: str) -> None:
        self.script(f"document.querySelector({json.dumps(selector)}).click()")

    def listed_scenarios(self) -> list[str]:
        """Return the tokens of the scenarios in the list."""
        paths = self.value(
            "[...document.querySelectorAll('a.entry')].map((entry) => "
            "decodeURIComponent(entry.pathname))"
        )
        return [path.strip("/").removeprefix("scenario/") for path in paths]

    def tick(self, name: str, value: str) -> None:
        """Tick a filter and wait until the new page is loaded."""
        self.script("window.old = true")
        self.driver.find_element("css selector", f"input[name={name}][value={value}]").click()
        self.wait("!window.old && document.readyState === 'complete'")

    def foreign_requests(self) -> list[str]:
        """Return the requested addresses that are not the server's."""
        return [url for url in self.requests() if not url.startswith(f"{self.served.origin}/")]


@pytest.fixture(scope="module")
def root(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session's release with a hostile name, a broken scenario, and images not downloaded.

    Missing are all images of an agent, and in the scenario with the hostile name all but frames 3
    and 6.
    """
    copy = tmp_path_factory.mktemp("explored") / "a release"
    shutil.copytree(release_root, copy, ignore=shutil.ignore_patterns(".deepaccident"))

    normal = min(copy.glob("type1_*_normal/ego_vehicle/calib/*"))
    type_folder = normal.parents[2]
    name = normal.name
    for folder in type_folder.glob("*/*/*"):
        if folder.name == name:
            target = folder.with_name(HOSTILE_NAME)
            shutil.copytree(folder, target)
            for path in target.iterdir():
                path.rename(path.with_name(path.name.replace(name, HOSTILE_NAME)))
    shutil.copy(type_folder / "meta" / f"{name}.txt", type_folder / "meta" / f"{HOSTILE_NAME}.txt")

    broken = max(copy.glob("type1_*_accident/ego_vehicle/label/*"))
    next(broken.iterdir()).write_bytes(b"no label\n")

    for folder in copy.glob("*/other_vehicle_behind/Camera_*"):
        shutil.rmtree(folder)
    for image in type_folder.glob("*/Camera_*/*img*/*_00[1245].jpg"):
        image.unlink()
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
    """A browser with the cookie; at the end it must have no complaints and no foreign requests."""
    pages = Pages(browser, served)
    yield pages
    assert (pages.complaints(), pages.foreign_requests()) == ([], [])


def scenario_page(token: str, query: str = "") -> str:
    return f"scenario/{quote(token)}/{query}"


def list_tokens(scenarios: Iterable[Any]) -> list[str]:
    return [scenario["token"] for scenario in scenarios]


def find_hostile_scenario(dataset: DeepAccident) -> str:
    (token,) = [
        scenario["token"] for scenario in dataset.scenario if scenario["name"] == HOSTILE_NAME
    ]
    return token


def test_the_token_leaves_the_address(browser: Browser, served: Served) -> None:
    browser.driver.delete_all_cookies()
    browser.open(f"{served.origin}/", 1280)
    assert "printed" in browser.value("document.body.innerText")

    browser.open(served.url, 1280)
    assert browser.driver.current_url == f"{served.origin}/"
    assert "Scenarios" in browser.driver.title
    assert served.token not in json.dumps(browser.driver.get_cookies())


def test_filters_and_the_back_button(pages: Pages, dataset: DeepAccident) -> None:
    all_tokens = list_tokens(dataset.scenario)
    collided = list_tokens(dataset.find(collision=True))
    assert pages.listed_scenarios() == all_tokens

    pages.tick("collision", "true")
    assert (pages.listed_scenarios(), pages.address()) == (collided, "/?collision=true")
    assert pages.value("document.activeElement.value") == "true"  # the keyboard goes on there

    pages.tick("collision", "false")
    assert pages.listed_scenarios() == all_tokens

    pages.driver.back()
    pages.wait("location.search === '?collision=true'")
    wait_for(lambda: pages.listed_scenarios() == collided)
    pages.wait(
        "[...document.images].length && [...document.images].every((image) => "
        "image.naturalWidth === 320)"
    )


def test_errors_of_a_query_are_shown_in_place(pages: Pages, dataset: DeepAccident) -> None:
    pages.driver.find_element("id", "query").send_keys("length>=5; wether=Clear", Keys.ENTER)
    pages.wait("document.getElementById('query').getAttribute('aria-invalid') === 'true'")
    assert "wether" in pages.value("document.getElementById('faults').textContent")

    query_input = pages.driver.find_element("id", "query")
    query_input.clear()
    query_input.send_keys("collision=true", Keys.ENTER)
    pages.wait("location.search === '?q=collision%3Dtrue'")
    assert pages.listed_scenarios() == list_tokens(dataset.find("collision=true"))


def test_the_keyboard_is_enough(pages: Pages, dataset: DeepAccident) -> None:
    """Go from the list to the impact and back, without the mouse."""
    first, second = dataset.scenario[:2]
    last_frame = first["num_frames"] - 1
    pages.press("/")
    assert pages.value("document.activeElement.id") == "query"

    pages.script("document.activeElement.blur()")
    pages.press("j", Keys.ENTER)
    pages.wait("document.getElementById('scrubber')")
    assert pages.address().startswith(f"/{scenario_page(first['token'])}")
    for key, frame in ((Keys.ARROW_RIGHT, 1), (Keys.END, last_frame)):
        pages.press(key)
        assert pages.frame() == frame
    pages.press(Keys.ARROW_LEFT)
    pages.wait(f"location.search === '?frame={last_frame}'")

    pages.press("n")
    pages.wait(f"document.title.startsWith({json.dumps(scenario_words(second))})")
    pages.driver.back()
    pages.wait(f"document.title.startsWith({json.dumps(scenario_words(first))})")
    assert pages.frame() == last_frame - 1


PARTS_LOADED = (
    "[...document.querySelectorAll('[data-part]')].every((part) => !part.querySelector('.waits'))"
)


def test_a_scenario_shows_cameras_ground_and_parts(pages: Pages, dataset: DeepAccident) -> None:
    token = accident_scenario(dataset)
    pages.go(scenario_page(token, "?frame=3&cameras=all"))
    assert pages.frame() == 2
    pages.wait("document.querySelectorAll('#every .pictured').length === 30")
    images = "[...document.querySelectorAll('#every img')].filter((image) => !image.hidden)"
    pages.wait(f"{images}.every((image) => image.complete && image.naturalWidth === 64)")
    grey_panels = "[...document.querySelectorAll('#every .none')].filter((panel) => !panel.hidden)"
    assert pages.value(f"{images}.length") == 24
    assert pages.value(f"{grey_panels}.length") == 6  # an agent's images were not downloaded

    ground = "document.getElementById('ground').toDataURL()"
    ground_before = pages.value(ground)
    pages.click("#layer-points")
    pages.wait(f"{ground} !== {json.dumps(ground_before)}")

    pages.wait(PARTS_LOADED)
    story = pages.value("document.querySelector('[data-part$=story]').innerText")
    assert story == dataset.describe(token).text
    pages.click("[data-part$=pairs] button")
    number = pages.value("document.querySelector('[data-part$=pairs] button').dataset.frame")
    assert pages.frame() == int(number) - 1


def test_a_picture_of_another_moment_is_veiled(pages: Pages, dataset: DeepAccident) -> None:
    pages.go(scenario_page(find_hostile_scenario(dataset), "?cameras=all"))
    # the first frame with pictures
    pages.wait("document.querySelector('#every figure') && location.search.includes('frame=3')")
    figures = (
        "['#cards figure', '#every figure'].map((selector) => document.querySelector(selector))"
    )
    veil_and_words = (
        "(figure) => [figure.classList.contains('veiled'), "
        "figure.querySelector('.where').textContent]"
    )

    for frame, expected in (
        (3, [False, "front"]),
        (5, [True, "front, 0.2 s earlier"]),
        (1, [True, "front, 0.2 s later"]),
        (6, [False, "front"]),
    ):
        pages.go_to(frame - 1)
        assert pages.value(f"{figures}.map({veil_and_words})") == [expected, expected]


def test_an_address_restores_what_the_reader_sees(pages: Pages, dataset: DeepAccident) -> None:
    """A colleague who opens it sees the same moment, large camera, layers, LiDARs, cameras and part
    of the scene.
    """
    pages.go(scenario_page(accident_scenario(dataset)))
    pages.go_to(2)
    for button in ("#layer-trails", "#cloud-infrastructure", "#closer"):
        pages.click(button)
    for select, value in (
        ("#large", "2"),
        ("#cards select", "back"),
        ("#scene", "space"),
        ("#points-by", "height"),
    ):
        control = f"document.querySelector('{select}')"
        pages.script(f"{control}.value = '{value}'; {control}.dispatchEvent(new Event('change'))")
    pages.wait(
        "['changed=', 'pictures=', 'view=', 'points-by='].every((parameter) => "
        "location.search.includes(parameter))"
    )
    controls = """[...['scrubber', 'large', 'follow', 'scene', 'points-by'].map((id) => document.getElementById(id).value),
        [...document.querySelectorAll('#clouds input')].map((input) => input.checked),
        [...document.querySelectorAll('#layers input')].map((input) => input.checked),
        document.querySelector('#cards select').value,
        location.search]"""  # noqa: E501
    view = "document.getElementById('ground').dataset.view.split(' ').map(Number)"
    expected_controls = pages.value(controls)
    expected_view = pages.value(view)
    assert expected_controls[:6] == ["2", "2", "", "space", "height", [True] * 4 + [False]]

    pages.go(pages.address()[1:])

    pages.wait("document.getElementById('scrubber').value === '2'")
    assert pages.value(controls) == expected_controls
    assert pages.value(view) == pytest.approx(expected_view, abs=0.01)


def test_the_replay_of_a_twin_follows_in_step(
    pages: Pages, dataset: DeepAccident, explorer: Explorer
) -> None:
    scenario, twin = next(
        (scenario, twin_of(dataset, scenario))
        for scenario in dataset.find(collision=True)
        if twin_of(dataset, scenario)
    )
    pages.go(scenario_page(scenario["token"], "twin"))
    replays = "[...document.querySelectorAll('iframe')].map((frame) => frame.contentDocument)"
    pages.wait(f"{replays}.every((replay) => replay.querySelector('canvas[data-view]'))")
    shift = int(pages.value("document.getElementById('twins').dataset.shift"))
    last_frame = scenario["num_frames"] - 1

    def follow(leader: int, frame: int) -> int:
        """Let one replay go to a frame and return the frame of the other one."""
        pages.go_to(frame, f"document.querySelectorAll('iframe')[{leader}].contentDocument")
        document = f"document.querySelectorAll('iframe')[{1 - leader}].contentDocument"
        return int(pages.value(f"{document}.getElementById('scrubber').value"))

    def evaluate_in_both(expression: str) -> list[Any]:
        """Evaluate an expression in each replay's `document`."""
        return list(pages.value(f"{replays}.map((document) => {expression})"))

    def read_views() -> Any:
        """Return for each map its centre in world, metres, and its pixels a metre, shape (2, 3)."""
        views = evaluate_in_both(
            "document.getElementById('ground').dataset.view.split(' ').map(Number)"
        )
        tokens = (scenario["token"], twin["token"])
        origins = [explorer.recording(token).origin for token in tokens]
        return np.array(views) + np.pad(origins, ((0, 0), (0, 1)))

    assert follow(0, 3) == min(last_frame, max(0, 3 + shift))
    assert follow(1, 2) == min(last_frame, max(0, 2 - shift))
    for replay in (1, 0):
        views = read_views()
        np.testing.assert_allclose(views[0], views[1])
        pages.script(
            f"document.querySelectorAll('iframe')[{replay}].contentDocument.getElementById('closer').click()"
        )
        wait_for(lambda old_scale=views[:, 2]: (read_views()[:, 2] > old_scale).all())

    _, frame_of_twin = evaluate_in_both("Number(document.getElementById('scrubber').value)")
    pages.click("#step")
    assert follow(0, 0) == frame_of_twin


def test_hostile_names_are_text(pages: Pages, dataset: DeepAccident) -> None:
    token = find_hostile_scenario(dataset)
    assert HOSTILE_NAME in pages.value("document.body.innerText").replace("\u200b", "")

    pages.go(scenario_page(token))
    pages.wait("document.querySelector('#scenario').textContent")
    pages.wait(PARTS_LOADED)
    assert token in pages.value("document.body.innerText")

    pages.go(f"?q={quote('name=' + HOSTILE_NAME)}&view=table")
    assert pages.value("[window.hit === undefined, document.querySelectorAll('img').length]") == [
        True,
        0,
    ]


def test_nothing_reaches_beyond_the_window(
    pages: Pages, dataset: DeepAccident, scheme: str
) -> None:
    token = accident_scenario(dataset)
    addresses = (
        "",
        "?view=table",
        scenario_page(token),
        scenario_page(token, "twin"),
        scenario_page(token, "moment/ego_vehicle/2"),
        "models/",
        "release/",
    )

    for size, address in product(WINDOW_SIZES, addresses):
        pages.go(address, size)
        assert pages.overflowing() == [], address
        assert pages.complaints() == [], address
        assert pages.scheme() == scheme, address


@pytest.fixture(scope="module")
def served_models(
    da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Served]:
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


def test_samples_of_a_model_and_of_two_side_by_side(
    browser: Browser, served_models: Served
) -> None:
    pages = Pages(browser, served_models)
    pages.go("model/first/")
    pages.click('a[href*="by="]')
    pages.wait("document.querySelector('a.entry')")

    pages.go("model/first/samples")
    pages.click("a.entry")
    pages.wait(
        "document.images.length >= 1 && [...document.images].every((image) => "
        "image.naturalWidth > 300)"
    )

    pages.go("compare/first/second/")
    pages.wait("document.querySelector('a.entry')")
    pages.click("a.entry")
    pages.wait("location.pathname.includes('/sample/')")
    assert (pages.complaints(), pages.foreign_requests()) == ([], [])


COLUMN_SCRIPT = """
const table = document.querySelector('.sortable');
const column = [...table.tHead.rows[0].cells].findIndex((cell) => cell.textContent === '%s');
return [...table.tBodies[0].rows].map((row) => row.cells[column].textContent);
"""
SORT_SCRIPT = (
    "[...document.querySelectorAll('.sortable button')].find((button) => "
    "button.textContent === '%s').click();"
)


@pytest.fixture(scope="module")
def index(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The index of exported pages, in a folder with a name that URLs must escape."""
    return export_pages(da, tmp_path_factory.mktemp("export") / "for a talk #1 100%", workers=1)


def wait_for_replay(browser: Browser) -> None:
    """Switch to the replay's frame and wait until its scripts have run."""
    browser.driver.switch_to.frame(browser.driver.find_element("css selector", "iframe"))
    browser.wait("document.getElementById('time').textContent.includes('frame 1')")


def test_exported_pages_open_and_play_without_a_complaint(
    index: Path, da: DeepAccident, browser: Browser, scheme: str
) -> None:
    scenario_index = index.parent / accident_scenario(da) / "index.html"
    for page in (index, scenario_index):
        browser.open(page, 400)
        assert (browser.faults(), browser.scheme()) == ({}, scheme)
        if page == scenario_index:
            wait_for_replay(browser)
            browser.driver.find_element("id", "play").click()
            wait_for(lambda: browser.frame() > 0)
            browser.driver.switch_to.default_content()

        for address in browser.requests():
            path = Path(unquote(urlsplit(address).path))
            assert path.is_relative_to(index.parent)
            assert path.is_file()
        assert browser.complaints() == []


def test_a_click_on_a_heading_sorts_the_table(index: Path, browser: Browser) -> None:
    browser.open(index, 1280)
    names = browser.script(COLUMN_SCRIPT % "scenario")
    for heading, key in (
        ("min. TTC (s)", float),
        ("lead time of all agents (s)", float),
        ("visibility of the accident", lambda _: 0),
    ):
        browser.script(SORT_SCRIPT % heading)
        column = browser.script(COLUMN_SCRIPT % heading)
        known_values = [value for value in column if value != "–"]
        unknown_values = ["–"] * (len(column) - len(known_values))
        assert column == sorted(known_values, key=key) + unknown_values

    for _ in range(2):
        browser.script(SORT_SCRIPT % "scenario")
    assert browser.script(COLUMN_SCRIPT % "scenario") == sorted(names, reverse=True)
    assert browser.complaints() == []
