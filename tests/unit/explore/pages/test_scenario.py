"""A scenario's page, its files and its parts: what they show is what the devkit computes, and nothing else is given."""

import base64
import io
import json
import re
import shutil
import threading
from collections.abc import Iterator
from inspect import iscoroutinefunction
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from asgi import Answer, get
from PIL import Image
from replay_page import accident, data_of, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.explore import Explorer, make_app
from deepaccident_devkit.explore.pages import release
from deepaccident_devkit.explore.pages.scenario import PARTS
from deepaccident_devkit.render.replay import render_replay
from deepaccident_devkit.render.replay.entries import recording_of
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
def here(da: DeepAccident) -> str:
    """The address of an accident's page."""
    return f"/scenario/{accident(da)}/"


def image(answer: Answer) -> Image.Image:
    assert answer.status == 200
    assert answer.headers["content-type"] in ("image/jpeg", "image/png")
    return Image.open(io.BytesIO(answer.body))


def test_no_page_is_made_in_the_servers_own_thread(app: Any, explorer: Explorer, monkeypatch: Any) -> None:
    """It answers all others meanwhile."""
    found = release.found_by
    threads = []
    monkeypatch.setattr(release, "found_by", lambda *given: threads.append(threading.current_thread()) or found(*given))
    query = "&".join(f"town=T{number}" for number in range(4000))
    whole = get(app, "/").text
    for address in (f"/?{query}", f"/?{query}&view=table", f"/selection.txt?{query}"):
        answer = get(app, address)
        assert answer.status == 200
        assert len(answer.text) < len(whole) + 200_000
    assert len(threads) == 4
    assert threading.main_thread() not in threads
    quick = {"with_slash", "_answer", "_waiting"}
    assert {route.endpoint.__name__ for route in app.routes if iscoroutinefunction(route.endpoint)} == quick


def test_the_page_plays_what_the_replay_plays(app: Any, here: str, da: DeepAccident, tmp_path: Path) -> None:
    served = data_of(get(app, here).text)
    alone = data_of(render_replay(da, None, tmp_path / "replay.html"))
    same = set(alone) - {"cameras", "points", "notes"}
    assert {name: served[name] for name in same} == {name: alone[name] for name in same}
    assert served["served"]["folder"] == ""
    assert served["served"]["points"] == [[True] * 6] * 5
    assert served["notes"] == []
    for cameras in served["cameras"]:
        assert [each["channel"] for each in cameras] == list(CAMERAS)
        assert all(each["pictures"] == [1] * 6 for each in cameras)


def test_its_address_ends_in_a_slash(app: Any, here: str) -> None:
    answer = get(app, f"{here.rstrip('/')}?frame=3")
    assert (answer.status, answer.headers["location"]) == (307, f"./{here.strip('/').rsplit('/', 1)[1]}/?frame=3")


def test_images_are_the_releases_in_the_width_asked_for(app: Any, here: str, da: DeepAccident) -> None:
    for width, shown in ((160, 64), (32, 64), (None, 64), (9999, 64)):  # these images are 64 wide
        query = "" if width is None else f"?width={width}"
        found = image(get(app, f"{here}images/infrastructure/Camera_Back/2{query}"))
        assert found.size == (shown, 36)
    wanted = da.load_image(f"{accident(da)}/infrastructure/002/Camera_Back")
    apart = np.asarray(found, dtype=int) - wanted.astype(int)
    assert np.abs(apart).mean() < 7  # JPEG, twice


def test_points_are_the_agents_own(app: Any, here: str, da: DeepAccident) -> None:
    origin = recording_of(da, accident(da), None).origin
    for agent in ("ego_vehicle", "infrastructure"):
        coded = get(app, f"{here}points/{agent}/3")
        assert coded.headers["content-type"].startswith("text/plain")
        found = np.frombuffer(base64.b64decode(coded.body), dtype="<i2").reshape(-1, 2) / 10 + origin
        cloud = da.load_point_cloud(f"{accident(da)}/{agent}/003", "world").xyz[:, :2]
        nearest = np.linalg.norm(found[:50, None] - cloud, axis=-1).min(axis=1)
        assert nearest.max() < 0.08
        assert len(found) > 50


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
def test_nothing_else_is_given(app: Any, here: str, address: str) -> None:
    answer = get(app, here + address)
    assert answer.status == 404
    assert "root:" not in answer.text


