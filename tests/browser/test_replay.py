"""Replays, opened as a reader opens them: they play, scrub, show the impact, and ask for
nothing.
"""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chromium import Browser
from PIL import Image
from processes import wait_for
from replay_page import data_of
from selenium.webdriver import ActionChains
from selenium.webdriver.common.actions.action_builder import ActionBuilder
from selenium.webdriver.common.keys import Keys
from wording import holding, lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, box_truth
from deepaccident_devkit.render.boxes import EDGES, NEAR_PLANE_M, camera_name, segments_in_image
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks

pytestmark = pytest.mark.slow

FRAMES = 35
PIXELS = """
const canvas = document.getElementById('ground');
const ratio = canvas.width / canvas.clientWidth;
const pen = canvas.getContext('2d');
return arguments[0].map(([x, y]) => [...pen.getImageData(Math.round(x * ratio), Math.round(y * ratio), 1, 1).data]);
"""  # noqa: E501


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
    choose(browser, "#scene", "map")
    click(browser, "whole", "layer-trails", "layer-dots", "layer-agents")
    return browser


def click(browser: Browser, *names: str) -> None:
    for name in names:
        browser.script(f"document.getElementById('{name}').click()")


def text(browser: Browser, name: str) -> str:
    return str(browser.value(f"document.getElementById('{name}').textContent"))


def view(browser: Browser) -> list[float]:
    """The middle of the scene, metres, and how many pixels a metre has."""
    return [
        float(each)
        for each in browser.value("document.getElementById('ground').dataset.view").split()
    ]


def scrub(browser: Browser, to: int) -> None:
    choose(browser, "#scrubber", str(to), event="input")


def choose(browser: Browser, selector: str, value: str, event: str = "change") -> None:
    control = f"document.querySelector('{selector}')"
    browser.script(f"{control}.value = '{value}'; {control}.dispatchEvent(new Event('{event}'))")


def drawn(browser: Browser) -> str:
    return str(browser.value("document.getElementById('ground').toDataURL()"))


def pixels_at(browser: Browser, world: Any, origin: Any) -> list[list[int]]:
    """The colours of the canvas at places (N, 2) in world, metres, by the view that it says it
    has.
    """
    *middle, scale = view(browser)
    size = [
        browser.value(f"document.getElementById('ground').client{side}")
        for side in ("Width", "Height")
    ]
    places = np.array(size) / 2 + (np.asarray(world) - origin - middle) * [scale, -scale]
    colors: list[list[int]] = browser.driver.execute_script(PIXELS, places.tolist())
    return colors


def mixed(color: str, share: float) -> list[float]:
    """A colour over white."""
    channels = [int(color[at : at + 2], 16) for at in (1, 3, 5)]
    return [share * each + (1 - share) * 255 for each in channels]


def test_it_plays_to_the_impact(opened: Browser) -> None:
    assert (opened.frame(), text(opened, "play"), text(opened, "countdown")) == (
        0,
        "Play",
        "3.4 s to impact",
    )
    choose(opened, "#speed", "0.25")
    click(opened, "play")
    wait_for(lambda: opened.frame() >= 2)
    assert text(opened, "play") == "Pause"
    choose(opened, "#speed", "2")
    wait_for(lambda: (opened.frame(), text(opened, "play")) == (FRAMES - 1, "Play"))
    assert (text(opened, "countdown"), text(opened, "announcement")) == ("0.0 s – impact", "Impact")
    click(opened, "play")  # once more from the beginning
    wait_for(lambda: opened.frame() > 0)
    assert opened.complaints() == []


@pytest.mark.parametrize("at", [0, 20])
def test_boxes_are_drawn_where_the_labels_say(
    at: int, opened: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    """Points of each box near its corners are of its colour, a metre beyond its sides nothing
    is.
    """
    scrub(opened, at)
    behind = ("ego_vehicle_behind", "other_vehicle_behind")
    colors_of = {
        da_motion.get("agent", f"{scenario}/{each}")["actor_id"]: AGENT_COLORS[each]
        for each in behind
    }
    colors_of |= dict.fromkeys(
        da_motion.get("scenario", scenario)["collision"]["ids"], COLLIDER_COLOR
    )
    boxes, origin = (
        scenario_tracks(da_motion, scenario).at(at + 1),
        recording_of(da_motion, scenario, None).origin,
    )
    for actor, color in colors_of.items():
        row = int(boxes.actor_id.searchsorted(actor))
        sine, cosine = np.sin(boxes.yaw[row]), np.cos(boxes.yaw[row])
        half, turned = boxes.size[row, :2] / 2, np.array([[cosine, sine], [-sine, cosine]])
        inside = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * (half - 0.5)
        outside = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)]) * (half + 1.0)
        places = boxes.center[row, :2] + np.concatenate([inside, outside]) @ turned
        colors = np.array(pixels_at(opened, places, origin))[:, :3]
        off = np.abs(colors - mixed(color, 0.75)).max(axis=1)
        assert (off[:4].max() < 12, off[4:].min() > 60) == (True, True), (actor, colors)


