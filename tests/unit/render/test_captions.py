"""Titles: what they say of a moment, that nothing of them is cut off, and where the token is."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from drawing import title_of, tokens_of
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, MissingFileError
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.captions import missing_words, moment_words, scene_words, set_scene_title, set_title
from deepaccident_devkit.render.styles import MISSING_COLOR, current_style


@pytest.mark.parametrize("fontsize", [None, "medium", 14])
def test_a_title_is_as_wide_as_its_figure(fontsize: float | str | None) -> None:
    words = "type1_subtype1_accident/Town10HD_type001_subtype0001_scenario00001/ego_vehicle/030, t = 2.9 s"
    for width in (2.0, 4.0, 30.0):
        figure = detached_figure((width, 4.0))
        ax = figure.add_subplot()
        for where, title in ((figure, figure.get_suptitle), (ax, ax.get_title)):
            set_title(where, words, fontsize=fontsize)
            assert title().replace("\n", "") in (words, words.replace(", ", ","))
            assert ("\n" in title()) == (width < 30)
        text: Any = figure._suptitle
        figure.draw_without_rendering()
        assert text.get_window_extent().width <= figure.bbox.width
        assert ax.title.get_window_extent().width <= figure.bbox.width


def test_a_moment_in_words(da: DeepAccident, frame: str) -> None:
    scenario = frame.rsplit("/", 1)[0]
    assert scene_words(da, scenario) == "Night, wet cloudy, Town02"
    assert moment_words(da, frame) == "0.2 s to the impact"
    assert moment_words(da, f"{scenario}/ego_vehicle_behind/006") == "the impact, ego vehicle behind"
    normal = next(one for one in da.scenario if one["collision"] is None)
    assert moment_words(da, normal["first_frame_token"]) == "0.0 s"


def test_the_token_is_beneath_its_title_and_written_once(da: DeepAccident, frame: str) -> None:
    figure = detached_figure((8, 4))
    ax = figure.add_subplot()
    for _ in range(2):
        set_scene_title(figure, da, frame, "more", below="another line")
        set_scene_title(ax, da, frame)
    assert tokens_of(figure) == [frame, frame]
    assert title_of(figure) == "Night, wet cloudy, Town02: 0.2 s to the impact, more another line"
    figure.draw_without_rendering()
    title: Any = figure._suptitle
    token = next(each for each in figure.artists if each.get_gid() == "token" and each.xycoords is title)
    box = token.get_window_extent()
    assert title.get_window_extent().y0 <= box.y0 < box.y1 < title.get_window_extent().y0 + 20


def test_a_paper_and_a_slide_have_their_sizes_and_no_tokens(da: DeepAccident, frame: str) -> None:
    with style("paper"):
        camera = f"{frame.rsplit('/', 1)[0]}/ego_vehicle/004/Camera_Front"
        assert da.render_sample_data(camera).figure.get_figwidth() == 3.5
        figure = da.render_frame(frame)
        assert (figure.get_figwidth(), current_style().dpi) == (7.2, 300)
        assert tokens_of(figure) == []
    with style("slide"):
        assert da.render_frame(frame).get_size_inches() * current_style().dpi == pytest.approx([1920, 1080])
    assert tokens_of(da.render_frame(frame)) == [frame]
    with pytest.raises(ChoiceError, match="style: expected paper or slide, found 'poster'"), style("poster"):  # type: ignore[arg-type]
        pass


FRONT = "ego_vehicle Camera_Front: not downloaded"
POLE = "no LiDAR file of infrastructure"


def grey_panels(figure: Figure) -> int:
    return sum(to_hex(ax.get_facecolor()) == MISSING_COLOR for ax in figure.axes)


def legend_words(ax: Axes) -> list[str]:
    return [text.get_text() for text in ax.get_legend().get_texts()]


VIEWS: list[tuple[Callable[[DeepAccident, str], Any], int, list[str]]] = [
    (lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003"), 1, [FRONT]),
    (lambda da, scenario: da.render_sample(f"{scenario}/ego_vehicle/003", agents="available"), 1, [FRONT, POLE]),
    (lambda da, scenario: da.render_sample(f"{scenario}/infrastructure/003"), 0, [POLE]),
    (lambda da, scenario: da.render_frame(f"{scenario}/003"), 1, [FRONT, POLE]),
    (lambda da, scenario: da.render_calibration(f"{scenario}/003"), 1, [FRONT, POLE]),
    (
        lambda da, scenario: da.render_calibration(f"{scenario}/ego_vehicle/003", agents=["infrastructure"]),
        1,
        [POLE, FRONT],
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


@pytest.mark.parametrize(("view", "grey", "words"), VIEWS)
def test_a_picture_names_what_is_not_there(
    da_partial: DeepAccident,
    scenario: str,
    view: Callable[[DeepAccident, str], Any],
    grey: int,
    words: list[str],
) -> None:
    figure = view(da_partial, scenario).figure
    assert grey_panels(figure) == grey
    assert missing_words(figure) == words


def test_a_whole_release_lacks_nothing(da: DeepAccident, scenario: str) -> None:
    for figure in (da.render_sample(f"{scenario}/ego_vehicle/003", agents="all"), da.render_frame(f"{scenario}/003")):
        assert (grey_panels(figure), missing_words(figure)) == (0, [])


def test_the_legend_has_only_the_agents_whose_points_are_rendered(da_partial: DeepAccident, scenario: str) -> None:
    sample = f"{scenario}/ego_vehicle/003"
    ax = da_partial.render_bev(sample, agents="available")
    assert missing_words(ax) == [POLE]
    assert {"ego", "ego behind", "other"} <= set(legend_words(ax))
    assert "infrastructure" not in legend_words(ax)
    ax = da_partial.render_bev(sample, agents="available", layers=["boxes"])
    assert missing_words(ax) == []
    assert "ego" not in legend_words(ax)


def test_points_of_the_sweeps_that_are_there(da: DeepAccident, own_sweeps: DeepAccident, scenario: str) -> None:
    sample = f"{scenario}/ego_vehicle/003"
    points = [len(one.render_bev(sample, sweeps=3).collections[0].get_offsets()) for one in (own_sweeps, da)]
    assert 0 < points[0] < points[1]
    assert missing_words(own_sweeps.render_bev(f"{scenario}/ego_vehicle/002")) == ["no LiDAR file of ego_vehicle"]


@pytest.fixture
def own_sweeps(da: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> DeepAccident:
    """`da`, opened again, without the ego's second point cloud."""
    opened = DeepAccident("v1", da.dataroot, verbose=False)
    path = opened.sensor_path

    def without_second(sample_data: Any) -> Path:
        found: Path = path(sample_data)
        return found.with_name("gone.npz") if "ego_vehicle/lidar01" in str(found) and "_002" in found.name else found

    monkeypatch.setattr(opened, "sensor_path", without_second)
    return opened