@pytest.mark.parametrize(
    "address", ["/scenario/nowhere/none/", "/thumbnail/nowhere/none.jpg", "/nothing", "/scenario/"]
)
def test_what_is_not_there_is_said(app: Any, address: str) -> None:
    answer = get(app, address)
    assert answer.status == 404
    assert "<h1>Not" in answer.text


def test_the_parts_tell_what_the_devkit_tells(app: Any, here: str, da: DeepAccident) -> None:
    token = accident(da)
    story = get(app, f"{here}parts/story").text
    assert da.describe(token).text in story.replace("&#39;", "'")
    pairs = da.interactions(token).pairs
    rows = re.findall(
        r"<tr><th scope=\"row\">(.*?)</th><td>(yes|no)</td><td>([^<]*)</td>", get(app, f"{here}parts/pairs").text
    )
    assert len(rows) == min(30, len(pairs))
    moving = [float(ttc) for _, moves, ttc in rows if moves == "yes" and ttc != "never"]
    assert moving == sorted(moving)
    assert moving[0] == pytest.approx(pairs.min_ttc[pairs.moving].min(), abs=0.005)
    ledger = get(app, f"{here}parts/ledger").text
    assert len(re.findall("<tr><th", ledger)) == 2 + 16 + 4
    assert get(app, f"{here}parts/findings").text.strip().startswith("<p>None: ")
    assert "Shapley" in ledger


def test_what_cannot_be_told_is_said_in_its_place(app: Any, da: DeepAccident) -> None:
    answer = get(app, f"/scenario/{normal(da)}/parts/ledger")
    assert answer.status == 200
    assert "nobody collides" in answer.text


def test_a_moment_has_its_boxes(app: Any, here: str, da: DeepAccident) -> None:
    page = get(app, f"{here}moment/other_vehicle/2").text
    boxes = da.get_boxes(f"{accident(da)}/other_vehicle/002", "ego")
    rows = re.findall(r"<tr><th scope=\"row\">(\d+)</th><td>(\w+)</td><td>(-?\d+)</td>\s*<td>([-\d.]+)</td>", page)
    assert [(int(row), category, int(actor)) for row, category, actor, _ in rows] == [
        (row, box.category, box.actor_id) for row, box in enumerate(boxes)
    ]
    assert [float(x) for *_, x in rows] == pytest.approx([box.center[0] for box in boxes], abs=0.006)
    assert 'rel="prev"' in page
    assert 'rel="prev"' not in get(app, f"{here}moment/other_vehicle/1").text
    assert 'rel="next"' not in get(app, f"{here}moment/other_vehicle/6").text


@pytest.mark.slow
def test_a_moment_is_rendered(app: Any, here: str) -> None:
    for name in ("sample", "labels"):
        first = get(app, f"{here}moment/ego_vehicle/2/{name}.png")
        assert min(image(first).size) > 300
        assert get(app, f"{here}moment/ego_vehicle/2/{name}.png").body == first.body


def test_a_partial_download_is_told(da_partial: DeepAccident) -> None:
    app = make_app(Explorer(da_partial))
    data = data_of(get(app, f"/scenario/{accident(da_partial)}/").text)
    names = [agent["name"] for agent in data["agents"]]
    assert names == [agent for agent in AGENTS if agent != "other_vehicle_behind"]
    front = data["cameras"][0][0]
    assert (front["channel"], front["pictures"]) == ("Camera_Front", [None] * 6)
    assert data["served"]["points"][names.index("infrastructure")] is None
    assert any("6 of 144 camera files are missing" in note for note in data["notes"])
    assert get(app, f"/scenario/{accident(da_partial)}/images/ego_vehicle/Camera_Front/1").status == 500
    assert get(app, f"/scenario/{accident(da_partial)}/points/infrastructure/1").status == 404


