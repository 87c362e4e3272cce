"""Replays, used as a reader uses them: they play, scrub, show the impact and request nothing."""

import base64
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from selenium.webdriver import ActionChains
from selenium.webdriver.common.actions.action_builder import ActionBuilder
from selenium.webdriver.common.keys import Keys
from support.chromium import Browser
from support.linux_processes import wait_for
from support.replay_page import accident_scenario, read_page_data
from support.text_contents import contained_parts, missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, box_truth
from deepaccident_devkit.render.boxes import EDGES, NEAR_PLANE_M, camera_name, segments_in_image
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks

pytestmark = pytest.mark.slow

NUM_FRAMES = 35
PIXELS_SCRIPT = """
const canvas = document.getElementById('ground');
const ratio = canvas.width / canvas.clientWidth;
const pen = canvas.getContext('2d');
return arguments[0].map(([x, y]) => [...pen.getImageData(Math.round(x * ratio), Math.round(y * ratio), 1, 1).data]);
"""  # noqa: E501


@pytest.fixture(scope="module")
def scenario(da_motion: DeepAccident) -> str:
    return accident_scenario(da_motion)


@pytest.fixture(scope="module")
def page(da_motion: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_replay(da_motion, scenario, tmp_path_factory.mktemp("replay") / "replay.html")


@pytest.fixture
def opened_map(browser: Browser, page: Path) -> Browser:
    """The page with a map of the whole scene, on which only boxes mark the actors."""
    browser.open(page, 1280)
    choose(browser, "#scene", "map")
    click(browser, "whole", "layer-trails", "layer-dots", "layer-agents")
    return browser


def click(browser: Browser, *ids: str) -> None:
    for element_id in ids:
        browser.script(f"document.getElementById('{element_id}').click()")


def read_text(browser: Browser, element_id: str) -> str:
    return str(browser.value(f"document.getElementById('{element_id}').textContent"))


def read_view(browser: Browser) -> list[float]:
    """Return the centre of the scene (x, y), metres, and the pixels a metre."""
    view = browser.value("document.getElementById('ground').dataset.view")
    return [float(number) for number in view.split()]


def scrub(browser: Browser, frame: int) -> None:
    choose(browser, "#scrubber", str(frame), event="input")


def choose(browser: Browser, selector: str, value: str, event: str = "change") -> None:
    control = f"document.querySelector('{selector}')"
    browser.script(f"{control}.value = '{value}'; {control}.dispatchEvent(new Event('{event}'))")


def capture_map(browser: Browser) -> str:
    """Return the map as a data URL."""
    return str(browser.value("document.getElementById('ground').toDataURL()"))


def read_colors(browser: Browser, world: Any, origin: Any) -> list[list[int]]:
    """Return the map's colours at positions (N, 2), metres in world, by the view it reports."""
    *center, scale = read_view(browser)
    canvas = "document.getElementById('ground')"
    size = browser.value(f"[{canvas}.clientWidth, {canvas}.clientHeight]")
    positions = np.array(size) / 2 + (np.asarray(world) - origin - center) * [scale, -scale]
    colors: list[list[int]] = browser.driver.execute_script(PIXELS_SCRIPT, positions.tolist())
    return colors


def mix_with_white(color: str, opacity: float) -> list[float]:
    """Return a colour drawn over white, channels 0 to 255."""
    channels = [int(color[start : start + 2], 16) for start in (1, 3, 5)]
    return [opacity * channel + (1 - opacity) * 255 for channel in channels]


def test_it_plays_to_the_impact(opened_map: Browser) -> None:
    assert opened_map.frame() == 0
    assert read_text(opened_map, "play") == "Play"
    assert read_text(opened_map, "countdown") == "3.4 s to impact"

    choose(opened_map, "#speed", "0.25")
    click(opened_map, "play")
    wait_for(lambda: opened_map.frame() >= 2)
    assert read_text(opened_map, "play") == "Pause"

    choose(opened_map, "#speed", "2")
    wait_for(
        lambda: (opened_map.frame(), read_text(opened_map, "play")) == (NUM_FRAMES - 1, "Play")
    )
    assert read_text(opened_map, "countdown") == "0.0 s – impact"
    assert read_text(opened_map, "announcement") == "Impact"

    click(opened_map, "play")  # once more from the beginning
    wait_for(lambda: opened_map.frame() > 0)
    assert opened_map.complaints() == []


@pytest.mark.parametrize("frame", [0, 20])
def test_boxes_are_drawn_where_the_labels_have_them(
    frame: int, opened_map: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    """Points near the corners of each box have its colour; a metre beyond its sides is nothing."""
    scrub(opened_map, frame)
    colors = {
        da_motion.get("agent", f"{scenario}/{agent}")["actor_id"]: AGENT_COLORS[agent]
        for agent in ("ego_vehicle_behind", "other_vehicle_behind")
    }
    pair = da_motion.get("scenario", scenario)["collision"]["ids"]
    colors |= dict.fromkeys(pair, COLLIDER_COLOR)
    boxes = scenario_tracks(da_motion, scenario).at(frame + 1)
    origin = recording_of(da_motion, scenario, None).origin

    for actor_id, color in colors.items():
        row = int(boxes.actor_id.searchsorted(actor_id))
        sine, cosine = np.sin(boxes.yaw[row]), np.cos(boxes.yaw[row])
        rotation = np.array([[cosine, sine], [-sine, cosine]])
        half_size = boxes.size[row, :2] / 2
        inside = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * (half_size - 0.5)
        outside = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)]) * (half_size + 1.0)
        points = boxes.center[row, :2] + np.concatenate([inside, outside]) @ rotation
        drawn_colors = np.array(read_colors(opened_map, points, origin))[:, :3]
        differences = np.abs(drawn_colors - mix_with_white(color, 0.75)).max(axis=1)
        assert differences[:4].max() < 12, (actor_id, drawn_colors)
        assert differences[4:].min() > 60, (actor_id, drawn_colors)


