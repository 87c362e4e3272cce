"""A scenario's page, its files and its parts show what the devkit computes, and nothing else is
served.
"""

import base64
import io
import re
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from PIL import Image
from support.asgi_client import Response, get_response
from support.expected_errors import assert_raises
from support.replay_page import accident_scenario, normal_scenario, read_page_data
from support.text_contents import contained_parts, missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.plugins.explore import Explorer, make_app
from deepaccident_devkit.plugins.explore.pages import release
from deepaccident_devkit.plugins.explore.pages.scenario import PARTS
from deepaccident_devkit.render.replay import recording_of, render_replay
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS


@pytest.fixture(scope="module")
def explorer(da: DeepAccident) -> Iterator[Explorer]:
    explorer = Explorer(da)
    yield explorer
    explorer.jobs.end()


@pytest.fixture(scope="module")
def app(explorer: Explorer) -> Any:
    return make_app(explorer)


@pytest.fixture(scope="module")
def page_address(da: DeepAccident) -> str:
    return f"/scenario/{accident_scenario(da)}/"


def open_image(response: Response) -> Image.Image:
    assert response.status == 200
    assert response.headers["content-type"] in ("image/jpeg", "image/png")
    return Image.open(io.BytesIO(response.body))


def response_status(app: Any, address: str) -> int:
    return get_response(app, address).status


