"""Titles: what they say about a moment, that nothing of them is cut off, and where the token is."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from support.expected_errors import assert_raises
from support.figure_texts import find_text_faults
from support.rendered_pixels import read_title, read_tokens
from support.replay_page import accident_scenario
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingFileError
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.captions import (
    missing_words,
    moment_words,
    scenario_words,
    set_scene_title,
    set_title,
)
from deepaccident_devkit.render.styles import MISSING_COLOR, current_style


def test_a_moment_in_words(da: DeepAccident, frame: str) -> None:
    scenario = frame.rsplit("/", 1)[0]
    record = da.scenario.get(scenario)

    for changes, words in (
        ({}, "Town02, wet cloudy night: car hits van"),
        (
            {"collision": {"classes": ["pedestrian", "truck"]}},
            "Town02, wet cloudy night: truck hits pedestrian",
        ),
        ({"collision": None}, "Town02, wet cloudy night: no collision"),
        ({"weather": None, "time_of_day": None, "collision": None}, "Town02: end unknown"),
    ):
        assert scenario_words({**record, **changes}) == words
    assert moment_words(da, frame) == "0.2 s before the impact"
    assert moment_words(da, f"{scenario}/ego_vehicle_behind/006") == "at the impact · ego behind"


def test_a_paper_and_a_slide_have_their_sizes_and_no_tokens(da: DeepAccident, frame: str) -> None:
    with style("paper"):
        figure = da.render_frame(frame)
        assert (figure.get_figwidth(), current_style().dpi, read_tokens(figure)) == (7.16, 300, [])
    with style("slide"):
        size_px = da.render_frame(frame).get_size_inches() * current_style().dpi
        assert size_px == pytest.approx([1920, 1080])
    with style(title=False):
        assert da.render_frame(frame).get_suptitle() == ""

    with pytest.raises(ChoiceError, match=r"cvpr-column.*'poster'"):
        style("poster").__enter__()  # type: ignore[arg-type]


NO_FRONT_CAMERA = "ego_vehicle Camera_Front: not downloaded"
NO_POLE_LIDAR = "no LiDAR file of infrastructure"


def count_grey_panels(figure: Figure) -> int:
    return sum(to_hex(ax.get_facecolor()) == MISSING_COLOR for ax in figure.axes)


VIEWS: list[tuple[Callable[[DeepAccident, str], Any], int, list[str]]] = [
    (lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003"), 1, [NO_FRONT_CAMERA]),
    (
        lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003", agents="available"),
        1,
        [NO_FRONT_CAMERA, NO_POLE_LIDAR],
    ),
    (lambda da, scenario: da.render_sample(f"{scenario}/infrastructure/003"), 0, [NO_POLE_LIDAR]),
    (lambda da, scenario: da.render_frame(f"{scenario}/003"), 1, [NO_FRONT_CAMERA, NO_POLE_LIDAR]),
    (
        lambda da, scenario: da.render_calibration(f"{scenario}/003"),
        1,
        [NO_FRONT_CAMERA, NO_POLE_LIDAR],
    ),
    (
        lambda da, scenario: da.render_calibration(
            f"{scenario}/ego_vehicle/003", agents=["infrastructure"]
        ),
        1,
        [NO_FRONT_CAMERA, NO_POLE_LIDAR],
    ),
    (
        lambda da, scenario: da.render_visibility(f"{scenario}/003", layers=["points"]),
        0,
        [NO_POLE_LIDAR],
    ),
    (
        lambda da, scenario: da.render_sample_data(f"{scenario}/ego_vehicle/003/Camera_Front"),
        1,
        [NO_FRONT_CAMERA],
    ),
    (
        lambda da, scenario: da.render_sample_data(f"{scenario}/infrastructure/003/lidar01"),
        0,
        [NO_POLE_LIDAR],
    ),
    (
        lambda da, scenario: da.render_sample_data(
            f"{scenario}/infrastructure/003/Camera_Front", layers=["image", "points"]
        ),
        0,
        [NO_POLE_LIDAR],
    ),
    (
        lambda da, scenario: da.render_pointcloud_in_image(
            f"{scenario}/ego_vehicle/003/Camera_Front"
        ),
        1,
        [NO_FRONT_CAMERA],
    ),
    (
        lambda da, scenario: da.render_pointcloud_in_image(
            f"{scenario}/infrastructure/003/Camera_Front"
        ),
        0,
        [NO_POLE_LIDAR],
    ),
    (
        lambda da, scenario: da.render_pointcloud_in_image(
            f"{scenario}/ego_vehicle_behind/003/Camera_Front", color_by="agent"
        ),
        0,
        [NO_POLE_LIDAR],
    ),
]


@pytest.fixture(scope="module")
def scenario(da_partial: DeepAccident) -> str:
    return accident_scenario(da_partial)


def test_one_frame_that_is_missing_is_not_called_a_missing_download(
    release_root: Path, tmp_path: Path
) -> None:
    root = shutil.copytree(
        release_root, tmp_path / "release", ignore=shutil.ignore_patterns(".deepaccident")
    )
    da = DeepAccident(dataroot=root, verbose=False)
    scenario = da.scenario[0]
    sample = da.get_sample(scenario, "ego_vehicle", 3)
    da.get_sample_data_path(sample, "Camera_Front").unlink()

    figure = da.render_sample(sample)

    assert missing_words(figure) == ["ego_vehicle Camera_Front: no file of this frame"]
    frames = da.sensor_frames(scenario)
    assert {*frames["ego_vehicle", "lidar01"]} - {*frames["ego_vehicle", "Camera_Front"]} == {3}


@pytest.mark.parametrize(("view", "num_grey_panels", "words"), VIEWS)
def test_a_picture_names_the_files_that_are_missing(
    da_partial: DeepAccident,
    scenario: str,
    view: Callable[[DeepAccident, str], Any],
    num_grey_panels: int,
    words: list[str],
) -> None:
    figure = view(da_partial, scenario).figure
    assert (count_grey_panels(figure), missing_words(figure)) == (num_grey_panels, words)

    titles = [read_title(figure), *(ax.get_title().replace("\n", " ") for ax in figure.axes)]
    is_in_title = any(NO_POLE_LIDAR in title for title in titles)  # not over the data
    assert is_in_title == (NO_POLE_LIDAR in words)


def test_a_whole_release_lacks_nothing(da: DeepAccident, scenario: str) -> None:
    for figure in (
        da.render_sample(f"{scenario}/ego_vehicle/003", agents="all"),
        da.render_frame(f"{scenario}/003"),
    ):
        assert (count_grey_panels(figure), missing_words(figure)) == (0, [])


def test_it_is_only_an_error_if_nothing_can_be_rendered(
    da_b: DeepAccident, da_partial: DeepAccident, scenario: str
) -> None:
    sample = da_b.sample[0]

    assert_raises(
        (
            lambda: da_partial.render_sample_data(
                f"{scenario}/ego_vehicle/003/Camera_Front", layers=["image"]
            ),
            MissingFileError,
            ("nothing else to render", "unpack", "choose other layers"),
        ),
        (
            lambda: da_b.render_pointcloud_in_image(f"{sample['token']}/Camera_Front"),
            MissingFileError,
            ("no such file", "no LiDAR file of ego_vehicle", "unpack the archives"),
        ),
    )
    figure = da_b.render_sample(sample)
    assert count_grey_panels(figure) == 6
    assert not missing_parts(
        missing_words(figure), "no LiDAR file of ego_vehicle", "BEV_instance_camera: not downloaded"
    )


def test_the_token_is_written_once(da: DeepAccident, frame: str) -> None:
    figure = detached_figure((8, 4))
    ax = figure.add_subplot()
    for _ in range(2):
        set_scene_title(figure, da, frame, "more", below="another line")
        set_scene_title(ax, da, frame)
    assert read_tokens(figure) == [frame, frame]


def test_long_titles_break_into_even_lines_and_never_inside_a_unit() -> None:
    figure = detached_figure((3, 2))
    for words, lines in (
        (
            "10.2 and 3.3 m/s, closing at 6.9 m/s, 0° between headings",
            ["10.2 and 3.3 m/s,", "closing at 6.9 m/s,", "0° between headings"],
        ),
        (
            "outlines touching from 0.1 s before the last frame (within 0.1 s)",
            ["outlines touching from", "0.1 s before the last", "frame (within 0.1 s)"],
        ),
    ):
        set_title(figure, words)
        assert figure.get_suptitle().split("\n") == lines


def test_a_token_vanishes_with_its_title(da: DeepAccident, frame: str) -> None:
    ax = detached_figure((8, 4)).add_subplot()
    set_scene_title(ax, da, frame)
    (token,) = ax.figure.artists
    assert token.get_visible()
    ax.set_title("(a) before")
    assert not token.get_visible()


@pytest.mark.parametrize("layout", [None, "constrained", "tight"])
def test_a_figure_of_the_caller_keeps_its_titles_and_shows_whole_legends(
    da: DeepAccident, frame: str, layout: Any
) -> None:
    sample = f"{frame.rsplit('/', 1)[0]}/ego_vehicle/004"
    figure = Figure(figsize=(12, 5), layout=layout)
    axes = figure.subplots(1, 3)
    for ax, title in zip(axes, ("(a) map", "(b) camera", "(c) sight"), strict=True):
        ax.set_title(title)
    da.render_bev(sample, agents="all", ax=axes[0])
    da.render_sample_data(f"{sample}/Camera_Front", ax=axes[1])
    da.render_visibility(sample, ax=axes[2])

    assert [ax.get_title() for ax in axes] == ["(a) map", "(b) camera", "(c) sight"]
    assert find_text_faults(figure) == []
    legends = [ax.get_legend() for ax in axes if ax.get_legend()]
    assert len(legends) > 1
    for legend in legends:
        box = legend.get_window_extent()
        assert figure.bbox.fully_contains(box.x0, box.y0)
        assert figure.bbox.fully_contains(box.x1, box.y1)


@pytest.mark.slow
def test_accident_video_and_replay_are_rendered(
    da_partial: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    assert set(missing_words(da_partial.render_accident(scenario))) <= {NO_FRONT_CAMERA}

    da_partial.render_scenario_video(
        scenario,
        tmp_path / "v.gif",
        views=["sample", "Camera_Front", "calibration"],
        frames=[3],
        size=(480, 180),
        workers=1,
    )
    da_partial.render_replay(scenario, tmp_path / "replay.html")
    assert len([path for path in tmp_path.iterdir() if path.stat().st_size > 0]) == 2
