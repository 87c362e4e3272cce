"""The explorer, used as a reader uses it: filter, open, play, step, compare, save; it asks only its own server."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

import pytest
from chromium import Browser
from evaluation_runs import stored_run
from processes import wait_for
from replay_page import accident
from selenium.webdriver.common.keys import Keys

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.runs import save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.explore import Explorer, export_pages, make_app
from deepaccident_devkit.explore.serving import Served, serving
from deepaccident_devkit.safety import twin_of

pytestmark = pytest.mark.slow


HOSTILE = "Town05_type001_subtype0001_scenario00077<img src=x onerror=window.hit=1>\"'&#x41;"
WIDTHS = ((1280, 720), (400, 800))


@pytest.fixture(scope="module")
def root(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session's release with a hostile name, a broken scenario, and an agent whose images were not downloaded."""
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
def pages(browser: Browser, served: Served) -> Iterator[Browser]:
    """A browser that has the cookie; at the end it has not complained, nor asked anybody else."""
    browser.open(served.url, 1280, 720)
    yield browser
    assert browser.complaints() == []
    assert [url for url in browser.requests() if not url.startswith(f"{served.origin}/")] == []


def here(pages: Browser, served: Served) -> str:
    return str(pages.driver.current_url).removeprefix(served.origin)


def shown(pages: Browser) -> list[str]:
    names: list[str] = pages.script(
        "return [...document.querySelectorAll('a.entry')].map((each) => decodeURIComponent(each.pathname))"
    )
    return [name.strip("/").removeprefix("scenario/") for name in names]


def at(path: str, served: Served) -> str:
    return f"{served.origin}/{path}"


def scenario_page(token: str, served: Served, query: str = "") -> str:
    return at(f"scenario/{quote(token)}/{query}", served)


def tick(pages: Browser, name: str, value: str) -> None:
    box = pages.driver.find_element("css selector", f"input[name={name}][value={value}]")
    pages.script("window.old = true")
    box.click()
    pages.wait("!window.old && document.readyState === 'complete'")


def frame(pages: Browser) -> int:
    return int(pages.script("return Number(document.getElementById('scrubber').value)"))


def test_the_token_leaves_the_address(browser: Browser, served: Served) -> None:
    browser.driver.delete_all_cookies()
    browser.open(at("", served), 1280)
    assert "printed" in browser.script("return document.body.innerText")
    browser.open(served.url, 1280)
    assert browser.driver.current_url == at("", served)
    assert "Scenarios" in browser.driver.title
    assert served.token not in json.dumps(browser.driver.get_cookies())


