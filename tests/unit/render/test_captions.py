"""Titles: what they say of a moment, that nothing of them is cut off, and where the token is."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import legend_words, title_of, tokens_of
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from refusals import assert_refused
from wording import holding, lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingFileError
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.captions import missing_words, moment_words, scenario_words, set_scene_title, set_title
from deepaccident_devkit.render.styles import MISSING_COLOR, current_style


@pytest.mark.parametrize("fontsize", [None, "medium", 14])
@pytest.mark.parametrize("width", [2.0, 4.0, 30.0])
def test_a_title_is_as_wide_as_its_figure(width: float, fontsize: float | str | None) -> None:
    words = "type1_subtype1_accident/Town10HD_type001_subtype0001_scenario00001/ego_vehicle/030, t = 2.9 s"
    figure = detached_figure((width, 4.0))
    ax = figure.add_subplot()
    for where, title in ((figure, figure.get_suptitle), (ax, ax.get_title)):
        set_title(where, words, fontsize=fontsize)
        assert title().replace("\n", "") in (words, words.replace(", ", ","))
        assert ("\n" in title()) == (width < 30)
    figure.draw_without_rendering()
    suptitle: Any = figure._suptitle
    assert max(text.get_window_extent().width for text in (suptitle, ax.title)) <= figure.bbox.width


def test_a_moment_in_words(da: DeepAccident, frame: str) -> None:
    scenario = frame.rsplit("/", 1)[0]
    record = da.scenario.get(scenario)
    assert scenario_words(record) == "Town02, wet cloudy night: car hits van"
    for changed, words in (
        ({"weather": "HardRain"}, "Town02, hard rain at night: car hits van"),
        ({"collision": {"classes": ["pedestrian", "truck"]}}, "Town02, wet cloudy night: truck hits pedestrian"),
        ({"collision": None}, "Town02, wet cloudy night: no collision"),
        ({"weather": None, "time_of_day": None, "collision": None}, "Town02: end unknown"),
    ):
        assert scenario_words({**record, **changed}) == words
    normal = next(one["first_frame_token"] for one in da.scenario if one["collision"] is None)
    tokens = {frame: "0.2 s to the impact", f"{scenario}/ego_vehicle_behind/006": "the impact, ego behind"}
    assert {token: moment_words(da, token) for token in (*tokens, normal)} == {**tokens, normal: "0.0 s"}


def test_the_token_is_beneath_its_title_and_written_once(da: DeepAccident, frame: str) -> None:
    figure = detached_figure((8, 4))
    ax = figure.add_subplot()
    for _ in range(2):
        set_scene_title(figure, da, frame, "more", below="another line")
        set_scene_title(ax, da, frame)
    assert tokens_of(figure) == [frame, frame]
    assert title_of(figure) == "Town02, wet cloudy night: 0.2 s to the impact, more another line"
    figure.draw_without_rendering()
    title: Any = figure._suptitle
    (box,) = (
        each.get_window_extent() for each in figure.artists if each.get_gid() == "token" and each.xycoords is title
    )
    lowest = title.get_window_extent().y0
    assert lowest <= box.y0 < box.y1 < lowest + 20


def test_a_paper_and_a_slide_have_their_sizes_and_no_tokens(da: DeepAccident, frame: str) -> None:
    with style("paper"):
        camera = f"{frame.rsplit('/', 1)[0]}/ego_vehicle/004/Camera_Front"
        assert da.render_sample_data(camera).figure.get_figwidth() == 3.5
        figure = da.render_frame(frame)
        assert (figure.get_figwidth(), current_style().dpi, tokens_of(figure)) == (7.16, 300, [])
    with style("slide"):
        assert da.render_frame(frame).get_size_inches() * current_style().dpi == pytest.approx([1920, 1080])
    assert tokens_of(da.render_frame(frame)) == [frame]
    with style(title=False):
        assert (da.render_frame(frame).get_suptitle(), da.render_bev(f"{camera.rsplit('/', 1)[0]}").get_title()) == (
            "",
            "",
        )
    assert_refused((style("poster").__enter__, ChoiceError, ("style", "paper, cvpr-column", "'poster'")))  # type: ignore[arg-type]


FRONT = "ego_vehicle Camera_Front: not downloaded"
POLE = "no LiDAR file of infrastructure"


def grey_panels(figure: Figure) -> int:
    return sum(to_hex(ax.get_facecolor()) == MISSING_COLOR for ax in figure.axes)


VIEWS: list[tuple[Callable[[DeepAccident, str], Any], int, list[str]]] = [
    (lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003"), 1, [FRONT]),
    (lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003", agents="available"), 1, [FRONT, POLE]),
    (lambda da, scenario: da.render_sample(f"{scenario}/infrastructure/003"), 0, [POLE]),
    (lambda da, scenario: da.render_frame(f"{scenario}/003"), 1, [FRONT, POLE]),
    (lambda da, scenario: da.render_calibration(f"{scenario}/003"), 1, [FRONT, POLE]),
    (
        lambda da, scenario: da.render_calibration(f"{scenario}/ego_vehicle/003", agents=["infrastructure"]),
        1,
        [FRONT, POLE],
    ),
    (lambda da, scenario: da.render_visibility(f"{scenario}/003", layers=["points"]), 0, [POLE]),
    (lambda da, scenario: da.render_sample_data(f"{scenario}/ego_vehicle/003/Camera_Front"), 1, [FRONT]),
    (lambda da, scenario: da.render_sample_data(f"{scenario}/infrastructure/003/lidar01"), 0, [POLE]),
    (
        lambda da, scenario: da.render_sample_data(
            f"{scenario}/infrastructure/003/Camera_Front", layers=["image", "points"]
        ),
        0,
        [POLE],
    ),
    (lambda da, scenario: da.render_pointcloud_in_image(f"{scenario}/ego_vehicle/003/Camera_Front"), 1, [FRONT]),
    (lambda da, scenario: da.render_pointcloud_in_image(f"{scenario}/infrastructure/003/Camera_Front"), 0, [POLE]),
    (
        lambda da, scenario: da.render_pointcloud_in_image(
            f"{scenario}/ego_vehicle_behind/003/Camera_Front", color_by="agent"
        ),
        0,
        [POLE],
    ),
]


@pytest.fixture(scope="module")
def scenario(da_partial: DeepAccident) -> str:
    return next(record["token"] for record in da_partial.scenario if record["collision"])


def test_one_frame_that_is_missing_is_not_called_a_missing_download(release_root: Path, tmp_path: Path) -> None:
    root = shutil.copytree(release_root, tmp_path / "release", ignore=shutil.ignore_patterns(".deepaccident"))
    da = DeepAccident(dataroot=root, verbose=False)
    sample = da.get_sample(da.scenario[0], "ego_vehicle", 3)
    da.get_sample_data_path(sample, "Camera_Front").unlink()
    figure = da.render_sample(sample)
    assert missing_words(figure) == ["ego_vehicle Camera_Front: no file of this frame"]
    frames = da.sensor_frames(da.scenario[0])
    assert {*frames["ego_vehicle", "lidar01"]} - {*frames["ego_vehicle", "Camera_Front"]} == {3}


@pytest.mark.parametrize(("view", "grey", "words"), VIEWS)
def test_a_picture_names_what_is_not_there(
    da_partial: DeepAccident, scenario: str, view: Callable[[DeepAccident, str], Any], grey: int, words: list[str]
) -> None:
    figure = view(da_partial, scenario).figure
    assert (grey_panels(figure), missing_words(figure)) == (grey, words)
    titles = [title_of(figure), *(ax.get_title() for ax in figure.axes)]
    assert any(POLE in title.replace("\n", " ") for title in titles) == (POLE in words)  # not over the data
    assert lacking(" ".join(text.get_text() for ax in figure.axes for text in ax.texts), "LiDAR") == ["LiDAR"]


def test_a_whole_release_lacks_nothing(da: DeepAccident, scenario: str) -> None:
    for figure in (da.render_sample(f"{scenario}/ego_vehicle/003", agents="all"), da.render_frame(f"{scenario}/003")):
        assert (grey_panels(figure), missing_words(figure)) == (0, [])


def test_the_legend_has_only_the_agents_whose_points_are_rendered(da_partial: DeepAccident, scenario: str) -> None:
    points, boxes = (
        da_partial.render_bev(f"{scenario}/ego_vehicle/003", agents="available", layers=layers)
        for layers in (None, ["boxes"])
    )
    assert (missing_words(points), missing_words(boxes)) == ([POLE], [])
    named = holding(legend_words(points), "ego", "ego behind", "other", "infrastructure")
    assert (named, "ego" in legend_words(boxes)) == (["ego", "ego behind", "other"], False)


def test_points_of_the_sweeps_that_are_there(da: DeepAccident, scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ego's second point cloud is gone."""
    part = DeepAccident("v1", da.dataroot, verbose=False)
    path = part.sensor_path

    def without_second(sample_data: Any) -> Path:
        found: Path = path(sample_data)
        return found.with_name("gone.npz") if "ego_vehicle/lidar01" in str(found) and "_002" in found.name else found

    monkeypatch.setattr(part, "sensor_path", without_second)
    drawn = (one.render_bev(f"{scenario}/ego_vehicle/003", sweeps=3) for one in (part, da))
    fewer, all_ = (len(ax.collections[0].get_offsets()) for ax in drawn)
    assert 0 < fewer < all_
    assert missing_words(part.render_bev(f"{scenario}/ego_vehicle/002")) == ["no LiDAR file of ego_vehicle"]


