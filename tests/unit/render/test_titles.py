"""Titles: what they say of a moment, that nothing of them is cut off, and where the token is."""

from typing import Any

import pytest
from drawing import title_of, tokens_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.captions import moment_words, scene_words, set_scene_title, set_title
from deepaccident_devkit.render.styles import current_style


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
