"""Pictures of motion labels: what is drawn where, in which colour, and what is not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.quiver import Quiver
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    FramePolygons,
    MotionLabelConfig,
    MotionLabels,
    labels_from_polygons,
)
from deepaccident_devkit.render import detached_figure, draw_motion_labels, draw_motion_map
from deepaccident_devkit.render.colors import COLLIDER_COLOR, OWN_COLOR
from deepaccident_devkit.render.roles import collider_ids

CONFIG = MotionLabelConfig(
    grid=BevGrid(x=(-20, 30, 0.5), y=(-15, 15, 0.5)), receptive_field=1, future_frames=2, protocol="clean"
)
RECTANGLE = np.array([[-2.2, -1.2], [-2.2, 1.2], [2.2, 1.2], [2.2, -1.2]])
STEP = (3.0, 1.5)
"""Metres from frame to frame."""


def two_cars(config: MotionLabelConfig = CONFIG, *, frames: int = 3) -> MotionLabels:
    """The ego, which stands, and car 7, which starts at (10.25, 5.25) and drives on; some frames are recorded."""
    moments = [
        FramePolygons(
            corners=np.array([RECTANGLE + 0.25, RECTANGLE + (10.25, 5.25) + frame * np.array(STEP)]),
            key=np.array([OWN_BOX_ID, 7]),
        )
        for frame in range(frames)
    ]
    return labels_from_polygons([*moments, *[None] * (3 - frames)], np.zeros((3, 6)), config)


def panel(labels: MotionLabels, name: Any, frame: int = 0, **how: Any) -> Any:
    ax = detached_figure((4, 4)).add_subplot()
    assert draw_motion_map(labels, name, frame, ax=ax, **how) is ax
    return ax


def picture(ax: Any) -> Any:
    return np.asarray(ax.images[0].get_array())


def arrows(ax: Any) -> list[Quiver]:
    return [one for one in ax.collections if isinstance(one, Quiver)]


def color_at(ax: Any, x: float, y: float) -> Any:
    """The colour of the cell that a point in metres lies in."""
    left, right, low, high = ax.images[0].get_extent()
    colors = picture(ax)
    assert ax.images[0].origin == "lower"
    row, column = (y - low) / (high - low) * colors.shape[0], (x - left) / (right - left) * colors.shape[1]
    return colors[int(row), int(column)]


def test_instances_are_where_they_are_and_have_their_colours() -> None:
    labels = two_cars()
    ax = panel(labels, "instance")
    assert_allclose(color_at(ax, 0.2, 0.2), to_rgb(OWN_COLOR))
    assert_allclose(color_at(ax, 5, -10), (1, 1, 1))
    car = color_at(ax, 10.2, 5.2)
    assert not np.allclose(car, 1)
    assert_allclose(color_at(panel(labels, "instance", 2), 16.2, 8.2), car)  # the same in all frames
    assert_allclose(color_at(panel(labels, "instance", marked={7}), 10.2, 5.2), to_rgb(COLLIDER_COLOR))
    both = panel(labels, "instance", marked={7, -100})
    assert_allclose(color_at(both, 0.2, 0.2), to_rgb(COLLIDER_COLOR))
    assert len(both.collections) == 1  # the own box's edge


def test_arrows_lead_from_instances_to_where_they_are_next() -> None:
    (found,) = arrows(panel(two_cars(), "flow"))
    assert_allclose(found.XY, [(0.25, 0.25), (10.25, 5.25)])
    assert_allclose(np.column_stack([found.U, found.V]), [(0, 0), STEP])
    assert arrows(panel(two_cars(), "flow", 2)) == []  # nothing is known of what comes after
    assert arrows(panel(two_cars(), "offset")) == []
    assert len(np.unique(picture(panel(two_cars(), "flow")).reshape(-1, 3), axis=0)) == 3  # nothing, no way, a way


@pytest.mark.parametrize("name", ["instance", "centerness", "offset", "flow"])
def test_forward_is_to_the_right_in_every_orientation(name: str) -> None:
    drawn = [panel(two_cars(replace(CONFIG, orientation=orientation)), name) for orientation in ORIENTATIONS]
    for other in drawn[1:]:
        assert_allclose(picture(other), picture(drawn[0]))
        assert other.images[0].get_extent() == drawn[0].images[0].get_extent() == [-20, 30, -15, 15]
        for one, same in zip(arrows(other), arrows(drawn[0]), strict=True):
            order, as_before = np.lexsort(one.XY.T), np.lexsort(same.XY.T)
            assert_allclose(one.XY[order], same.XY[as_before])
            assert_allclose(np.stack([one.U, one.V])[:, order], np.stack([same.U, same.V])[:, as_before])


@pytest.mark.parametrize("protocol", ["released", "clean"])
def test_frames_beyond_the_recording_are_grey(protocol: str) -> None:
    labels = two_cars(replace(CONFIG, protocol=protocol), frames=2)
    for shown in (labels, labels.to_present()):
        figure = draw_motion_labels(shown, fig=detached_figure((8, 8)))
        for row in range(4):
            present, following, beyond = figure.axes[row * 4 : row * 4 + 3]
            assert [len(ax.images) for ax in (present, following, beyond)] == [1, 1, 0]
            assert [text.get_text() for text in beyond.texts] == ["not recorded"]
        figure.canvas.draw()


def test_an_empty_road_is_drawn() -> None:
    nobody = FramePolygons(corners=np.zeros((0, 4, 2)), key=np.zeros(0))
    labels = labels_from_polygons([nobody] * 3, np.zeros((3, 6)), CONFIG)
    figure = draw_motion_labels(labels, marked={7}, fig=detached_figure((8, 8)))
    figure.canvas.draw()
    assert_array_equal(picture(figure.axes[0]), 1)


def test_a_sample_of_an_accident(da_motion: DeepAccident) -> None:
    accident = next(scenario for scenario in da_motion.scenario if scenario["collision"])
    sample = da_motion.get_sample(accident, "ego_vehicle", frame=15)
    figure = detached_figure((12, 9))
    assert da_motion.render_motion_labels(sample, fig=figure) is figure
    assert len(figure.axes) == 4 * (5 + 1)  # five frames and a key
    assert figure.get_suptitle() == sample["token"]
    assert [ax.get_title() for ax in figure.axes[:5]] == ["present", "+0.5 s", "+1.0 s", "+1.5 s", "+2.0 s"]
    labels = da_motion.motion_labels(sample).to_present()
    pair = [labels.id_map[OWN_BOX_ID if actor == -100 else actor] for actor in collider_ids(da_motion, sample)]
    assert len(pair) == 2
    for frame, ax in enumerate(figure.axes[:5]):
        red = np.isclose(picture(ax), to_rgb(COLLIDER_COLOR)).all(axis=-1)
        assert_array_equal(red, np.isin(labels.instance[frame], pair))
    own = da_motion.render_motion_labels(sample["token"], at_present=False)  # a new figure
    assert own is not figure
    assert own.get_supxlabel() == "x forward (m), in each frame's own ego frame"


def test_what_is_not_there_is_named() -> None:
    with pytest.raises(ChoiceError, match="map: expected one of instance, centerness, offset, flow, found 'centre'"):
        panel(two_cars(), "centre")
    for frame in (-1, 3):
        with pytest.raises(ChoiceError, match=f"frame: expected 0 to 2, found {frame}"):
            panel(two_cars(), "flow", frame)
