"""Replays, opened as a reader opens them: they play, scrub, show the impact, and ask for nothing."""

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import Browser
from numpy.testing import assert_allclose
from replay_page import data_of
from selenium.webdriver.common.keys import Keys

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, box_truth
from deepaccident_devkit.render.boxes import EDGES, NEAREST_DRAWN, segments_in_image
from deepaccident_devkit.render.replay import render_replay, sensors
from deepaccident_devkit.render.replay.entries import recording_of
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x.tracks import scenario_tracks

pytestmark = pytest.mark.slow

FRAMES = 35
PIXELS = """
const canvas = document.getElementById('ground');
const ratio = canvas.width / canvas.clientWidth;
const pen = canvas.getContext('2d');
return arguments[0].map(([x, y]) => [...pen.getImageData(Math.round(x * ratio), Math.round(y * ratio), 1, 1).data]);
"""


@pytest.fixture(scope="module")
def scenario(da_motion: DeepAccident) -> str:
    return next(each["token"] for each in da_motion.scenario if each["collision"])


@pytest.fixture(scope="module")
def page(da_motion: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_replay(da_motion, scenario, tmp_path_factory.mktemp("replay") / "replay.html")


@pytest.fixture
def opened(browser: Browser, page: Path) -> Browser:
    """The page with the whole scene, in which nobody is marked but by their boxes."""
    browser.open(page, 1280)
    click(browser, "whole")
    for layer in ("trails", "dots", "agents"):
        click(browser, f"layer-{layer}")
    return browser


def click(browser: Browser, name: str) -> None:
    browser.script(f"document.getElementById('{name}').click()")


def text(browser: Browser, name: str) -> str:
    found: str = browser.script(f"return document.getElementById('{name}').textContent")
    return found


def frame(browser: Browser) -> int:
    return int(browser.script("return document.getElementById('scrubber').value"))


def scrub(browser: Browser, to: int) -> None:
    slider = "document.getElementById('scrubber')"
    browser.script(f"{slider}.value = {to}; {slider}.dispatchEvent(new Event('input'))")


def choose(browser: Browser, selector: str, value: str) -> None:
    select = f"document.querySelector('{selector}')"
    browser.script(f"{select}.value = '{value}'; {select}.dispatchEvent(new Event('change'))")


def press(browser: Browser, *keys: str) -> None:
    from selenium.webdriver import ActionChains

    ActionChains(browser.driver).send_keys(*keys).perform()


def drawn(browser: Browser) -> str:
    found: str = browser.script("return document.getElementById('ground').toDataURL()")
    return found


def wait_until(holds: Callable[[], bool], seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def pixels_at(browser: Browser, world: Any, origin: Any) -> list[list[int]]:
    """The colours of the canvas at places (N, 2) in world, metres, by the view that it says it has."""
    view = browser.script("return document.getElementById('ground').dataset.view")
    x, y, scale = map(float, view.split())
    width, height = browser.script(
        "const c = document.getElementById('ground'); return [c.clientWidth, c.clientHeight]"
    )
    across, down = (np.asarray(world) - origin - [x, y]).T * scale
    places = np.column_stack([width / 2 + across, height / 2 - down]).tolist()
    colors: list[list[int]] = browser.driver.execute_script(PIXELS, places)
    return colors


def mixed(color: str, share: float) -> list[float]:
    """A colour over white."""
    channels = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
    return [share * each + (1 - share) * 255 for each in channels]


def test_it_plays_to_the_impact(opened: Browser) -> None:
    assert (frame(opened), text(opened, "play")) == (0, "Play")
    assert text(opened, "countdown") == "3.4 s to impact"
    choose(opened, "#speed", "2")
    click(opened, "play")
    wait_until(lambda: 2 <= frame(opened) < FRAMES - 1)
    assert text(opened, "play") == "Pause"
    wait_until(lambda: frame(opened) == FRAMES - 1)
    wait_until(lambda: text(opened, "play") == "Play")
    assert text(opened, "countdown") == "0.0 s – impact"
    assert text(opened, "announcement") == "Impact"
    click(opened, "play")  # once more from the beginning
    wait_until(lambda: 0 < frame(opened) < 20)
    click(opened, "play")
    stopped = frame(opened)
    time.sleep(0.3)
    assert frame(opened) == stopped
    assert opened.complaints() == []


@pytest.mark.parametrize("at", [0, 20])
def test_boxes_are_drawn_where_the_labels_say(at: int, opened: Browser, da_motion: DeepAccident, scenario: str) -> None:
    """Points of each box near its corners are of its colour, a metre beyond its sides nothing is."""
    origin = recording_of(da_motion, scenario, None).origin
    scrub(opened, at)
    pair = da_motion.get("scenario", scenario)["collision"]["ids"]
    colors_of = {
        da_motion.get("agent", f"{scenario}/{agent}")["actor_id"]: AGENT_COLORS[agent]
        for agent in ("ego_vehicle_behind", "other_vehicle_behind")
    }
    colors_of |= dict.fromkeys(pair, COLLIDER_COLOR)
    boxes = scenario_tracks(da_motion, scenario).at(at + 1)
    for actor, color in colors_of.items():
        row = int(boxes.actor_id.searchsorted(actor))
        center, (length, width, _) = boxes.center[row, :2], boxes.size[row]
        forward = np.array([np.cos(boxes.yaw[row]), np.sin(boxes.yaw[row])])
        left = np.array([-forward[1], forward[0]])
        corners = [(along, across) for along in (-1, 1) for across in (-1, 1)]
        inside = [
            center + along * (length / 2 - 0.5) * forward + across * (width / 2 - 0.5) * left
            for along, across in corners
        ]
        outside = [center + along * (length / 2 + 1.0) * forward for along in (-1, 1)]
        outside += [center + across * (width / 2 + 1.0) * left for across in (-1, 1)]
        colors = np.array(pixels_at(opened, [*inside, *outside], origin))[:, :3]
        off = np.abs(colors - mixed(color, 0.75)).max(axis=1)
        assert off[:4].max() < 12, (actor, colors)
        assert off[4:].min() > 60, (actor, colors)


def test_the_impact_is_marked_where_the_pair_meets(opened: Browser, da_motion: DeepAccident, scenario: str) -> None:
    contact = da_motion.collision(scenario)
    assert contact is not None
    origin = recording_of(da_motion, scenario, None).origin
    between_rays = (np.arange(8) + 0.5) * np.pi / 4
    ring = np.column_stack([np.cos(between_rays), np.sin(between_rays)])
    around = np.concatenate([contact.point[:2] + radius * ring for radius in (0.75, 1.25, 1.75, 2.5)])

    def red() -> int:
        wanted = mixed(COLLIDER_COLOR, 0.75)
        return sum(np.abs(np.array(each[:3]) - wanted).max() < 12 for each in pixels_at(opened, around, origin))

    assert red() == 0
    assert opened.script("return document.body.classList.contains('impact')") is False
    scrub(opened, FRAMES - 1)
    assert red() > 3
    assert opened.script("return document.body.classList.contains('impact')") is True
    assert opened.script("return getComputedStyle(document.getElementById('ground')).animationName") == "flash"


def test_keys_step_play_and_jump(opened: Browser) -> None:
    press(opened, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert frame(opened) == 2
    press(opened, Keys.ARROW_LEFT)
    assert frame(opened) == 1
    press(opened, Keys.END)
    assert frame(opened) == FRAMES - 1
    press(opened, Keys.HOME)
    assert frame(opened) == 0
    press(opened, " ")
    wait_until(lambda: frame(opened) > 0)
    press(opened, " ")
    assert text(opened, "play") == "Play"
    before = opened.script("return document.getElementById('ground').dataset.view").split()
    press(opened, "+")
    after = opened.script("return document.getElementById('ground').dataset.view").split()
    assert float(after[2]) == pytest.approx(1.25 * float(before[2]))


def test_a_control_with_the_focus_keeps_its_keys(opened: Browser) -> None:
    opened.script("document.getElementById('layer-ids').focus()")
    press(opened, " ")
    assert opened.script("return document.getElementById('layer-ids').checked") is True
    opened.script("document.getElementById('on').focus()")
    press(opened, " ")
    assert (frame(opened), text(opened, "play")) == (1, "Play")


def test_the_ground_is_dragged_zoomed_and_followed(opened: Browser, da_motion: DeepAccident, scenario: str) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    def view() -> list[float]:
        return [float(each) for each in opened.script("return document.getElementById('ground').dataset.view").split()]

    x, y, scale = view()
    canvas = opened.driver.find_element(By.ID, "ground")
    ActionChains(opened.driver).drag_and_drop_by_offset(canvas, 60, 30).perform()
    assert view() == pytest.approx([x - 60 / scale, y + 30 / scale, scale])
    click(opened, "whole")
    assert view() == pytest.approx([x, y, scale])
    choose(opened, "#follow", "2")
    scrub(opened, 12)
    there = da_motion.world_from(f"{scenario}/other_vehicle/013", "ego").translation[:2]
    origin = recording_of(da_motion, scenario, None).origin
    assert view()[:2] == pytest.approx(list(there - origin), abs=0.0051)


def test_who_sees_whom_is_listed_and_drawn(opened: Browser, da_motion: DeepAccident, scenario: str) -> None:
    scrub(opened, 20)
    rows = opened.script(
        "return [...document.querySelectorAll('#seen tbody tr')].map((row) => row.innerText.split('\\t'))"
    )
    for column, agent in enumerate(("ego_vehicle", "ego_vehicle_behind", "other_vehicle"), 1):
        visible = da_motion.visible_instances(f"{scenario}/{agent}/021", agents=[agent])
        listed = {row[0].strip().split()[1] for row in rows if row[column].strip() == "●"}
        assert listed == {token.rsplit("/", 1)[1] for token in visible}
    assert [row[1].strip() for row in rows].count("self") == 1
    before = drawn(opened)
    choose(opened, "#sight", "all")
    everyone = drawn(opened)
    choose(opened, "#sight", "4")
    assert len({before, everyone, drawn(opened)}) == 3


@pytest.fixture(scope="module")
def recorded(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with pictures."""
    return render_replay(da, None, tmp_path_factory.mktemp("recorded") / "replay.html")


def test_every_camera_is_chosen(browser: Browser, recorded: Path) -> None:
    data = data_of(recorded)
    browser.open(recorded, 1280)
    source = "return document.querySelector('figure[data-agent={}] img').src"
    wait_until(lambda: browser.script("return [...document.images].every((each) => each.naturalWidth === 64)"))
    assert browser.script("return document.images.length") == 5
    scrub(browser, 4)
    for agent, cameras in zip(data["agents"], data["cameras"], strict=True):
        for camera in cameras:
            choose(browser, f'select[aria-label="Camera of {agent["title"]}"]', camera["title"])
            assert browser.script(source.format(agent["name"])).endswith(camera["pictures"][4])
        alt = browser.script(f"return document.querySelector('figure[data-agent={agent['name']}] img').alt")
        assert alt == f"{agent['title']}, camera BackRight, frame 5"
    click(browser, "layer-points")
    assert browser.complaints() == []
    assert len(browser.requests()) == 1


def test_where_a_frame_has_no_picture_the_one_before_is_shown_with_its_boxes(
    browser: Browser, da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sensors, "_OTHERS", (2,))
    browser.open(render_replay(da, None, tmp_path / "replay.html"), 1280)
    where = "return document.querySelector('figure[data-agent=infrastructure] .where').textContent"
    boxes = "return document.querySelector('figure[data-agent=infrastructure] svg').innerHTML"
    scrub(browser, 4)
    choose(browser, 'select[aria-label="Camera of infrastructure"]', "FrontLeft")
    before = browser.script(boxes)
    assert browser.script(where) == "FrontLeft"
    scrub(browser, 5)
    assert browser.script(where) == "FrontLeft, frame 5"
    assert browser.script(boxes) == before


LARGE = "return document.querySelector('.agent.large').dataset.agent"


def test_one_picture_is_large_and_by_default_it_follows_the_pair(browser: Browser, recorded: Path) -> None:
    data = data_of(recorded)
    pair = [actor["id"] for actor in data["actors"] if actor["role"] == "pair"]
    browser.open(recorded, 1280)
    for frame_ in (0, 5):  # the last is the impact
        scrub(browser, frame_)
        number = data["automatic"]["agents"][frame_]
        agent = data["agents"][number]["name"]
        assert browser.script(LARGE) == agent
        title = data["automatic"]["cameras"][number][frame_]
        (camera,) = [each for each in data["cameras"][number] if each["title"] == title]
        shown = browser.script("return document.querySelector('.agent.large img').src")
        assert shown.endswith(camera["pictures"][frame_])
        boxes = browser.script("return [...document.querySelectorAll('.agent.large g')].map((g) => g.dataset.actor)")
        assert {str(each) for each in pair} & set(boxes)
    browser.script("document.querySelector('figure[data-agent=other_vehicle] .pictured').click()")
    assert browser.script(LARGE) == "other_vehicle"
    press(browser, "5")
    assert browser.script(LARGE) == "infrastructure"
    choose(browser, "#large", "1")
    assert browser.script(LARGE) == "ego_vehicle_behind"
    press(browser, "0")
    assert browser.script(LARGE) == agent
    widths = browser.script("return [...document.querySelectorAll('.pictured')].map((each) => each.clientWidth)")
    small, large = sorted(widths)[-2:]
    assert large > 3.5 * small


def test_boxes_are_where_the_camera_has_them(browser: Browser, da: DeepAccident, recorded: Path) -> None:
    """At the impact, of all agents, cut off at the near plane: as Python draws them, to a hundredth."""
    scenario = data_of(recorded)["scenario"]
    browser.open(recorded, 1280)
    scrub(browser, 5)
    cut = 0
    tracks = scenario_tracks(da, scenario).at(6)
    for agent, cameras in zip(AGENTS, data_of(recorded)["automatic"]["cameras"], strict=True):
        drawn_ = browser.script(
            f"return [...document.querySelectorAll('figure[data-agent={agent}] g')]"
            ".map((g) => [Number(g.dataset.actor), g.querySelectorAll('path')[1].getAttribute('d')])"
        )
        sample, channel = f"{scenario}/{agent}/006", f"Camera_{cameras[5]}"
        optical = tracks.transform(da.world_from(sample, channel).inverse(), channel)
        for actor, path in drawn_:
            (corners,) = optical.select(optical.actor_id == actor).corners()
            wanted, there = segments_in_image(corners[np.array(EDGES)], da.camera(sample, channel))
            cut += int((corners[:, 2] < NEAREST_DRAWN).any())
            found = np.array([float(each) for each in re.findall(r"-?[\d.]+", path)]).reshape(-1, 2, 2)
            assert len(found) == int(there.sum())
            away = (corners[np.array(EDGES), 2] > 1.0).all(axis=1)[there]  # nearer, half a centimetre is many pixels
            assert_allclose(found[away], wanted[away], rtol=0.01, atol=0.3)
        assert len(drawn_) > 0 or agent != "infrastructure"
    assert cut > 0
    click(browser, "boxes")
    assert browser.script("return document.querySelectorAll('.boxes g').length") == 0


@pytest.fixture(scope="module")
def judged(da_motion: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page on which the ego foresees the accident at frame 20, and elsewhere at frame 30."""
    given = {}
    for number, away in ((20, 0.0), (30, 20.0)):
        token = f"{scenario}/ego_vehicle/{number:03d}"
        truth = box_truth(da_motion, token).accident
        assert truth is not None
        given[token] = [Accident(positions=truth.positions + np.array([away, 0.0]), time=truth.time, ids=truth.ids)]
    path = tmp_path_factory.mktemp("judged") / "replay.html"
    return render_replay(da_motion, scenario, path, prediction=given)


def test_the_verdict_stands_beside(browser: Browser, judged: Path) -> None:
    browser.open(judged, 1280)
    assert text(browser, "foreseen") == "Nothing was evaluated yet."
    scrub(browser, 19)
    assert text(browser, "foreseen").startswith("TPego at frame 20: an accident comes in 1.5 s")
    with_it = drawn(browser)
    click(browser, "layer-prediction")
    assert drawn(browser) != with_it
    scrub(browser, 28)
    assert text(browser, "foreseen").startswith("TP")  # the last one that was evaluated
    browser.script("document.querySelectorAll('#samples button')[1].click()")
    assert frame(browser) == 29
    assert text(browser, "foreseen").startswith("FP + FNego at frame 30")
    assert "places off by 40.0 m" in text(browser, "foreseen")
    assert browser.complaints() == []


CHOSEN_CUT = """
const pen = document.createElement('canvas').getContext('2d');
return [...document.querySelectorAll('.agent select')].filter((each) => each.offsetParent).filter((each) => {
  pen.font = getComputedStyle(each).font;
  return pen.measureText(each.selectedOptions[0].text).width + 18 > each.clientWidth;  // 18 for the arrow
}).map((each) => [each.selectedOptions[0].text, each.clientWidth]);
"""
CUT = """
return [...document.querySelectorAll('.name, .badge, .where, th, td, button, p, dt, dd, legend, #legend span')]
  .filter((each) => each.offsetParent && each.scrollWidth > each.clientWidth + 1 && each.clientWidth)
  .map((each) => each.outerHTML.slice(0, 200));
"""


@pytest.mark.parametrize("width", [1400, 1100, 700, 390])
def test_nothing_is_cut(width: int, browser: Browser, recorded: Path, judged: Path) -> None:
    for page_, last in ((recorded, 5), (judged, 34)):
        browser.open(page_, width)
        for at in (0, last):
            scrub(browser, at)
            assert browser.overflowing() == []
            assert browser.script(CUT) == []
            assert browser.script(CHOSEN_CUT) == []
            assert browser.script("return document.documentElement.scrollWidth") <= width
    table = "const box = document.getElementById('samples'); return box.scrollWidth - box.clientWidth"
    assert browser.script(table) <= 0
    lines = "return [...document.querySelectorAll('.name')].map((each) => each.getClientRects().length)"
    assert browser.script(lines) == [1] * 5


@pytest.mark.parametrize("width", [1280, 700, 390])
def test_it_fits_its_window_and_asks_for_nothing(width: int, browser: Browser, judged: Path) -> None:
    browser.open(judged, width)
    scrub(browser, 25)
    assert browser.overflowing() == []
    assert browser.requests() == [judged.resolve().as_uri()]
    assert browser.complaints() == []
    small = browser.script(
        "return [...document.querySelectorAll('body *')].filter((each) => each.childNodes.length && each.innerText && "
        "parseFloat(getComputedStyle(each).fontSize) < 11 && parseFloat(getComputedStyle(each).fontSize) > 0)"
        ".map((each) => each.outerHTML)"
    )
    assert small == []
    nameless = browser.script(
        "return [...document.querySelectorAll('button, select, input')].filter((each) => !(each.ariaLabel || "
        "each.textContent.trim() || (each.labels && each.labels.length))).map((each) => each.outerHTML)"
    )
    assert nameless == []


def test_nobody_can_make_it_load_or_run_anything(browser: Browser, page: Path) -> None:
    browser.open(page, 1280)
    browser.script(
        "document.body.append(Object.assign(document.createElement('img'), {src: 'https://example.org/a.png'}))"
    )
    browser.script(
        "const s = document.createElement('script'); s.textContent = 'window.ran = 1'; document.body.append(s);"
    )
    time.sleep(0.2)
    assert browser.script("return window.ran === undefined") is True
    told = browser.complaints()
    assert any("img-src" in each for each in told)
    assert any("script-src" in each for each in told)
