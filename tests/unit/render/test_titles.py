"""Titles: what they say of a moment, that nothing of them is cut off, and where the token is."""

from typing import Any

import pytest

from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.titles import set_title


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
