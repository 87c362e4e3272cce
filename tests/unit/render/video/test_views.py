"""The views of a video: each as the figure that it is, and side by side."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot as plt
from video_views import STEP, grey

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.camera import CAMERA_DEFAULT, draw_camera
from deepaccident_devkit.render.video import VIEWS, Scene, names_at, views_of
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS


@pytest.mark.slow
def test_views_side_by_side_have_their_shares_of_the_width(da: DeepAccident, accident: str) -> None:
    frame = f"{accident}/004"
    views = views_of(["bev", "frame", grey], None)
    picture = Scene(dataset=da, views=views, agents=None, width=400, height=90).picture(frame)
    assert picture.shape == (90, 400, 3)
    assert VIEWS["frame"].share == 2
    assert (picture[:, 300:] == 4 * STEP).all()
    assert (picture[:, 299] != 4 * STEP).all()
    assert (picture[:, :100] != 255).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(VIEWS) - set(CAMERAS[1:])))
def test_every_view_draws(da: DeepAccident, accident: str, name: str) -> None:
    scene = Scene(dataset=da, views=views_of(name, None), agents=None, width=320, height=180)
    picture = scene.picture(f"{accident}/003")
    assert picture.shape == (180, 320, 3)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert not plt.get_fignums()


def test_a_camera_is_the_one_of_the_first_agent_named(da: DeepAccident, accident: str) -> None:
    frame, names = f"{accident}/003", ["other_vehicle", "ego_vehicle"]
    assert names_at(da, frame, names) == ("other_vehicle", "ego_vehicle")
    assert names_at(da, frame, None) == AGENTS
    assert names_at(da, frame, "+other") == ("ego_vehicle", "other_vehicle")
    scene = Scene(dataset=da, views=views_of("Camera_Back", None), agents=names, width=320, height=180)

    def draw(dataset: Any, record: Any, fig: Any) -> None:
        camera = dataset.get("sample_data", f"{accident}/other_vehicle/003/Camera_Back")
        draw_camera(dataset, camera, CAMERA_DEFAULT, fig.add_subplot())

    own = Scene(dataset=da, views=views_of(draw, None), agents=None, width=320, height=180)
    np.testing.assert_array_equal(scene.picture(frame), own.picture(frame))


def test_each_view_draws_those_of_the_layers_that_it_has() -> None:
    chosen = [layers for _, layers in views_of(["Camera_Front", "bev", "visibility_matrix"], ["image", "boxes"])]
    assert chosen == [("image", "boxes"), ("boxes",), ()]
    assert [layers for _, layers in views_of(["Camera_Front", "bev"], None)] == [None, None]


@pytest.mark.slow
@pytest.mark.parametrize("what", [("frame", "visibility", "bev"), ("frame", "sample", "labels")])
def test_words_keep_their_room_beside_other_views(da: DeepAccident, accident: str, what: tuple[str, ...]) -> None:
    """Nothing is written over a view's left or right edge; matplotlib warns, which is an error here, if it gives up."""
    scene = Scene(dataset=da, views=views_of(what, None), agents=None, width=1280, height=720)
    picture, total = scene.picture(f"{accident}/002").astype(int), sum(VIEWS[name].share for name in what)
    edges = np.cumsum([0, *(VIEWS[name].share for name in what)]) * 1280 // total
    for left, right in pairwise(edges.tolist()):
        assert (picture[:, [left, right - 1]] > 250).all()
