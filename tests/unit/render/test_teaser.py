"""The teaser: its camera, its bars, and what is left out of a partial release."""

import shutil
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from matplotlib.colors import to_hex
from support.figure_texts import find_text_faults
from support.replay_page import accident_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import render_teaser, style
from deepaccident_devkit.render.styles import AGENT_COLORS
from deepaccident_devkit.taxonomy import StyleName, short_name
from deepaccident_devkit.v2x.cooperation import visible_actors

pytestmark = pytest.mark.slow
SECONDS = (0.3, 0.2, 0.0)
MAP = "paths, 0.3 s before the impact"
BARS = "sees the pair (pale: only one)"


def titles_of(figure: Any) -> list[str]:
    return [ax.get_title() for ax in figure.axes]


def agents_of_images(figure: Any) -> list[str]:
    """Return the agents in the names of the cameras, such as `ego behind, front`."""
    words = [text.get_text() for ax in figure.axes[:-2] for text in ax.texts]
    return [name.split(", ")[0] for name in words if ", " in name]


@pytest.fixture(scope="module")
def accident(da: DeepAccident) -> str:
    return accident_scenario(da)


@pytest.mark.parametrize("medium", [None, *get_args(StyleName)])
def test_one_camera_is_shown_at_three_moments_and_texts_are_apart(
    da: DeepAccident, accident: str, medium: Any
) -> None:
    with style(medium):
        figure = render_teaser(da, accident, seconds=SECONDS)

        assert find_text_faults(figure) == []
    *moments, pole, above, bars = titles_of(figure)
    *agents, pole_agent = agents_of_images(figure)
    assert len(set(agents)) == 1
    assert [title[:3] for title in moments[:2]] == ["0.3", "0.2"]
    assert pole == moments[-1] == "at the impact"
    assert pole_agent == "infrastructure"
    assert (above, bars) == (MAP, BARS)


def test_a_bar_is_solid_in_the_frames_in_which_the_agent_sees_the_pair(
    da: DeepAccident, accident: str
) -> None:
    figure = render_teaser(da, accident, agents=["infrastructure"], seconds=[0.0])
    scenario = da.get("scenario", accident)
    count = scenario["num_frames"]

    [bar] = figure.axes[-1].collections
    opacities = np.asarray(bar.get_facecolor())[:, 3]

    expected = []
    for frame in range(1, count + 1):
        sample = f"{accident}/infrastructure/{frame:03d}"
        seen = visible_actors(da, sample, agents=["infrastructure"])
        expected.append(np.isin(scenario["collision"]["ids"], seen).mean() ** 2)
    np.testing.assert_array_equal(opacities, expected)
    assert max(expected) == 1
    assert to_hex(bar.get_facecolor()[0]) == AGENT_COLORS["infrastructure"]


def test_agents_without_images_and_roads_without_pictures_are_left_out(
    da: DeepAccident, accident: str, tmp_path: Path
) -> None:
    """With the pole's images only, they fill the row; without any images, two panels remain."""
    root = tmp_path / "release"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    for folder in [*root.glob("*/*vehicle*/Camera_*"), *root.glob("*/*/BEV_instance_camera")]:
        shutil.rmtree(folder)
    poles = DeepAccident("v1", root, verbose=False)
    figure = render_teaser(poles, accident, seconds=SECONDS)
    *images, above, bars = titles_of(figure)
    assert len(images) == 3
    assert agents_of_images(figure) == [short_name("infrastructure")] * 3
    assert (above, bars) == (MAP, BARS)

    for folder in root.glob("*/*/Camera_*"):
        shutil.rmtree(folder)
    labels_only = DeepAccident("v1", root, verbose=False)
    figure = render_teaser(labels_only, accident, seconds=SECONDS)
    assert titles_of(figure) == [MAP, BARS]
    assert find_text_faults(figure) == []
    alone = render_teaser(labels_only, accident, agents=[], seconds=SECONDS)
    assert titles_of(alone) == [MAP, BARS]