def test_the_impact_is_marked_where_the_pair_meets(
    opened: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    contact, origin = da_motion.collision(scenario), recording_of(da_motion, scenario, None).origin
    between_rays = (np.arange(8) + 0.5) * np.pi / 4
    ring = np.column_stack([np.cos(between_rays), np.sin(between_rays)])
    around = np.concatenate(
        [contact.point[:2] + radius * ring for radius in (0.75, 1.25, 1.75, 2.5)]
    )

    def marked() -> tuple[int, bool]:
        colors = np.array(pixels_at(opened, around, origin))[:, :3]
        red = (np.abs(colors - mixed(COLLIDER_COLOR, 0.75)).max(axis=1) < 12).sum()
        return int(red), opened.value("document.body.classList.contains('impact')")

    assert marked() == (0, False)
    scrub(opened, FRAMES - 1)
    red, impact = marked()
    assert (red > 3, impact) == (True, True)


def test_keys_step_play_and_jump(opened: Browser) -> None:
    for keys, frame in (
        ([Keys.ARROW_RIGHT, Keys.ARROW_RIGHT], 2),
        ([Keys.ARROW_LEFT], 1),
        ([Keys.END], FRAMES - 1),
        ([Keys.HOME], 0),
    ):
        opened.press(*keys)
        assert opened.frame() == frame
    opened.press(" ")
    wait_for(lambda: opened.frame() > 0)
    before = view(opened)
    opened.press("+")
    assert view(opened)[2] == pytest.approx(1.25 * before[2])


def test_a_control_with_the_focus_keeps_its_keys(opened: Browser) -> None:
    for name in ("layer-ids", "on"):
        opened.script(f"document.getElementById('{name}').focus()")
        opened.press(" ")
    assert opened.value("document.getElementById('layer-ids').checked") is True
    assert (opened.frame(), text(opened, "play")) == (1, "Play")


def test_the_ground_is_dragged_zoomed_and_followed(
    opened: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    x, y, scale = view(opened)
    canvas = opened.driver.find_element("id", "ground")
    ActionChains(opened.driver).drag_and_drop_by_offset(canvas, 60, 30).perform()
    assert view(opened) == pytest.approx([x - 60 / scale, y + 30 / scale, scale])
    click(opened, "whole")
    assert view(opened) == pytest.approx([x, y, scale])
    choose(opened, "#follow", "2")
    scrub(opened, 12)
    there = da_motion.world_from(f"{scenario}/other_vehicle/013", "ego").translation[:2]
    assert view(opened)[:2] == pytest.approx(
        there - recording_of(da_motion, scenario, None).origin, abs=0.0051
    )


def test_who_sees_whom_is_listed_and_drawn(
    opened: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    scrub(opened, 20)
    listed = opened.value(
        "[...document.querySelectorAll('#seen tbody tr')].map((row) => row.innerText)"
    )
    rows = [row.split("\t") for row in listed]
    for column, agent in enumerate(("ego_vehicle", "ego_vehicle_behind", "other_vehicle"), 1):
        visible = da_motion.visible_instances(f"{scenario}/{agent}/021", agents=[agent])
        listed = {row[0].strip().split()[1] for row in rows if row[column].strip() == "●"}
        assert listed == {token.rsplit("/", 1)[1] for token in visible}
    without = drawn(opened)
    choose(opened, "#sight", "all")
    assert drawn(opened) != without


@pytest.fixture(scope="module")
def recorded(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with pictures."""
    return render_replay(da, None, tmp_path_factory.mktemp("recorded") / "replay.html")


def test_every_camera_is_chosen(browser: Browser, recorded: Path) -> None:
    data = data_of(recorded)
    browser.open(recorded, 1280)
    browser.wait(
        "document.images.length === 5 && [...document.images].every((each) => "
        "each.naturalWidth === 64)"
    )
    scrub(browser, 4)
    for agent, cameras in zip(data["agents"], data["cameras"], strict=True):
        image = f"document.querySelector('figure[data-agent={agent['name']}] img')"
        for camera in cameras:
            choose(browser, f'select[aria-label="Camera of {agent["title"]}"]', camera["title"])
            assert browser.value(f"{image}.src").endswith(camera["pictures"][4])
    assert (browser.complaints(), len(browser.requests())) == ([], 1)


STILL = (
    "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done()))"
)


def photo(browser: Browser) -> Image.Image:
    """The scene in three dimensions as the reader sees it."""
    browser.driver.execute_async_script(STILL)
    return Image.open(
        io.BytesIO(browser.driver.find_element("id", "space").screenshot_as_png)
    ).convert("RGB")


def test_the_scene_is_turned(browser: Browser, recorded: Path) -> None:
    """With the mouse and keys: other pixels, and always the pair; it follows whom the reader
    says.
    """
    browser.open(recorded, 1280)
    photos, canvas = [photo(browser)], browser.driver.find_element("id", "space")
    for act in (
        lambda: ActionChains(browser.driver).drag_and_drop_by_offset(canvas, 90, 30).perform(),
        lambda: browser.press(Keys.SHIFT + Keys.ARROW_LEFT),
        lambda: browser.press("+"),
        lambda: choose(browser, "#points-by", "height"),
        lambda: browser.press("t"),
    ):
        act()
        photos.append(photo(browser))
        off = np.abs(np.asarray(photos[-1], dtype=int) - mixed(COLLIDER_COLOR, 1.0)).max(axis=2)
        assert (photos[-1].tobytes() != photos[-2].tobytes(), (off < 12).sum() > 60) == (True, True)
    choose(browser, "#follow", "0")
    scrub(browser, 3)
    browser.driver.execute_async_script(STILL)
    x, y, *_ = map(float, browser.value("document.getElementById('space').dataset.view").split())
    assert [x * 100, y * 100] == pytest.approx(data_of(recorded)["agents"][0]["poses"][3][:2])
    assert browser.faults() == {}


PLACE = """
const [id, row, view] = arguments;
const marked = { camera: '.agent.large', seen: `#seen tbody tr:nth-child(${row + 1})` }[view];
const element = document.querySelector(marked || `#${view}`);
element.scrollIntoView({ block: 'center' });
const corner = element.getBoundingClientRect();
if (element.matches('canvas')) return [corner.left + element.clientLeft, corner.top + element.clientTop];
const shown = view === 'seen' ? element : document.querySelector(`.large g[data-actor="${id}"] path`);
const place = shown.getBoundingClientRect();
return [place.left + place.width / 2, place.top + place.height / 2];
"""  # noqa: E501


def pixel_of(browser: Browser, canvas: str, place: Any) -> Any:
    """The pixel (2,) of a canvas, from its corner, where a place (3,) in metres is by the view that
    the canvas says.
    """
    element = f"document.getElementById('{canvas}')"
    numbers = np.array(browser.value(f"{element}.dataset.view").split(), dtype=float)
    size = np.array(browser.value(f"[{element}.clientWidth, {element}.clientHeight]"))
    if canvas == "ground":
        return size / 2 + (np.array(place[:2]) - numbers[:2]) * numbers[2] * [1, -1]
    turn, rise, distance = numbers[3:]
    ahead = -np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    away = place - (numbers[:3] - distance * ahead)
    across = np.array([right @ away, -np.cross(right, ahead) @ away])
    return size / 2 + across / (ahead @ away) * size[1] / 2 / np.tan(
        0.45
    )  # half of the field of view


LIT = """
return [[...document.querySelectorAll('.large g.lit')].map((each) => Number(each.dataset.actor)),
  [...document.querySelectorAll('#seen tr.lit th')].map((each) => each.textContent),
  [...document.querySelectorAll('#space-names .lit')].map((each) => each.textContent),
  document.getElementById('lit').textContent];
"""


@pytest.mark.parametrize("view", ["space", "ground", "camera", "seen"])
def test_an_actor_that_is_chosen_lights_up_in_all_views(
    view: str, browser: Browser, recorded: Path
) -> None:
    data = data_of(recorded)
    browser.open(recorded, 1280)
    scrub(browser, 2)
    own = data["agents"][data["automatic"]["agents"][2]]["actor"]
    actor = next(each for each in data["actors"] if each["role"] == "pair" and each["id"] != own)
    names = ", ".join(
        agent["title"] for bit, agent in enumerate(data["agents"]) if actor["seen"][2] >> bit & 1
    )
    words = f"{actor['title']}: {actor['states'][2][3] / 10:.1f} m/s, seen by {names}."
    dark = {photo(browser).tobytes(), drawn(browser)}
    for is_chosen in (False, True):  # else pointed at
        mouse = ActionBuilder(browser.driver)
        at = np.array(
            browser.driver.execute_script(PLACE, actor["id"], data["actors"].index(actor), view)
        )
        if view in ("space", "ground"):
            at += pixel_of(
                browser, view, np.array(actor["states"][2])[[0, 1, 4]].astype(float) / 100
            )
        mouse.pointer_action.move_to_location(*at.round().astype(int).tolist())
        if is_chosen:
            mouse.pointer_action.click().move_to_location(2, 2)
        mouse.perform()
        browser.driver.execute_async_script(STILL)
        assert browser.script(LIT) == [[actor["id"]], [actor["title"]], [actor["title"]], words]
    assert not dark & {photo(browser).tobytes(), drawn(browser)}


TEXTS = "[...document.querySelectorAll('.strip {}')].map((each) => each.textContent)"


def test_the_strip_tells_of_the_pair_and_leads_there(browser: Browser, judged: Path) -> None:
    data = data_of(judged)
    browser.open(judged, 1280)
    for plot in browser.driver.find_elements("css selector", ".strip .plot"):
        scrub(browser, 3)
        across = round((20 / (FRAMES - 1) - 0.5) * plot.size["width"])
        ActionChains(browser.driver).move_to_element_with_offset(plot, across, 0).click().perform()
        assert browser.frame() == 20
    gap, ttc = (data["pair"][name][20] for name in ("gap", "ttc"))
    assert not lacking(
        browser.value(TEXTS.format(".told")), f"{gap / 100:.1f} m", f"{ttc / 10:.1f} s", "E TP"
    )


WITHOUT = """
const real = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind) { return kind === '2d' ? real.call(this, kind) : null; };
"""  # noqa: E501


def test_without_webgl_there_is_the_map(browser: Browser, recorded: Path) -> None:
    added = browser.driver.execute_cdp_cmd(
        "Page.addScriptToEvaluateOnNewDocument", {"source": WITHOUT}
    )
    browser.open(recorded, 1280)
    browser.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", added)
    click(browser, "closer", "whole", "layer-points")
    shown = browser.value(
        "['space-box', 'scene-tools', 'ground'].map((name) => "
        "document.getElementById(name).offsetHeight > 0)"
    )
    assert (shown, browser.faults()) == ([False, False, True], {})


CHANNELS = {camera_name(channel): channel for channel in CAMERAS}
LARGE = "return document.querySelector('.agent.large').dataset.agent"


def test_one_picture_is_large_and_by_default_it_follows_the_pair(
    browser: Browser, recorded: Path
) -> None:
    data = data_of(recorded)
    browser.open(recorded, 1280)
    for frame in (0, 5):  # the last is the impact
        scrub(browser, frame)
        automatic = data["agents"][data["automatic"]["agents"][frame]]["name"]
        assert browser.script(LARGE) == automatic
    pick = "document.querySelector('figure[data-agent=other_vehicle] .pictured').click()"
    for act, large in (
        (lambda: browser.script(pick), "other_vehicle"),
        (lambda: browser.press("5"), "infrastructure"),
        (lambda: choose(browser, "#large", "1"), "ego_vehicle_behind"),
        (lambda: browser.press("0"), automatic),
    ):
        act()
        assert browser.script(LARGE) == large


def test_boxes_are_where_the_camera_has_them(
    browser: Browser, da: DeepAccident, recorded: Path
) -> None:
    """At the impact, of all agents, cut off at the near plane: as Python draws them, to a
    hundredth.
    """
    scenario = data_of(recorded)["scenario"]
    browser.open(recorded, 1280)
    scrub(browser, 5)
    cut = 0
    tracks = scenario_tracks(da, scenario).at(6)
    for agent, cameras in zip(AGENTS, data_of(recorded)["automatic"]["cameras"], strict=True):
        drawn_ = browser.script(
            f"return [...document.querySelectorAll('figure[data-agent={agent}] g')]"
            ".map((g) => [Number(g.dataset.actor), "
            "g.querySelectorAll('path')[1].getAttribute('d')])"
        )
        sample, channel = f"{scenario}/{agent}/006", CHANNELS[cameras[5]]
        optical = tracks.transform(da.world_from(sample, channel).inverse(), channel)
        for actor, path in drawn_:
            (corners,) = optical.select(optical.actor_id == actor).corners()
            wanted, there = segments_in_image(corners[np.array(EDGES)], da.camera(sample, channel))
            cut += int((corners[:, 2] < NEAR_PLANE_M).any())
            found = np.array([float(each) for each in re.findall(r"-?[\d.]+", path)]).reshape(
                -1, 2, 2
            )
            assert len(found) == int(there.sum())
            away = (corners[np.array(EDGES), 2] > 1.0).all(axis=1)[
                there
            ]  # nearer, half a centimetre is many pixels
            np.testing.assert_allclose(found[away], wanted[away], rtol=0.01, atol=0.3)
    assert cut > 0
    click(browser, "boxes")
    assert browser.script("return document.querySelectorAll('.boxes g').length") == 0


@pytest.fixture(scope="module")
def judged(
    da_motion: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A page on which the ego foresees the accident at frame 20, and elsewhere at frame 30."""
    given = {}
    for token, away in (
        (f"{scenario}/ego_vehicle/020", 0.0),
        (f"{scenario}/ego_vehicle/030", 20.0),
    ):
        truth = box_truth(da_motion, token).accident
        given[token] = [
            Accident(
                positions=truth.positions + np.array([away, 0.0]), time=truth.time, ids=truth.ids
            )
        ]
    path = tmp_path_factory.mktemp("judged") / "replay.html"
    return render_replay(da_motion, scenario, path, prediction=given)


def test_the_verdict_stands_beside(browser: Browser, judged: Path) -> None:
    browser.open(judged, 1280)
    of_20 = "TPego at frame 20: an accident comes in 1.5 s"
    for at, told in (
        (0, "Nothing was evaluated yet."),
        (28, of_20),
        (19, of_20),
    ):  # the last one that was evaluated
        scrub(browser, at)
        assert text(browser, "foreseen").startswith(told)
    browser.script("document.querySelectorAll('#samples button')[1].click()")
    assert (browser.frame(), browser.complaints()) == (29, [])
    assert not lacking(text(browser, "foreseen"), "FP + FNego at frame 30", "places off by 40.0 m")


CHOSEN_CUT = """
const pen = document.createElement('canvas').getContext('2d');
return [...document.querySelectorAll('.agent select')].filter((each) => each.offsetParent).filter((each) => {
  pen.font = getComputedStyle(each).font;
  return pen.measureText(each.selectedOptions[0].text).width + 18 > each.clientWidth;  // 18 for the arrow
}).map((each) => [each.selectedOptions[0].text, each.clientWidth]);
"""  # noqa: E501
CUT = """
return [...document.querySelectorAll('.name, .badge, .where, th, td, button, p, dt, dd, legend, #legend span')]
  .filter((each) => each.offsetParent && each.scrollWidth > each.clientWidth + 1 && each.clientWidth)
  .map((each) => each.outerHTML.slice(0, 200));
"""  # noqa: E501
SMALL = """
return [...document.querySelectorAll('body *')]
  .filter((each) => each.childNodes.length && each.innerText)
  .filter((each) => [getComputedStyle(each).fontSize].map(parseFloat).some((size) => 0 < size && size < 11))
  .map((each) => each.outerHTML);
"""  # noqa: E501


NAMELESS = """
return [...document.querySelectorAll('button, select, input')]
  .filter((each) => !(each.ariaLabel || each.textContent.trim() || (each.labels && each.labels.length)))
  .map((each) => each.outerHTML);
"""  # noqa: E501


@pytest.mark.parametrize("width", [1280, 390])
def test_it_fits_its_window_and_asks_for_nothing(
    width: int, scheme: str, browser: Browser, recorded: Path, judged: Path
) -> None:
    for page_, at in ((recorded, 0), (recorded, 5), (judged, 0), (judged, 34)):
        browser.open(page_, width)
        scrub(browser, at)
        browser.script(
            "if (document.getElementById('strip').hidden) document.getElementById('more').click()"
        )
        assert (browser.faults(), browser.requests()) == ({}, [page_.resolve().as_uri()])
        assert [browser.script(each) for each in (CUT, CHOSEN_CUT, SMALL, NAMELESS)] == [[]] * 4
    assert (browser.scheme(), sum(photo(browser).getpixel((8, 8))) > 384) == (
        scheme,
        scheme == "light",
    )  # the sky


INTRUDERS = """
document.body.append(Object.assign(document.createElement('img'), {src: 'https://example.org/a.png'}));
document.body.append(Object.assign(document.createElement('script'), {textContent: 'window.ran = 1'}));
"""  # noqa: E501


def test_nobody_can_make_it_load_or_run_anything(browser: Browser, page: Path) -> None:
    browser.open(page, 1280)
    browser.script(INTRUDERS)
    told: list[str] = []
    wait_for(
        lambda: (
            told.extend(browser.complaints())
            or holding("\n".join(told), "img-src", "script-src")[1:]
        )
    )
    assert browser.value("window.ran === undefined") is True
