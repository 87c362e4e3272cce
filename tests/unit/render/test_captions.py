"""Titles: what they say of a moment, that nothing of them is cut off, and where the token is."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from drawing import title_of, tokens_of
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from refusals import assert_refused
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingFileError
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.captions import (
    missing_words,
    moment_words,
    scenario_words,
    set_scene_title,
)
from deepaccident_devkit.render.styles import MISSING_COLOR, current_style


def test_a_moment_in_words(da: DeepAccident, frame: str) -> None:
    scenario = frame.rsplit("/", 1)[0]
    record = da.scenario.get(scenario)
    for changed, words in (
        ({}, "Town02, wet cloudy night: car hits van"),
        (
            {"collision": {"classes": ["pedestrian", "truck"]}},
            "Town02, wet cloudy night: truck hits pedestrian",
        ),
        ({"collision": None}, "Town02, wet cloudy night: no collision"),
        ({"weather": None, "time_of_day": None, "collision": None}, "Town02: end unknown"),
    ):
        assert scenario_words({**record, **changed}) == words
    assert moment_words(da, frame) == "0.2 s to the impact"
    assert moment_words(da, f"{scenario}/ego_vehicle_behind/006") == "the impact, ego behind"


def test_a_paper_and_a_slide_have_their_sizes_and_no_tokens(da: DeepAccident, frame: str) -> None:
    with style("paper"):
        figure = da.render_frame(frame)
        assert (figure.get_figwidth(), current_style().dpi, tokens_of(figure)) == (7.16, 300, [])
    with style("slide"):
        assert da.render_frame(frame).get_size_inches() * current_style().dpi == pytest.approx(
            [1920, 1080]
        )
    with style(title=False):
        assert da.render_frame(frame).get_suptitle() == ""
    with pytest.raises(ChoiceError, match=r"cvpr-column.*'poster'"):
        style("poster").__enter__()  # type: ignore[arg-type]


FRONT = "ego_vehicle Camera_Front: not downloaded"
POLE = "no LiDAR file of infrastructure"


def grey_panels(figure: Figure) -> int:
    return sum(to_hex(ax.get_facecolor()) == MISSING_COLOR for ax in figure.axes)


VIEWS: list[tuple[Callable[[DeepAccident, str], Any], int, list[str]]] = [
    (lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003"), 1, [FRONT]),
    (
        lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003", agents="available"),
        1,
        [FRONT, POLE],
    ),
    (lambda da, scenario: da.render_sample(f"{scenario}/infrastructure/003"), 0, [POLE]),
    (lambda da, scenario: da.render_frame(f"{scenario}/003"), 1, [FRONT, POLE]),
    (lambda da, scenario: da.render_calibration(f"{scenario}/003"), 1, [FRONT, POLE]),
    (
        lambda da, scenario: da.render_calibration(
            f"{scenario}/ego_vehicle/003", agents=["infrastructure"]
        ),
        1,
        [FRONT, POLE],
    ),
    (lambda da, scenario: da.render_visibility(f"{scenario}/003", layers=["points"]), 0, [POLE]),
    (
        lambda da, scenario: da.render_sample_data(f"{scenario}/ego_vehicle/003/Camera_Front"),
        1,
        [FRONT],
    ),
    (
        lambda da, scenario: da.render_sample_data(f"{scenario}/infrastructure/003/lidar01"),
        0,
        [POLE],
    ),
    (
        lambda da, scenario: da.render_sample_data(
            f"{scenario}/infrastructure/003/Camera_Front", layers=["image", "points"]
        ),
        0,
        [POLE],
    ),
    (
        lambda da, scenario: da.render_pointcloud_in_image(
            f"{scenario}/ego_vehicle/003/Camera_Front"
        ),
        1,
        [FRONT],
    ),
    (
        lambda da, scenario: da.render_pointcloud_in_image(
            f"{scenario}/infrastructure/003/Camera_Front"
        ),
        0,
        [POLE],
    ),
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


def test_one_frame_that_is_missing_is_not_called_a_missing_download(
    release_root: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(
        release_root, tmp_path / "release", ignore=shutil.ignore_patterns(".deepaccident")
    )
    da = DeepAccident(dataroot=root, verbose=False)
    sample = da.get_sample(da.scenario[0], "ego_vehicle", 3)
    da.get_sample_data_path(sample, "Camera_Front").unlink()
    figure = da.render_sample(sample)
    assert missing_words(figure) == ["ego_vehicle Camera_Front: no file of this frame"]
    frames = da.sensor_frames(da.scenario[0])
    assert {*frames["ego_vehicle", "lidar01"]} - {*frames["ego_vehicle", "Camera_Front"]} == {3}


@pytest.mark.parametrize(("view", "grey", "words"), VIEWS)
def test_a_picture_names_what_is_not_there(
    da_partial: DeepAccident,
    scenario: str,
    view: Callable[[DeepAccident, str], Any],
    grey: int,
    words: list[str],
) -> None:
    figure = view(da_partial, scenario).figure
    assert (grey_panels(figure), missing_words(figure)) == (grey, words)
    titles = [title_of(figure), *(ax.get_title() for ax in figure.axes)]
    assert any(POLE in title.replace("\n", " ") for title in titles) == (
        POLE in words
    )  # not over the data


def test_a_whole_release_lacks_nothing(da: DeepAccident, scenario: str) -> None:
    for figure in (
        da.render_sample(f"{scenario}/ego_vehicle/003", agents="all"),
        da.render_frame(f"{scenario}/003"),
    ):
        assert (grey_panels(figure), missing_words(figure)) == (0, [])


def test_only_nothing_at_all_is_an_error(
    da_b: DeepAccident, da_partial: DeepAccident, scenario: str
) -> None:
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
    assert not lacking(
        missing_words(figure), "no LiDAR file of ego_vehicle", "BEV_instance_camera: not downloaded"
    )


def test_the_token_is_written_once(da: DeepAccident, frame: str) -> None:
    figure = detached_figure((8, 4))
    ax = figure.add_subplot()
    for _ in range(2):
        set_scene_title(figure, da, frame, "more", below="another line")
        set_scene_title(ax, da, frame)
    assert tokens_of(figure) == [frame, frame]


@pytest.mark.slow
def test_accident_video_and_replay_are_rendered(
    da_partial: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    assert set(missing_words(da_partial.render_accident(scenario))) <= {FRONT}
    views = ["sample", "Camera_Front", "calibration"]
    da_partial.render_scenario_video(
        scenario, tmp_path / "v.gif", views=views, frames=[3], size=(480, 180), workers=1
    )
    da_partial.render_replay(scenario, tmp_path / "replay.html")
    assert len([path for path in tmp_path.iterdir() if path.stat().st_size > 0]) == 2