def test_filters_and_the_back_button(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    tokens = [each["token"] for each in dataset.scenario]
    assert shown(pages) == tokens
    tick(pages, "collision", "true")
    assert shown(pages) == [each["token"] for each in dataset.find(collision=True)]
    assert here(pages, served) == "/?collision=true"
    assert pages.script("return document.activeElement.value") == "true"  # the keyboard goes on there
    tick(pages, "collision", "false")
    assert shown(pages) == tokens
    pages.driver.back()
    pages.wait("document.querySelectorAll('a.entry').length === 1 || location.search === '?collision=true'")
    assert shown(pages) == [each["token"] for each in dataset.find(collision=True)]
    pages.driver.back()
    assert shown(pages) == tokens
    images = "[...document.images].length && [...document.images].every((each) => each.naturalWidth === 320)"
    pages.wait(images)


def test_a_query_tells_its_errors_in_place(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    box = pages.driver.find_element("id", "query")
    box.send_keys("length>=5; wether=Clear", Keys.ENTER)
    pages.wait("document.getElementById('query').getAttribute('aria-invalid') === 'true'")
    assert "wether" in pages.script("return document.getElementById('faults').textContent")
    box = pages.driver.find_element("id", "query")
    box.clear()
    box.send_keys("collision=true", Keys.ENTER)
    pages.wait("location.search === '?q=collision%3Dtrue'")
    assert shown(pages) == [each["token"] for each in dataset.find("collision=true")]
    python = pages.script("return document.querySelector('.copy').dataset.text")
    pages.driver.execute_cdp_cmd("Browser.grantPermissions", {"permissions": ["clipboardReadWrite"]})
    pages.script("document.querySelector('.copy').click()")
    said = pages.wait("document.getElementById('copied').textContent")
    assert said in {"copied", python}


def test_the_keyboard_is_enough(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    """From the list to the impact and back, without the mouse."""
    first = dataset.scenario[0]
    pages.press("/")
    assert pages.script("return document.activeElement.id") == "query"
    pages.press(Keys.TAB)
    pages.script("document.activeElement.blur()")
    pages.press("j")
    pages.press(Keys.ENTER)
    pages.wait("document.getElementById('scrubber')")
    assert here(pages, served).startswith(f"/scenario/{quote(first['token'])}/")
    pages.press(Keys.ARROW_RIGHT)
    assert frame(pages) == 1
    pages.press(Keys.END)
    assert frame(pages) == first["num_frames"] - 1
    pages.press(Keys.HOME, " ")
    pages.wait(f"Number(document.getElementById('scrubber').value) === {first['num_frames'] - 1}")
    pages.press(Keys.ARROW_LEFT)
    pages.wait(f"location.search === '?frame={first['num_frames'] - 1}'")
    pages.press("n")
    pages.wait(f"document.title.startsWith({json.dumps(dataset.scenario[1]['token'])})")
    pages.driver.back()
    pages.wait(f"document.title.startsWith({json.dumps(first['token'])})")
    assert frame(pages) == first["num_frames"] - 2
    pages.driver.back()
    pages.wait("document.getElementById('query')")


def test_a_scenario_shows_all(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    token = accident(dataset)
    pages.open(scenario_page(token, served, "?frame=3&cameras=all"), 1280, 720)
    assert frame(pages) == 2
    pages.wait("document.querySelectorAll('#every .pictured').length === 30")
    loaded = "[...document.querySelectorAll('#every img')].filter((each) => !each.hidden)"
    pages.wait(f"{loaded}.every((each) => each.complete && each.naturalWidth === 64)")
    assert pages.script(f"return {loaded}.length") == 24  # an agent's images were not downloaded
    grey = pages.script("return [...document.querySelectorAll('#every .none')].filter((e) => !e.hidden).length")
    assert grey == 6
    assert pages.script("return document.querySelectorAll('#every g').length") > 20
    drawn = "return document.getElementById('ground').toDataURL()"
    before = pages.script(drawn)
    pages.script("document.getElementById('cloud-infrastructure').click()")
    pages.wait(f"(() => {{ {drawn} }})() !== {json.dumps(before)}")
    assert pages.script("return document.getElementById('layer-points').checked") is True
    pages.wait("[...document.querySelectorAll('[data-part]')].every((each) => !each.querySelector('.waits'))")
    parts = {
        each: pages.script(f"return document.querySelector('[data-part$={each}]').innerText")
        for each in ("story", "pairs", "ledger", "twins", "findings")
    }
    assert dataset.describe(token).text == parts["story"]
    assert "least TTC" in parts["pairs"]
    assert "Shapley" in parts["ledger"]
    assert parts["findings"].startswith("None: ")
    pages.script("document.querySelector('[data-part$=pairs] button').click()")
    number = pages.script("return document.querySelector('[data-part$=pairs] button').dataset.frame")
    assert frame(pages) == int(number) - 1


def test_an_address_says_what_is_looked_at(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    """A colleague who opens it sees the same: moment, large camera, layers, LiDARs, cameras and part of the scene."""
    pages.open(scenario_page(accident(dataset), served), 1280, 720)
    pages.script("go(2); document.getElementById('layer-trails').click(); enlarge('2')")
    pages.script("document.getElementById('cloud-infrastructure').click(); zoom(2)")
    pages.script("const s = cards[0].select; s.value = 'Back'; s.dispatchEvent(new Event('change'))")
    pages.wait("['changed=', 'pictures=', 'view='].every((each) => location.search.includes(each))")
    looks = """return [state.frame, state.large, state.follow, state.clouds, state.layers, cards[0].chosen,
        [ground.x, ground.y, ground.scale].map((each) => each.toFixed(1)), location.search]"""
    seen = pages.script(looks)
    assert seen[:4] == [2, "2", "", [0, 4]]
    pages.open(str(pages.driver.current_url), 1280, 720)
    pages.wait("document.getElementById('scrubber').value === '2'")
    assert pages.script(looks) == seen
    nonsense = "?frame=x&large=nobody&follow=me&changed=a,b&pictures=c:d,,&view=1,2,x&cameras=none"
    pages.open(scenario_page(accident(dataset), served, nonsense), 1280, 720)
    pages.wait("location.search === ''")
    assert frame(pages) == 0


def test_a_moments_boxes_and_labels(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    token = accident(dataset)
    pages.open(scenario_page(token, served, "?frame=2&large=infrastructure"), 1280, 720)
    pages.wait("document.getElementById('moment').getAttribute('href') === 'moment/infrastructure/2'")
    pages.script("document.getElementById('moment').click()")
    pages.wait("document.querySelector('tbody')")
    boxes = dataset.get_boxes(f"{token}/infrastructure/002")
    assert pages.script("return document.querySelectorAll('tbody tr').length") == len(boxes)
    pages.wait("[...document.images].every((each) => { each.loading = 'eager'; return each.naturalWidth > 600; })", 60)
    pages.press("n")
    pages.wait("location.pathname.endsWith('/moment/infrastructure/3')")


def test_a_twin_goes_in_step(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    token = next(each["token"] for each in dataset.find(collision=True) if twin_of(dataset, each))
    pages.open(scenario_page(token, served, "twin"), 1280, 720)
    inner = "document.querySelectorAll('iframe')[{}].contentDocument.getElementById('scrubber').value"
    there = "[...document.querySelectorAll('iframe')].every((each) => each.contentWindow.go)"
    pages.wait(there)
    shift = int(pages.script("return document.getElementById('twins').dataset.shift"))
    pages.script("document.querySelectorAll('iframe')[0].contentWindow.go(3)")
    last = dataset.get("scenario", token)["num_frames"] - 1
    assert int(pages.script(f"return {inner.format(1)}")) == min(last, max(0, 3 + shift))
    pages.script("document.querySelectorAll('iframe')[1].contentWindow.go(2)")
    assert int(pages.script(f"return {inner.format(0)}")) == min(last, max(0, 2 - shift))
    pages.script("document.getElementById('step').click()")
    pages.script("document.querySelectorAll('iframe')[0].contentWindow.go(5)")
    assert int(pages.script(f"return {inner.format(1)}")) == 2


def test_hostile_names_are_text(pages: Browser, served: Served, dataset: DeepAccident) -> None:
    (token,) = [each["token"] for each in dataset.scenario if each["name"] == HOSTILE]
    assert HOSTILE in pages.script("return document.body.innerText").replace("\u200b", "")
    pages.open(scenario_page(token, served), 1280, 720)
    pages.wait("document.querySelector('#scenario').textContent")
    pages.wait("[...document.querySelectorAll('[data-part]')].every((each) => !each.querySelector('.waits'))")
    assert token in pages.script("return document.body.innerText")
    pages.open(at(f"?q={quote('name=' + HOSTILE)}&view=table", served), 1280, 720)
    assert pages.script("return window.hit === undefined") is True
    assert pages.script("return document.querySelectorAll('img').length") == 0


def test_nothing_reaches_beyond_the_window(
    browser: Browser, served: Served, dataset: DeepAccident, scheme: str
) -> None:
    token = accident(dataset)
    addresses = [
        served.url,
        at("?view=table", served),
        scenario_page(token, served),
        scenario_page(token, served, "twin"),
    ]
    addresses += [scenario_page(token, served, "moment/ego_vehicle/2"), at("models/", served), at("release/", served)]
    for width, height in WIDTHS:
        for address in addresses:
            browser.open(address, width, height)
            assert browser.overflowing() == [], address
            assert browser.complaints() == [], address
            assert browser.scheme() == scheme, address


@pytest.fixture(scope="module")
def judged(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, Explorer]]:
    """Two bundles of the same samples, one of them without its results, and results without a bundle."""
    folder = tmp_path_factory.mktemp("judged")
    setup = EvaluationSetup(task="accident", protocol="boxes")
    run, _ = stored_run(da_motion, setup, folder / "first.json")
    save_run(run, folder / "first", include_results=True)
    save_run(run, folder / "second")
    stored_run(da_motion, EvaluationSetup(task="motion"), folder / "maps")
    explorer = Explorer(
        da_motion, bundles=[folder / "first", folder / "second"], results=[folder / "maps" / "results.json"]
    )
    explorer.begin()
    assert explorer.jobs.wait(120)
    with serving(make_app(explorer)) as running:
        yield running, explorer


def test_a_models_samples_and_two_side_by_side(browser: Browser, judged: tuple[Served, Explorer]) -> None:
    served, explorer = judged
    browser.open(served.url, 1280, 720)
    browser.open(at("model/first/", served), 1280, 720)
    bar: Any = browser.wait("document.querySelector('a[href*=\"by=\"]')")
    assert bar is not None
    browser.script("document.querySelector('a[href*=\"by=\"]').click()")
    browser.wait("document.querySelector('a.entry')")
    browser.open(at("model/first/samples", served), 1280, 720)
    worst = next(iter(explorer.models["first"].scores.samples))  # type: ignore[union-attr]
    first = browser.script("return document.querySelector('a.entry').pathname")
    assert first == f"/model/first/sample/{quote(worst)}" or worst.rsplit("/", 1)[0] in first
    browser.script("document.querySelector('a.entry').click()")
    browser.wait("document.images.length >= 1 && [...document.images].every((each) => each.naturalWidth > 300)", 60)
    browser.open(at("compare/first/second/", served), 1280, 720)
    browser.wait("document.querySelector('a.entry')")
    browser.script("document.querySelector('a.entry').click()")
    browser.wait("location.pathname.includes('/sample/')")
    assert browser.complaints() == []
    assert [url for url in browser.requests() if not url.startswith(f"{served.origin}/")] == []


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
def exported(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
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


def test_predictions_and_verdicts_are_shown(exported: Path, da_motion: DeepAccident, browser: Browser) -> None:
    browser.open(own_page(exported, da_motion), 1280)
    assert browser.overflowing() == []
    wait_for_replay(browser)
    assert not browser.script("return document.getElementById('verdict').hidden")
    browser.driver.switch_to.default_content()
    assert browser.complaints() == []