def test_no_page_is_made_in_the_servers_own_thread(
    app: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server's own thread must stay free to answer other requests."""
    match_scenarios = release.match_scenarios
    threads = []

    def record_thread(*arguments: Any) -> Any:
        threads.append(threading.current_thread())
        return match_scenarios(*arguments)

    monkeypatch.setattr(release, "match_scenarios", record_thread)
    query = "&".join(f"town=T{number}" for number in range(4000))
    list_length = len(get_response(app, "/").text)
    for address in (f"/?{query}", f"/?{query}&view=table", f"/selection.txt?{query}"):
        response = get_response(app, address)
        assert response.status == 200
        assert len(response.text) < list_length + 200_000
    assert len(threads) == 4
    assert threading.main_thread() not in threads


def test_the_page_plays_what_the_replay_plays(
    app: Any, page_address: str, da: DeepAccident, tmp_path: Path
) -> None:
    page_data = read_page_data(get_response(app, page_address).text)
    replay_data = read_page_data(render_replay(da, None, tmp_path / "replay.html"))
    for name in set(replay_data) - {"cameras", "points", "notes"}:
        assert page_data[name] == replay_data[name], name
    assert page_data["served"]["points"] == [[True] * 6] * 5
    assert len(page_data["cameras"]) == 5
    for cameras in page_data["cameras"]:
        pictures = [(camera["channel"], camera["pictures"]) for camera in cameras]
        assert pictures == [(channel, [1] * 6) for channel in CAMERAS]


def test_its_address_ends_in_a_slash(app: Any, page_address: str) -> None:
    response = get_response(app, f"{page_address.rstrip('/')}?frame=3")
    name = page_address.strip("/").rsplit("/", 1)[1]
    assert (response.status, response.headers["location"]) == (307, f"./{name}/?frame=3")


def test_images_are_the_releases_in_the_requested_width(
    app: Any, page_address: str, da: DeepAccident
) -> None:
    address = f"{page_address}images/infrastructure/Camera_Back/2"
    for query in ("?width=160", "?width=32", "", "?width=9999"):
        image = open_image(get_response(app, address + query))
        assert image.size == (64, 36)  # the width of these images
    original = da.load_image(f"{accident_scenario(da)}/infrastructure/002/Camera_Back").astype(int)
    differences = np.abs(np.asarray(image, dtype=int) - original)
    assert differences.mean() < 7  # compressed as JPEG twice


def test_points_are_the_agents_own(app: Any, page_address: str, da: DeepAccident) -> None:
    scenario = accident_scenario(da)
    origin = [*recording_of(da, scenario, None).origin, 0.0]
    for agent in ("ego_vehicle", "infrastructure"):
        response = get_response(app, f"{page_address}points/{agent}/3")
        assert response.headers["content-type"].startswith("text/plain")
        centimetres = np.frombuffer(base64.b64decode(response.body), dtype="<i2").reshape(-1, 3)
        points = centimetres / 100 + origin
        cloud = da.load_point_cloud(f"{scenario}/{agent}/003", "world").xyz
        distances = np.linalg.norm(points[:50, None] - cloud, axis=-1)
        assert distances.min(axis=1).max() < 0.0088
        assert len(points) == len(cloud)


@pytest.mark.parametrize(
    "address",
    [
        "images/ego_vehicle/Camera_Front/0",
        "images/ego_vehicle/Camera_Front/7",
        "images/ego_vehicle/Camera_Front/1000",
        "images/ego_vehicle/Camera_Up/1",
        "images/pedestrian/Camera_Front/1",
        "images/ego_vehicle/..%2f..%2flabel/1",
        "images/..%2f..%2fmeta/Camera_Front/1",
        "points/nobody/1",
        "points/ego_vehicle/77",
        "moment/ego_vehicle/99",
        "parts/nothing",
        "parts/..%2fbase",
        "%2e%2e/%2e%2e/etc/passwd",
    ],
)
def test_nothing_else_is_served(app: Any, page_address: str, address: str) -> None:
    response = get_response(app, page_address + address)
    assert (response.status, "root:" in response.text) == (404, False)


@pytest.mark.parametrize(
    "address", ["/scenario/nowhere/none/", "/thumbnail/nowhere/none.jpg", "/nothing", "/scenario/"]
)
def test_missing_pages_are_reported(app: Any, address: str) -> None:
    response = get_response(app, address)
    assert (response.status, "<h1>Not" in response.text) == (404, True)


def test_the_parts_show_what_the_devkit_computes(
    app: Any, page_address: str, da: DeepAccident
) -> None:
    scenario = accident_scenario(da)
    story, pairs, ledger, _ = (
        get_response(app, f"{page_address}parts/{part}").text for part in PARTS if part != "twins"
    )
    assert da.describe(scenario).text in story.replace("&#39;", "'")

    rows = re.findall(r"<tr><th scope=\"row\">(.*?)</th><td>(yes|no)</td><td>([^<]*)</td>", pairs)
    expected_pairs = da.interactions(scenario).pairs
    assert len(rows) == min(30, len(expected_pairs))
    moving = [float(ttc) for _, moves, ttc in rows if moves == "yes" and ttc != "never"]
    assert moving == sorted(moving)
    min_ttc = expected_pairs.min_ttc[expected_pairs.moving].min()
    assert moving[0] == pytest.approx(min_ttc, abs=0.005)
    assert ledger.count("<tr><th") == 2 + 16 + 4


def test_a_part_that_cannot_be_computed_gives_the_reason(app: Any, da: DeepAccident) -> None:
    response = get_response(app, f"/scenario/{normal_scenario(da)}/parts/ledger")
    assert (response.status, "nobody collides" in response.text) == (200, True)


def test_a_moment_has_its_boxes(app: Any, page_address: str, da: DeepAccident) -> None:
    page = get_response(app, f"{page_address}moment/other_vehicle/2").text
    row_pattern = r"<tr><th scope=\"row\">(\d+)</th><td>(\w+)</td><td>(-?\d+)</td>"
    rows = re.findall(row_pattern + r"\s*<td>([−\d.]+)</td>", page)
    boxes = list(da.get_boxes(f"{accident_scenario(da)}/other_vehicle/002", "ego"))
    for number, (row, box) in enumerate(zip(rows, boxes, strict=True)):
        *identity, x = row
        assert identity == [str(number), box.category, str(box.actor_id)]
        assert float(x.replace("−", "-")) == pytest.approx(box.center[0], abs=0.006)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sample", "labels"])
def test_a_moment_is_rendered(app: Any, page_address: str, name: str) -> None:
    address = f"{page_address}moment/ego_vehicle/2/{name}.png"
    response = get_response(app, address)
    assert min(open_image(response).size) > 300
    assert get_response(app, address).body == response.body


def test_a_partial_download_is_shown(da_partial: DeepAccident) -> None:
    app = make_app(Explorer(da_partial))
    address = f"/scenario/{accident_scenario(da_partial)}/"
    data = read_page_data(get_response(app, address).text)
    names = [agent["name"] for agent in data["agents"]]
    assert names == [agent for agent in AGENTS if agent != "other_vehicle_behind"]
    front_camera = data["cameras"][0][0]
    assert front_camera["channel"] == "Camera_Front"
    assert front_camera["pictures"] == [None] * 6
    assert data["served"]["points"][names.index("infrastructure")] is None
    assert any("6 of 144 camera files are missing" in note for note in data["notes"])
    assert response_status(app, f"{address}points/infrastructure/1") == 404


def test_a_moment_without_files_leads_to_the_nearest_with_any(
    da: DeepAccident, tmp_path: Path
) -> None:
    ignore = shutil.ignore_patterns(
        ".deepaccident", "*_005.jpg", "*_005.npz", "*_006.jpg", "*_006.npz"
    )
    root = shutil.copytree(da.dataroot, tmp_path / "r", ignore=ignore)
    app = make_app(Explorer(DeepAccident("v1", root, verbose=False)))
    for frame, expected in ((4, []), (6, [("4", "0.2 s earlier")])):
        address = f"/scenario/{accident_scenario(da)}/moment/ego_vehicle/{frame}"
        page = get_response(app, address).text
        hints = re.findall(r'moment/ego_vehicle/(\d)">([\d.]+ s \w+), frame', page)
        assert hints == expected


def test_labels_without_sensor_files_are_enough(da_b: DeepAccident) -> None:
    app = make_app(Explorer(da_b))
    address = f"/scenario/{accident_scenario(da_b)}/"
    for part in ("", "moment/ego_vehicle/1", *(f"parts/{part}" for part in PARTS)):
        assert response_status(app, address + part) == 200, part


def test_a_broken_scenario_has_only_its_findings(own_release: Path) -> None:
    label_folder = max(own_release.rglob("ego_vehicle/label/*"))
    next(label_folder.iterdir()).write_bytes(b"no label\n")
    explorer = Explorer(DeepAccident("v1", own_release, verbose=False, on_error="skip"))
    (token,) = {problem.scenario for problem in explorer.dataset.problems}
    app = make_app(explorer)

    page = get_response(app, f"/scenario/{token}/")
    assert (page.status, "label-unreadable" in page.text) == (200, True)
    list_page = get_response(app, "/").text
    link = f'href="./scenario/{token}/"'
    assert not missing_parts(list_page, link, "1 broken scenario is left out")


def test_names_are_text_everywhere(own_release: Path) -> None:
    """Words from the release's folders and meta files are never HTML."""
    hostile = "Town04_type001_subtype0001_scenario00066\"><img src=x onerror=alert(1)>'&"
    kind = max([*own_release.rglob("*_normal")] or own_release.rglob("*_accident"))
    name = min((kind / "ego_vehicle" / "label").iterdir()).name
    for path in sorted(kind.rglob(f"{name}*"), reverse=True):
        path.rename(path.with_name(path.name.replace(name, hostile)))
    explorer = Explorer(DeepAccident("v1", own_release, verbose=False))
    (token,) = [token for token in explorer.scenarios.tokens if hostile in token]
    app = make_app(explorer)

    page_address = f"/scenario/{quote(token)}/"
    addresses = ["/", "/?view=table", f"/?q={quote('name=' + hostile)}"]
    addresses.append("/?town=%3Cimg%3E&q=%3Cb%3E")
    for part in ("", "twin", "moment/ego_vehicle/1", *(f"parts/{part}" for part in PARTS)):
        addresses.append(page_address + part)
    for address in addresses:
        text = get_response(app, address).text
        assert not contained_parts(text, "<img src=x", "<img>"), address
        assert not re.search(r"\sstyle=|\son\w+=\"|javascript:", text), address
    assert response_status(app, f"/thumbnail/{quote(token)}.jpg") == 200
    assert response_status(app, page_address) == 200


def test_a_list_is_saved_only_for_a_query_without_faults(app: Any) -> None:
    saved = get_response(app, "/selection.txt?collision=true")
    refused = get_response(app, "/selection.txt?q=bogus%3D1")
    assert saved.headers["content-disposition"] == 'attachment; filename="selection.txt"'
    assert (refused.status, "bogus" in refused.text) == (409, True)


def test_static_files_are_kept_for_ever_and_nothing_else_is_one(app: Any) -> None:
    for address in re.findall(r'(?:src|href)="\./(static/[^"]+)"', get_response(app, "/").text):
        response = get_response(app, f"/{address}")
        assert (response.status, "immutable" in response.headers["cache-control"]) == (200, True)
    for name in ("__init__.py", "..%2f..%2fexplorer.py", "%2e%2e/%2e%2e/explorer.py", "base.html"):
        assert response_status(app, f"/static/0/{name}") == 404


def test_no_such_bundle_is_one_sentence(da: DeepAccident, tmp_path: Path) -> None:
    assert_raises(
        (lambda: Explorer(da, bundles=[tmp_path / "none"]), ResultsError, "no such folder")
    )