def test_only_nothing_at_all_is_an_error(da_b: DeepAccident, da_partial: DeepAccident, scenario: str) -> None:
    with pytest.raises(MissingFileError, match=r"nothing else to render; unpack .*, or choose other layers"):
        da_partial.render_sample_data(f"{scenario}/ego_vehicle/003/Camera_Front", layers=["image"])
    camera = f"{da_b.sample[0]['token']}/Camera_Front"
    with pytest.raises(MissingFileError, match="no such file, and no LiDAR file of ego_vehicle; unpack the archives"):
        da_b.render_pointcloud_in_image(camera)
    figure = da_b.render_sample(da_b.sample[0])
    assert grey_panels(figure) == 6
    assert {"no LiDAR file of ego_vehicle", "BEV_instance_camera: not downloaded"} <= set(missing_words(figure))


def test_a_box_is_shown_by_a_camera_that_is_there(da: DeepAccident, da_partial: DeepAccident, scenario: str) -> None:
    sample = f"{scenario}/ego_vehicle/003"
    others = []
    for row, box in enumerate(da.get_boxes(sample, "world")):
        if box.actor_id < 0:
            continue
        chosen = [best_view(one, [sample], one.boxes(sample, "world").select([row])) for one in (da, da_partial)]
        if chosen[0] is not None and chosen[0].camera.endswith("Camera_Front"):
            others.append(chosen[1])
            figure = da_partial.render_annotation(f"{sample}/{row}")
            assert grey_panels(figure) == (chosen[1] is not None and chosen[1].camera.endswith("Camera_Front"))
    assert others


@pytest.mark.slow
def test_accident_instance_and_video_are_rendered(da_partial: DeepAccident, scenario: str, tmp_path: Path) -> None:
    figure = da_partial.render_accident(scenario)
    assert set(missing_words(figure)) <= {FRONT}
    other = da_partial.get("agent", f"{scenario}/other_vehicle")["actor_id"]
    assert set(missing_words(da_partial.render_instance(f"{scenario}/actor/{other}"))) <= {FRONT}
    for what in ("accident", ["sample", "Camera_Front"], ["frame", "calibration"]):
        path = tmp_path / "video.gif"
        da_partial.render_scenario_video(scenario, path, what=what, frames=[3], size=(320, 180), workers=1)
        assert path.stat().st_size > 0
    page = da_partial.render_replay(scenario, tmp_path / "replay.html")
    assert page.stat().st_size > 0