def test_only_nothing_at_all_is_an_error(da_b: DeepAccident, da_partial: DeepAccident, scenario: str) -> None:
    front = f"{scenario}/ego_vehicle/003/Camera_Front"
    other = f"{da_b.sample[0]['token']}/Camera_Front"
    assert_refused(
        (
            lambda: da_partial.render_sample_data(front, layers=["image"]),
            MissingFileError,
            ("nothing else to render", "unpack", "choose other layers"),
        ),
        (
            lambda: da_b.render_pointcloud_in_image(other),
            MissingFileError,
            ("no such file", "no LiDAR file of ego_vehicle", "unpack the archives"),
        ),
    )
    figure = da_b.render_sample(da_b.sample[0])
    assert grey_panels(figure) == 6
    assert not lacking(missing_words(figure), "no LiDAR file of ego_vehicle", "BEV_instance_camera: not downloaded")


def test_a_box_is_shown_by_a_camera_that_is_there(da: DeepAccident, da_partial: DeepAccident, scenario: str) -> None:
    sample, checked = f"{scenario}/ego_vehicle/003", 0
    for row in np.flatnonzero(da.boxes(sample).actor_id >= 0).tolist():
        views = [best_view(one, [sample], one.boxes(sample, "world").select([row])) for one in (da, da_partial)]
        front, still = (view is not None and view.camera.endswith("Camera_Front") for view in views)
        if front:
            assert grey_panels(da_partial.render_annotation(f"{sample}/{row}")) == still
            checked += 1
    assert checked


@pytest.mark.slow
def test_accident_instance_and_video_are_rendered(da_partial: DeepAccident, scenario: str, tmp_path: Path) -> None:
    other = da_partial.get("agent", f"{scenario}/other_vehicle")["actor_id"]
    for figure in (da_partial.render_accident(scenario), da_partial.render_instance(f"{scenario}/actor/{other}")):
        assert set(missing_words(figure)) <= {FRONT}
    for number, what in enumerate(("accident", ["sample", "Camera_Front"], ["frame", "calibration"])):
        path = tmp_path / f"{number}.gif"
        da_partial.render_scenario_video(scenario, path, what=what, frames=[3], size=(320, 180), workers=1)
    da_partial.render_replay(scenario, tmp_path / "replay.html")
    assert len([path for path in tmp_path.iterdir() if path.stat().st_size > 0]) == 4