def test_labels_alone_are_enough(da_b: DeepAccident) -> None:
    app = make_app(Explorer(da_b))
    for address in ("", "moment/ego_vehicle/1", *(f"parts/{part}" for part in PARTS)):
        assert get(app, f"/scenario/{accident(da_b)}/{address}").status == 200


def test_a_broken_scenario_has_its_findings_alone(own_release: Path) -> None:
    broken = max(own_release.rglob("ego_vehicle/label/*"))
    next(broken.iterdir()).write_bytes(b"no label\n")
    explorer = Explorer(DeepAccident("v1", own_release, verbose=False, on_error="skip"))
    (token,) = {problem.scenario for problem in explorer.dataset.problems}
    app = make_app(explorer)
    page = get(app, f"/scenario/{token}/")
    assert page.status == 200
    assert "label-unreadable" in page.text
    listed = get(app, "/").text
    assert f'href="./scenario/{token}/"' in listed
    assert "1 broken scenario is left out" in listed


def test_names_are_text_everywhere(own_release: Path) -> None:
    """What the release's folders and meta files say is never HTML."""
    hostile = "Town04_type001_subtype0001_scenario00066\"><img src=x onerror=alert(1)>'&"
    kind = (
        max(own_release.rglob("*_normal")) if [*own_release.rglob("*_normal")] else max(own_release.rglob("*_accident"))
    )
    name = min((kind / "ego_vehicle" / "label").iterdir()).name
    for folder in kind.glob("*/*/*"):
        if folder.name == name:
            for path in [*folder.iterdir()]:
                path.rename(path.with_name(path.name.replace(name, hostile)))
            folder.rename(folder.with_name(hostile))
    shutil.move(kind / "meta" / f"{name}.txt", kind / "meta" / f"{hostile}.txt")
    explorer = Explorer(DeepAccident("v1", own_release, verbose=False))
    (token,) = [each for each in explorer.scenarios.tokens if hostile in each]
    app, where = make_app(explorer), f"/scenario/{quote(token)}/"
    pages = ["/", "/?view=table", where, f"{where}twin", f"{where}moment/ego_vehicle/1"]
    pages += [f"{where}parts/{part}" for part in PARTS] + [
        f"/?q={quote('name=' + hostile)}",
        "/?town=%3Cimg%3E&q=%3Cb%3E",
    ]
    for address in pages:
        text = get(app, address).text
        assert "<img src=x" not in text, address
        assert "<img>" not in text, address
        assert not re.search(r"\sstyle=|\son\w+=\"|javascript:", text), address
    assert get(app, f"/thumbnail/{quote(token)}.jpg").status == 200
    assert get(app, where).status == 200


def test_the_list_is_not_an_answer_to_all(app: Any) -> None:
    assert get(app, "/waiting.json").headers["content-type"] == "application/json"
    assert isinstance(json.loads(get(app, "/waiting.json").body), list)
    saved = get(app, "/selection.txt?collision=true")
    assert saved.headers["content-disposition"] == 'attachment; filename="selection.txt"'
    refused = get(app, "/selection.txt?q=bogus%3D1")
    assert refused.status == 409
    assert "bogus" in refused.text


def test_static_files_are_kept_for_ever_and_nothing_else_is_one(app: Any) -> None:
    page = get(app, "/").text
    for address in re.findall(r'(?:src|href)="\./(static/[^"]+)"', page):
        answer = get(app, f"/{address}")
        assert answer.status == 200
        assert "immutable" in answer.headers["cache-control"]
    for name in ("__init__.py", "..%2f..%2fexplorer.py", "%2e%2e/%2e%2e/explorer.py", "base.html"):
        assert get(app, f"/static/0/{name}").status == 404


def test_no_such_bundle_is_one_sentence(da: DeepAccident, tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="no such folder"):
        Explorer(da, bundles=[tmp_path / "none"])
