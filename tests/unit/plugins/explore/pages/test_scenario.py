"""A scenario's page, its files and its parts: what they show is what the devkit computes, and
nothing else is given.
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
from asgi import Answer, get
from PIL import Image
from refusals import assert_refused
from replay_page import accident, data_of, normal
from wording import holding, lacking

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
def here(da: DeepAccident) -> str:
    """The address of an accident's page."""
    return f"/scenario/{accident(da)}/"


def image(answer: Answer) -> Image.Image:
    assert (answer.status, answer.headers["content-type"] in ("image/jpeg", "image/png")) == (
        200,
        True,
    )
    return Image.open(io.BytesIO(answer.body))


def status(app: Any, address: str) -> int:
    return get(app, address).status


def test_no_page_is_made_in_the_servers_own_thread(app: Any, monkeypatch: Any) -> None:
    """It answers all others meanwhile."""
    found, threads = release.match_scenarios, []
    monkeypatch.setattr(
        release,
        "match_scenarios",
        lambda *given: threads.append(threading.current_thread()) or found(*given),
    )
    query, whole = "&".join(f"town=T{number}" for number in range(4000)), len(get(app, "/").text)
    for address in (f"/?{query}", f"/?{query}&view=table", f"/selection.txt?{query}"):
        answer = get(app, address)
        assert (answer.status, len(answer.text) < whole + 200_000) == (200, True)
    assert (len(threads), threading.main_thread() in threads) == (4, False)


def test_the_page_plays_what_the_replay_plays(
    app: Any, here: str, da: DeepAccident, tmp_path: Path
) -> None:
    told, alone = (
        data_of(get(app, here).text),
        data_of(render_replay(da, None, tmp_path / "replay.html")),
    )
    same = set(alone) - {"cameras", "points", "notes"}
    assert {name: told[name] for name in same} == {name: alone[name] for name in same}
    assert told["served"]["points"] == [[True] * 6] * 5
    cameras = [
        [(each["channel"], each["pictures"]) for each in cameras] for cameras in told["cameras"]
    ]
    assert cameras == [[(channel, [1] * 6) for channel in CAMERAS]] * 5


def test_its_address_ends_in_a_slash(app: Any, here: str) -> None:
    answer = get(app, f"{here.rstrip('/')}?frame=3")
    assert (answer.status, answer.headers["location"]) == (
        307,
        f"./{here.strip('/').rsplit('/', 1)[1]}/?frame=3",
    )


def test_images_are_the_releases_in_the_width_asked_for(
    app: Any, here: str, da: DeepAccident
) -> None:
    address = f"{here}images/infrastructure/Camera_Back/2"
    pictures = [
        image(get(app, address + query)) for query in ("?width=160", "?width=32", "", "?width=9999")
    ]
    assert [each.size for each in pictures] == [(64, 36)] * 4  # these images are 64 wide
    wanted = da.load_image(f"{accident(da)}/infrastructure/002/Camera_Back").astype(int)
    assert np.abs(np.asarray(pictures[-1], dtype=int) - wanted).mean() < 7  # JPEG, twice


def test_points_are_the_agents_own(app: Any, here: str, da: DeepAccident) -> None:
    origin = recording_of(da, accident(da), None).origin
    for agent in ("ego_vehicle", "infrastructure"):
        coded = get(app, f"{here}points/{agent}/3")
        assert coded.headers["content-type"].startswith("text/plain")
        found = np.frombuffer(base64.b64decode(coded.body), dtype="<i2").reshape(-1, 3) / 10 + [
            *origin,
            0.0,
        ]
        cloud = da.load_point_cloud(f"{accident(da)}/{agent}/003", "world").xyz
        assert np.linalg.norm(found[:50, None] - cloud, axis=-1).min(axis=1).max() < 0.0867
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
    assert (answer.status, "root:" in answer.text) == (404, False)


@pytest.mark.parametrize(
    "address", ["/scenario/nowhere/none/", "/thumbnail/nowhere/none.jpg", "/nothing", "/scenario/"]
)
def test_what_is_not_there_is_said(app: Any, address: str) -> None:
    answer = get(app, address)
    assert (answer.status, "<h1>Not" in answer.text) == (404, True)


def test_the_parts_tell_what_the_devkit_tells(app: Any, here: str, da: DeepAccident) -> None:
    story, pairs, ledger, _ = (
        get(app, f"{here}parts/{part}").text for part in PARTS if part != "twins"
    )
    assert da.describe(accident(da)).text in story.replace("&#39;", "'")
    rows = re.findall(r"<tr><th scope=\"row\">(.*?)</th><td>(yes|no)</td><td>([^<]*)</td>", pairs)
    known = da.interactions(accident(da)).pairs
    assert len(rows) == min(30, len(known))
    moving = [float(ttc) for _, moves, ttc in rows if moves == "yes" and ttc != "never"]
    assert moving == sorted(moving)
    assert moving[0] == pytest.approx(known.min_ttc[known.moving].min(), abs=0.005)
    assert ledger.count("<tr><th") == 2 + 16 + 4


def test_what_cannot_be_told_is_said_in_its_place(app: Any, da: DeepAccident) -> None:
    answer = get(app, f"/scenario/{normal(da)}/parts/ledger")
    assert (answer.status, "nobody collides" in answer.text) == (200, True)