def test_the_impact_is_marked_where_the_pair_meets(
    opened_map: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    contact = da_motion.collision(scenario)
    origin = recording_of(da_motion, scenario, None).origin
    angles_between_rays = (np.arange(8) + 0.5) * np.pi / 4
    ring = np.column_stack([np.cos(angles_between_rays), np.sin(angles_between_rays)])
    radii_m = (0.75, 1.25, 1.75, 2.5)
    points = np.concatenate([contact.point[:2] + radius * ring for radius in radii_m])

    def count_red_points() -> int:
        colors = np.array(read_colors(opened_map, points, origin))[:, :3]
        differences = np.abs(colors - mix_with_white(COLLIDER_COLOR, 0.75)).max(axis=1)
        return int((differences < 12).sum())

    is_impact = "document.body.classList.contains('impact')"
    assert (count_red_points(), opened_map.value(is_impact)) == (0, False)
    scrub(opened_map, NUM_FRAMES - 1)
    assert count_red_points() > 3
    assert opened_map.value(is_impact) is True


def test_keys_step_play_and_jump(opened_map: Browser) -> None:
    for keys, frame in (
        ([Keys.ARROW_RIGHT, Keys.ARROW_RIGHT], 2),
        ([Keys.ARROW_LEFT], 1),
        ([Keys.END], NUM_FRAMES - 1),
        ([Keys.HOME], 0),
    ):
        opened_map.press(*keys)
        assert opened_map.frame() == frame
    opened_map.press(" ")
    wait_for(lambda: opened_map.frame() > 0)

    scale = read_view(opened_map)[2]
    opened_map.press("+")
    assert read_view(opened_map)[2] == pytest.approx(1.25 * scale)


def test_a_control_with_the_focus_keeps_its_keys(opened_map: Browser) -> None:
    for element_id in ("layer-ids", "on"):
        opened_map.script(f"document.getElementById('{element_id}').focus()")
        opened_map.press(" ")
    assert opened_map.value("document.getElementById('layer-ids').checked") is True
    assert (opened_map.frame(), read_text(opened_map, "play")) == (1, "Play")


def test_the_ground_is_dragged_zoomed_and_followed(
    opened_map: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    x, y, scale = read_view(opened_map)
    canvas = opened_map.driver.find_element("id", "ground")
    ActionChains(opened_map.driver).drag_and_drop_by_offset(canvas, 60, 30).perform()
    assert read_view(opened_map) == pytest.approx([x - 60 / scale, y + 30 / scale, scale])

    click(opened_map, "whole")
    assert read_view(opened_map) == pytest.approx([x, y, scale])

    choose(opened_map, "#follow", "2")
    scrub(opened_map, 12)
    position = da_motion.world_from(f"{scenario}/other_vehicle/013", "ego").translation[:2]
    origin = recording_of(da_motion, scenario, None).origin
    assert read_view(opened_map)[:2] == pytest.approx(position - origin, abs=0.0051)


def test_visible_actors_are_listed_and_drawn(
    opened_map: Browser, da_motion: DeepAccident, scenario: str
) -> None:
    scrub(opened_map, 20)
    lines = opened_map.value(
        "[...document.querySelectorAll('#seen tbody tr')].map((row) => row.innerText)"
    )
    rows = [line.split("\t") for line in lines]
    agents = ("ego_vehicle", "ego_vehicle_behind", "other_vehicle")
    for column, agent in enumerate(agents, start=1):
        visible = da_motion.visible_instances(f"{scenario}/{agent}/021", agents=[agent])
        listed_ids = {row[0].strip().split()[1] for row in rows if row[column].strip() == "●"}
        assert listed_ids == {token.rsplit("/", 1)[1] for token in visible}

    map_without_sight = capture_map(opened_map)
    choose(opened_map, "#sight", "all")
    assert capture_map(opened_map) != map_without_sight


@pytest.fixture(scope="module")
def page_with_pictures(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render_replay(da, None, tmp_path_factory.mktemp("recorded") / "replay.html")


def test_every_camera_is_chosen(browser: Browser, page_with_pictures: Path) -> None:
    data = read_page_data(page_with_pictures)
    browser.open(page_with_pictures, 1280)
    browser.wait(
        "document.images.length === 5 && [...document.images].every((image) => "
        "image.naturalWidth === 64)"
    )
    scrub(browser, 4)

    for agent, cameras in zip(data["agents"], data["cameras"], strict=True):
        image = f"document.querySelector('figure[data-agent={agent['name']}] img')"
        for camera in cameras:
            choose(browser, f'select[aria-label="Camera of {agent["title"]}"]', camera["title"])
            assert browser.value(f"{image}.src").endswith(camera["pictures"][4])
    assert (browser.complaints(), len(browser.requests())) == ([], 1)


RENDERED_SCRIPT = (
    "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done()))"
)


def capture_scene(browser: Browser) -> Image.Image:
    """Return the three-dimensional scene as the reader sees it."""
    browser.driver.execute_async_script(RENDERED_SCRIPT)
    png = browser.driver.find_element("id", "space").screenshot_as_png
    return Image.open(io.BytesIO(png)).convert("RGB")


def test_the_scene_is_turned(browser: Browser, page_with_pictures: Path) -> None:
    """The mouse and keys change the pixels but the pair stays visible; the scene follows the agent
    that the reader chooses.
    """
    browser.open(page_with_pictures, 1280)
    canvas = browser.driver.find_element("id", "space")
    previous = capture_scene(browser)
    for act in (
        lambda: ActionChains(browser.driver).drag_and_drop_by_offset(canvas, 90, 30).perform(),
        lambda: browser.press(Keys.SHIFT + Keys.ARROW_LEFT),
        lambda: browser.press("+"),
        lambda: choose(browser, "#points-by", "height"),
        lambda: browser.press("t"),
    ):
        act()
        scene = capture_scene(browser)
        assert scene.tobytes() != previous.tobytes()
        pair_color = mix_with_white(COLLIDER_COLOR, 1.0)
        differences = np.abs(np.asarray(scene, dtype=int) - pair_color).max(axis=2)
        assert (differences < 12).sum() > 60
        previous = scene

    choose(browser, "#follow", "0")
    scrub(browser, 3)
    browser.driver.execute_async_script(RENDERED_SCRIPT)
    x, y, *_ = map(float, browser.value("document.getElementById('space').dataset.view").split())
    pose = read_page_data(page_with_pictures)["agents"][0]["poses"][3]
    assert [x * 100, y * 100] == pytest.approx(pose[:2])
    assert browser.faults() == {}


POSITION_SCRIPT = """
const [id, row, view] = arguments;
const marked = { camera: '.agent.large', seen: `#seen tbody tr:nth-child(${row + 1})` }[view];
const element = document.querySelector(marked || `#${view}`);
element.scrollIntoView({ block: 'center' });
const corner = element.getBoundingClientRect();
if (element.matches('canvas')) return [corner.left + element.clientLeft, corner.top + element.clientTop];
const target = view === 'seen' ? element : document.querySelector(`.large g[data-actor="${id}"] path`);
const box = target.getBoundingClientRect();
return [box.left + box.width / 2, box.top + box.height / 2];
"""  # noqa: E501


def project_to_canvas(browser: Browser, canvas: str, point: Any) -> Any:
    """Return the pixel (2,) of a canvas, from its corner, that shows a point (3,), metres, by the
    view that the canvas reports.
    """
    element = f"document.getElementById('{canvas}')"
    view = np.array(browser.value(f"{element}.dataset.view").split(), dtype=float)
    size = np.array(browser.value(f"[{element}.clientWidth, {element}.clientHeight]"))
    if canvas == "ground":
        *center, scale = view
        return size / 2 + (point[:2] - center) * scale * [1, -1]

    azimuth, elevation, distance = view[3:]
    horizontal = np.cos(elevation)
    ahead = -np.array(
        [np.cos(azimuth) * horizontal, np.sin(azimuth) * horizontal, np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    down = -np.cross(right, ahead)
    eye = view[:3] - distance * ahead
    offset = point - eye
    tan_half_field_of_view = np.tan(0.45)
    tangents = np.array([right @ offset, down @ offset]) / (ahead @ offset)
    return size / 2 + tangents * size[1] / 2 / tan_half_field_of_view


LIT_SCRIPT = """
return [[...document.querySelectorAll('.large g.lit')].map((group) => Number(group.dataset.actor)),
  [...document.querySelectorAll('#seen tr.lit th')].map((cell) => cell.textContent),
  [...document.querySelectorAll('#space-names .lit')].map((name) => name.textContent),
  document.getElementById('lit').textContent];
"""


@pytest.mark.parametrize("view", ["space", "ground", "camera", "seen"])
def test_an_actor_that_is_chosen_lights_up_in_all_views(
    view: str, browser: Browser, page_with_pictures: Path
) -> None:
    data = read_page_data(page_with_pictures)
    browser.open(page_with_pictures, 1280)
    scrub(browser, 2)
    large_agent = data["agents"][data["automatic"]["agents"][2]]
    row, actor = next(
        (row, actor)
        for row, actor in enumerate(data["actors"])
        if actor["role"] == "pair" and actor["id"] != large_agent["actor"]
    )
    state = actor["states"][2]
    observers = ", ".join(
        agent["title"] for bit, agent in enumerate(data["agents"]) if actor["seen"][2] >> bit & 1
    )
    words = f"{actor['title']}: {state[3] / 10:.1f} m/s, seen by {observers}."
    unlit = {capture_scene(browser).tobytes(), capture_map(browser)}

    for is_chosen in (False, True):  # first it is only pointed at
        mouse = ActionBuilder(browser.driver)
        pixel = np.array(browser.driver.execute_script(POSITION_SCRIPT, actor["id"], row, view))
        if view in ("space", "ground"):
            center = np.array(state)[[0, 1, 4]].astype(float) / 100
            pixel += project_to_canvas(browser, view, center)
        mouse.pointer_action.move_to_location(*pixel.round().astype(int).tolist())
        if is_chosen:
            mouse.pointer_action.click().move_to_location(2, 2)
        mouse.perform()
        browser.driver.execute_async_script(RENDERED_SCRIPT)
        assert browser.script(LIT_SCRIPT) == [
            [actor["id"]],
            [actor["title"]],
            [actor["title"]],
            words,
        ]
    assert not unlit & {capture_scene(browser).tobytes(), capture_map(browser)}


def test_the_strip_describes_the_pair_and_leads_to_its_frames(
    browser: Browser, judged_page: Path
) -> None:
    browser.open(judged_page, 1280)
    for plot in browser.driver.find_elements("css selector", ".strip .plot"):
        scrub(browser, 3)
        offset_px = round((20 / (NUM_FRAMES - 1) - 0.5) * plot.size["width"])
        mouse = ActionChains(browser.driver)
        mouse.move_to_element_with_offset(plot, offset_px, 0).click().perform()
        assert browser.frame() == 20

    pair = read_page_data(judged_page)["pair"]
    texts = browser.value(
        "[...document.querySelectorAll('.strip .told')].map((element) => element.textContent)"
    )
    assert not missing_parts(
        texts, f"{pair['gap'][20] / 100:.1f} m", f"{pair['ttc'][20] / 10:.1f} s", "E alarm"
    )


NO_WEBGL_SCRIPT = """
const real = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind) { return kind === '2d' ? real.call(this, kind) : null; };
"""  # noqa: E501


def test_without_webgl_there_is_the_map(browser: Browser, page_with_pictures: Path) -> None:
    script = browser.driver.execute_cdp_cmd(
        "Page.addScriptToEvaluateOnNewDocument", {"source": NO_WEBGL_SCRIPT}
    )
    browser.open(page_with_pictures, 1280)
    browser.driver.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)
    click(browser, "closer", "whole", "layer-points")
    are_visible = browser.value(
        "['space-box', 'scene-tools', 'ground'].map((name) => "
        "document.getElementById(name).offsetHeight > 0)"
    )

    assert are_visible == [False, False, True]
    assert browser.faults() == {}


CHANNEL_BY_NAME = {camera_name(channel): channel for channel in CAMERAS}
LARGE_AGENT_SCRIPT = "return document.querySelector('.agent.large').dataset.agent"


def test_one_picture_is_large_and_by_default_it_follows_the_pair(
    browser: Browser, page_with_pictures: Path
) -> None:
    data = read_page_data(page_with_pictures)
    browser.open(page_with_pictures, 1280)
    for frame in (0, 5):  # the last is the impact
        scrub(browser, frame)
        automatic = data["agents"][data["automatic"]["agents"][frame]]["name"]
        assert browser.script(LARGE_AGENT_SCRIPT) == automatic

    click_picture = "document.querySelector('figure[data-agent=other_vehicle] .pictured').click()"
    for act, agent in (
        (lambda: browser.script(click_picture), "other_vehicle"),
        (lambda: browser.press("5"), "infrastructure"),
        (lambda: choose(browser, "#large", "1"), "ego_vehicle_behind"),
        (lambda: browser.press("0"), automatic),
    ):
        act()
        assert browser.script(LARGE_AGENT_SCRIPT) == agent


def test_boxes_are_where_the_camera_has_them(
    browser: Browser, da: DeepAccident, page_with_pictures: Path
) -> None:
    """At the impact, the boxes of all agents are cut off at the near plane and within a hundredth
    of where Python draws them.
    """
    data = read_page_data(page_with_pictures)
    browser.open(page_with_pictures, 1280)
    scrub(browser, 5)
    boxes = scenario_tracks(da, data["scenario"]).at(6)
    num_cut = 0
    for agent, cameras in zip(AGENTS, data["automatic"]["cameras"], strict=True):
        sample = f"{data['scenario']}/{agent}/006"
        channel = CHANNEL_BY_NAME[cameras[5]]
        camera = da.camera(sample, channel)
        boxes_in_camera = boxes.transform(da.world_from(sample, channel).inverse(), channel)
        drawn_paths = browser.script(
            f"return [...document.querySelectorAll('figure[data-agent={agent}] g')]"
            ".map((group) => [Number(group.dataset.actor), "
            "group.querySelectorAll('path')[1].getAttribute('d')])"
        )
        for actor_id, path in drawn_paths:
            box = boxes_in_camera.select(boxes_in_camera.actor_id == actor_id)
            (corners,) = box.corners()
            num_cut += int((corners[:, 2] < NEAR_PLANE_M).any())

            edges = corners[np.array(EDGES)]
            expected, is_drawn = segments_in_image(edges, camera)
            numbers = [float(number) for number in re.findall(r"-?[\d.]+", path)]
            segments = np.array(numbers).reshape(-1, 2, 2)
            assert len(segments) == int(is_drawn.sum())
            # nearer, half a centimetre is many pixels
            is_far = (edges[:, :, 2] > 1.0).all(axis=1)[is_drawn]
            np.testing.assert_allclose(segments[is_far], expected[is_far], rtol=0.01, atol=0.3)
    assert num_cut > 0

    click(browser, "boxes")
    assert browser.script("return document.querySelectorAll('.boxes g').length") == 0


@pytest.fixture(scope="module")
def judged_page(
    da_motion: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A page on which the ego foresees the accident at frame 20, and 20 m away at frame 30."""
    predictions = {}
    for frame, offset_m in (("020", 0.0), ("030", 20.0)):
        token = f"{scenario}/ego_vehicle/{frame}"
        truth = box_truth(da_motion, token).accident
        positions = truth.positions + np.array([offset_m, 0.0])
        predictions[token] = [Accident(positions=positions, time=truth.time, ids=truth.ids)]
    path = tmp_path_factory.mktemp("judged") / "replay.html"
    return render_replay(da_motion, scenario, path, prediction=predictions)


COVERED_SCRIPT = """
const bar = document.querySelector('.controls');
const isOutside = (element) => !bar.contains(element) && element.checkVisibility();
const controls = [...document.querySelectorAll('button, select, input, canvas[tabindex]')];
return controls.filter(isOutside).filter((control) => {
  scrollTo(0, 0);
  control.focus();
  return control.getBoundingClientRect().bottom > bar.getBoundingClientRect().top + 1;
}).map((control) => control.id || control.outerHTML);
"""


def test_the_player_bar_covers_no_control_with_the_focus(
    browser: Browser, judged_page: Path
) -> None:
    browser.open(judged_page, 1280)
    is_hidden = "document.getElementById('strip').hidden"
    for _ in range(2):
        assert browser.script(COVERED_SCRIPT) == [], browser.value(is_hidden)
        was_hidden = browser.value(is_hidden)
        click(browser, "more")
        assert browser.value(is_hidden) != was_hidden


def test_the_latest_verdict_is_shown(browser: Browser, judged_page: Path) -> None:
    browser.open(judged_page, 1280)
    verdict_of_20 = "alarmego at frame 20: accident: "
    for frame, words in (
        (0, "No prediction yet (first at frame 20)."),
        (28, verdict_of_20),
        (19, verdict_of_20),
    ):
        scrub(browser, frame)
        assert read_text(browser, "foreseen").startswith(words)

    browser.script("document.querySelectorAll('#samples button')[1].click()")
    assert (browser.frame(), browser.complaints()) == (29, [])
    assert not missing_parts(
        read_text(browser, "foreseen"), "alarmego at frame 30", "position error 40.0 m"
    )

    click(browser, "hold")
    scrub(browser, 20)
    assert "frame 30" in read_text(browser, "foreseen")
    click(browser, "hold")
    assert "frame 20" in read_text(browser, "foreseen")


def test_a_prediction_lies_on_the_ground_in_the_agents_own_picture(
    browser: Browser, da: DeepAccident, tmp_path: Path
) -> None:
    """The rings around the predicted positions are within a pixel of where the camera has these.

    The page fits a plane to the ground, and in a picture the middle of a ring is not its centre.
    """
    token = f"{accident_scenario(da)}/ego_vehicle/003"
    alarm = Accident(positions=np.array([[8.0, 1.0], [12.0, -2.0]]), time=0.3)
    agents = ["ego_vehicle", "other_vehicle"]
    path = da.render_replay(None, tmp_path / "a.html", prediction={token: [alarm]}, agents=agents)
    browser.open(path, 1280)
    scrub(browser, 2)
    choose(browser, "figure[data-agent=ego_vehicle] select", "front")
    camera_from_world = da.world_from(token, "Camera_Front").inverse()
    camera_from_ego = camera_from_world @ da.world_from(token, "ego")
    points = np.column_stack([alarm.positions, np.zeros(2)])
    pixels, _ = da.camera(token, "Camera_Front").project(camera_from_ego.apply(points))

    parts = "[...document.querySelectorAll('figure[data-agent={}] .boxes > path')]"
    rings = browser.value(f"{parts.format(agents[0])}.map((path) => path.getAttribute('d'))")

    centers = []
    for ring in rings:
        corners = np.array(re.findall(r"-?[\d.]+", ring), dtype=float).reshape(-1, 2)
        centers.append((corners.min(axis=0) + corners.max(axis=0)) / 2)
    distances = np.linalg.norm(pixels[:, None] - np.array(centers), axis=-1)
    assert distances.min(axis=1).max() < 1.0
    assert browser.value(f"{parts.format(agents[1])}.length") == 0


CUT_OPTIONS_SCRIPT = """
const pen = document.createElement('canvas').getContext('2d');
return [...document.querySelectorAll('.agent select')].filter((select) => select.offsetParent).filter((select) => {
  pen.font = getComputedStyle(select).font;
  return pen.measureText(select.selectedOptions[0].text).width + 18 > select.clientWidth;  // 18 for the arrow
}).map((select) => [select.selectedOptions[0].text, select.clientWidth]);
"""  # noqa: E501
CUT_TEXTS_SCRIPT = """
return [...document.querySelectorAll('.name, .badge, .where, th, td, button, p, dt, dd, legend, #legend span')]
  .filter((element) => element.offsetParent && element.scrollWidth > element.clientWidth + 1 && element.clientWidth)
  .map((element) => element.outerHTML.slice(0, 200));
"""  # noqa: E501
SMALL_TEXTS_SCRIPT = """
return [...document.querySelectorAll('body *')]
  .filter((element) => element.childNodes.length && element.innerText)
  .filter((element) => [getComputedStyle(element).fontSize].map(parseFloat).some((size) => 0 < size && size < 11))
  .map((element) => element.outerHTML);
"""  # noqa: E501


NAMELESS_CONTROLS_SCRIPT = """
return [...document.querySelectorAll('button, select, input')]
  .filter((control) => !(control.ariaLabel || control.textContent.trim() || (control.labels && control.labels.length)))
  .map((control) => control.outerHTML);
"""  # noqa: E501


@pytest.mark.parametrize("width", [1280, 390])
def test_it_fits_its_window_and_requests_nothing(
    width: int, scheme: str, browser: Browser, page_with_pictures: Path, judged_page: Path
) -> None:
    for path, frame in (
        (page_with_pictures, 0),
        (page_with_pictures, 5),
        (judged_page, 0),
        (judged_page, 34),
    ):
        browser.open(path, width)
        scrub(browser, frame)
        browser.script(
            "if (document.getElementById('strip').hidden) document.getElementById('more').click()"
        )
        assert (browser.faults(), browser.requests()) == ({}, [path.resolve().as_uri()])
        assert browser.script(CUT_TEXTS_SCRIPT) == []
        assert browser.script(CUT_OPTIONS_SCRIPT) == []
        assert browser.script(SMALL_TEXTS_SCRIPT) == []
        assert browser.script(NAMELESS_CONTROLS_SCRIPT) == []
    assert browser.scheme() == scheme

    sky = capture_scene(browser).getpixel((8, 8))
    assert (sum(sky) > 384) == (scheme == "light")


INTRUDERS_SCRIPT = """
document.body.append(Object.assign(document.createElement('img'), {src: 'https://example.org/a.png'}));
document.body.append(Object.assign(document.createElement('script'), {textContent: 'window.ran = 1'}));
"""  # noqa: E501


def test_nobody_can_make_it_load_or_run_anything(browser: Browser, page: Path) -> None:
    browser.open(page, 1280)
    browser.script(INTRUDERS_SCRIPT)
    messages: list[str] = []

    def both_are_blocked() -> bool:
        messages.extend(browser.complaints())
        return len(contained_parts("\n".join(messages), "img-src", "script-src")) == 2

    wait_for(both_are_blocked)
    assert browser.value("window.ran === undefined") is True


@pytest.mark.parametrize("scene", ["both", "map"])
def test_a_saved_picture_has_twice_the_size_of_the_screen(
    scene: str, browser: Browser, judged_page: Path, tmp_path: Path
) -> None:
    browser.open(judged_page, 1280)
    choose(browser, "#scene", scene)
    scrub(browser, 20)
    behavior = {"behavior": "allow", "downloadPath": str(tmp_path)}
    browser.driver.execute_cdp_cmd("Browser.setDownloadBehavior", behavior)
    if scene == "both":
        click(browser, "save")
    else:
        browser.press("s")
    wait_for(lambda: list(tmp_path.glob("*_021.png")))
    (path,) = tmp_path.glob("*.png")

    assert read_text(browser, "announcement") == f"Saved {path.name}"
    assert browser.complaints() == []
    ground = "document.getElementById('ground')"
    width, height = browser.value(f"[{ground}.clientWidth, {ground}.clientHeight]")
    with Image.open(path) as picture:
        saved_pixels = np.asarray(picture.convert("RGB"))
    assert saved_pixels.shape[1] > 4 * width  # the scene and the cameras beside it
    encoded_map = capture_map(browser).partition(",")[2]
    with Image.open(io.BytesIO(base64.b64decode(encoded_map))) as map_image:
        drawn_map = map_image.convert("RGB")
    assert drawn_map.size == (width, height)  # the page itself is as it was
    if scene == "map":
        saved_map = Image.fromarray(saved_pixels[84 : 84 + 2 * height, 24 : 24 + 2 * width])
        shrunk = np.asarray(saved_map.resize(drawn_map.size, Image.Resampling.BOX), dtype=float)
        assert np.abs(shrunk - np.asarray(drawn_map, dtype=float)).mean() < 6


FAILING_SCRIPT = """
const draw = CanvasRenderingContext2D.prototype.drawImage;
CanvasRenderingContext2D.prototype.drawImage = function (...words) {
  if (!this.canvas.isConnected) throw new Error('no picture');
  draw.apply(this, words);
};
"""


def test_the_page_stays_as_it_is_if_a_picture_cannot_be_saved(
    browser: Browser, judged_page: Path
) -> None:
    browser.open(judged_page, 1280)
    browser.script(FAILING_SCRIPT)
    browser.press("s")
    wait_for(lambda: "no picture" in "".join(browser.complaints()))
    ground = "document.getElementById('ground')"
    assert browser.value(f"{ground}.width / {ground}.clientWidth") == 1