def test_a_moment_has_its_boxes(app: Any, here: str, da: DeepAccident) -> None:
    page = get(app, f"{here}moment/other_vehicle/2").text
    boxes = list(da.get_boxes(f"{accident(da)}/other_vehicle/002", "ego"))
    rows = re.findall(
        r"<tr><th scope=\"row\">(\d+)</th><td>(\w+)</td><td>(-?\d+)</td>\s*<td>([-\d.]+)</td>", page
    )
    assert [(int(row), category, int(actor), float(x)) for row, category, actor, x in rows] == [
        (row, box.category, box.actor_id, pytest.approx(box.center[0], abs=0.006))
        for row, box in enumerate(boxes)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sample", "labels"])
def test_a_moment_is_rendered(app: Any, here: str, name: str) -> None:
    first, again = (get(app, f"{here}moment/ego_vehicle/2/{name}.png") for _ in range(2))
    assert (min(image(first).size) > 300, again.body) == (True, first.body)


def test_a_partial_download_is_told(da_partial: DeepAccident) -> None:
    app, here = make_app(Explorer(da_partial)), f"/scenario/{accident(da_partial)}/"
    data = data_of(get(app, here).text)
    names = [agent["name"] for agent in data["agents"]]
    assert names == [agent for agent in AGENTS if agent != "other_vehicle_behind"]
    front = data["cameras"][0][0]
    assert (front["channel"], front["pictures"]) == ("Camera_Front", [None] * 6)
    assert data["served"]["points"][names.index("infrastructure")] is None
    assert any("6 of 144 camera files are missing" in note for note in data["notes"])
    assert status(app, f"{here}points/infrastructure/1") == 404


def test_a_moment_without_files_leads_to_the_nearest_with_any(
    da: DeepAccident, tmp_path: Path
) -> None:
    gone = shutil.ignore_patterns(
        ".deepaccident", "*_005.jpg", "*_005.npz", "*_006.jpg", "*_006.npz"
    )
    root = shutil.copytree(da.dataroot, tmp_path / "r", ignore=gone)
    app, here = (
        make_app(Explorer(DeepAccident("v1", root, verbose=False))),
        f"/scenario/{accident(da)}/moment/ego_vehicle",
    )
    pages = {frame: get(app, f"{here}/{frame}").text for frame in (4, 6)}
    told = {
        frame: re.findall(r'moment/ego_vehicle/(\d)">([\d.]+ s \w+), frame', page)
        for frame, page in pages.items()
    }
    assert told == {4: [], 6: [("4", "0.2 s earlier")]}


def test_labels_alone_are_enough(da_b: DeepAccident) -> None:
    app, here = make_app(Explorer(da_b)), f"/scenario/{accident(da_b)}/"
    addresses = [here, f"{here}moment/ego_vehicle/1", *(f"{here}parts/{part}" for part in PARTS)]
    assert {each: status(app, each) for each in addresses} == dict.fromkeys(addresses, 200)


def test_a_broken_scenario_has_its_findings_alone(own_release: Path) -> None:
    next(max(own_release.rglob("ego_vehicle/label/*")).iterdir()).write_bytes(b"no label\n")
    explorer = Explorer(DeepAccident("v1", own_release, verbose=False, on_error="skip"))
    (token,) = {problem.scenario for problem in explorer.dataset.problems}
    app = make_app(explorer)
    page = get(app, f"/scenario/{token}/")
    assert (page.status, "label-unreadable" in page.text) == (200, True)
    assert not lacking(
        get(app, "/").text, f'href="./scenario/{token}/"', "1 broken scenario is left out"
    )


def test_names_are_text_everywhere(own_release: Path) -> None:
    """What the release's folders and meta files say is never HTML."""
    hostile = "Town04_type001_subtype0001_scenario00066\"><img src=x onerror=alert(1)>'&"
    kind = max([*own_release.rglob("*_normal")] or own_release.rglob("*_accident"))
    name = min((kind / "ego_vehicle" / "label").iterdir()).name
    for path in sorted(kind.rglob(f"{name}*"), reverse=True):
        path.rename(path.with_name(path.name.replace(name, hostile)))
    explorer = Explorer(DeepAccident("v1", own_release, verbose=False))
    (token,) = [each for each in explorer.scenarios.tokens if hostile in each]
    app, where = make_app(explorer), f"/scenario/{quote(token)}/"
    lists = ["/", "/?view=table", f"/?q={quote('name=' + hostile)}", "/?town=%3Cimg%3E&q=%3Cb%3E"]
    parts = [
        f"{where}{part}"
        for part in ("", "twin", "moment/ego_vehicle/1", *(f"parts/{part}" for part in PARTS))
    ]
    for address in (*lists, *parts):
        text = get(app, address).text
        assert not holding(text, "<img src=x", "<img>"), address
        assert not re.search(r"\sstyle=|\son\w+=\"|javascript:", text), address
    assert (status(app, f"/thumbnail/{quote(token)}.jpg"), status(app, where)) == (200, 200)


def test_the_list_is_not_an_answer_to_all(app: Any) -> None:
    saved, refused = (
        get(app, f"/selection.txt?{query}") for query in ("collision=true", "q=bogus%3D1")
    )
    assert saved.headers["content-disposition"] == 'attachment; filename="selection.txt"'
    assert (refused.status, "bogus" in refused.text) == (409, True)


def test_static_files_are_kept_for_ever_and_nothing_else_is_one(app: Any) -> None:
    for address in re.findall(r'(?:src|href)="\./(static/[^"]+)"', get(app, "/").text):
        answer = get(app, f"/{address}")
        assert (answer.status, "immutable" in answer.headers["cache-control"]) == (200, True)
    for name in ("__init__.py", "..%2f..%2fexplorer.py", "%2e%2e/%2e%2e/explorer.py", "base.html"):
        assert status(app, f"/static/0/{name}") == 404


def test_no_such_bundle_is_one_sentence(da: DeepAccident, tmp_path: Path) -> None:
    assert_refused(
        (lambda: Explorer(da, bundles=[tmp_path / "none"]), ResultsError, "no such folder")
    )
