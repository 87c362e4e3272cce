"""Pictures of motion labels and predictions: what is drawn where, in which colour, and what is not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawing import new_axes, picture, tokens_of
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.quiver import Quiver
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation import MotionOutput, instances_of
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    FramePolygons,
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    labels_from_polygons,
)
from deepaccident_devkit.render import (
    detached_figure,
    draw_motion_labels,
    draw_motion_map,
    draw_motion_output,
    draw_motion_trail,
)
from deepaccident_devkit.render.boxes import collider_ids
from deepaccident_devkit.render.motion_maps import PALEST
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR, INSTANCE_COLORS, OWN_COLOR

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


def color_at(ax: Any, x: float, y: float) -> Any:
    """The colour of the cell that a point in metres lies in."""
    left, right, low, high = ax.images[0].get_extent()
    colors = picture(ax)
    assert ax.images[0].origin == "lower"
    row, column = (y - low) / (high - low) * colors.shape[0], (x - left) / (right - left) * colors.shape[1]
    return colors[int(row), int(column)]


def arrows(ax: Any) -> list[Quiver]:
    return [one for one in ax.collections if isinstance(one, Quiver)]


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


def test_recording_vehicles_have_their_hues_and_others_shades_in_the_picture_and_its_key() -> None:
    figure = draw_motion_labels(
        two_cars().to_present(), agents={-100: "ego_vehicle"}, style="trail", fig=detached_figure((7, 6))
    )
    ax, key = figure.axes
    assert_allclose(color_at(ax, 0.2, 0.2), to_rgb(AGENT_COLORS["ego_vehicle"]))
    assert to_hex(color_at(ax, 10.2, 5.2)) in INSTANCE_COLORS
    assert [text.get_text() for text in key.get_legend().get_texts()] == ["ego", "own box"]


def test_the_flow_says_where_it_ends() -> None:
    figure = draw_motion_labels(two_cars(), fig=detached_figure((8, 8)))
    said = [[text.get_text() for text in ax.texts] for ax in figure.axes[12:15]]
    assert said == [[], [], ["no next frame"]]


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
    assert tokens_of(figure) == [sample["token"]]
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


def test_a_trail_is_opaque_at_the_present_and_paler_after(labels: MotionLabels) -> None:
    grid, instance = labels.config.grid, np.zeros((3, *labels.config.grid.shape), dtype=np.int32)
    for frame, column in enumerate((50, 56, 62)):
        instance[frame, 100:104, column : column + 8] = 1
    ax = draw_motion_trail(instances_of(instance, grid), marked={1}, ax=new_axes())
    red, cells = np.array(to_rgb(COLLIDER_COLOR)), picture(ax)
    assert_allclose(cells[101, 51], red)
    assert_allclose(cells[101, 57], red)  # the present is on top
    assert_allclose(cells[101, 60], 1 - (1 + PALEST) / 2 * (1 - red))
    assert_allclose(cells[101, 69], 1 - PALEST * (1 - red))
    assert_allclose(cells[90, 51], 1)
    (path,) = next(each for each in ax.collections if isinstance(each, LineCollection)).get_segments()
    assert_allclose(path, [(-50 + 0.5 * (column + 4), 1.0) for column in (50, 56, 62)])
    none = draw_motion_trail(instances_of(instance, grid), layers=["ids"], ax=new_axes())
    assert not none.images
    assert [text.get_text() for text in none.texts] == ["1"]


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_outputs_are_drawn_as_they_lie(labels: MotionLabels, orientation: Any) -> None:
    heads = MotionHeads.from_labels(labels).in_orientation(orientation)
    output = MotionOutput(grid=labels.config.grid.with_orientation(orientation), heads=(heads,))
    ax = draw_motion_map(output, "instance", 0, ax=new_axes())
    assert_array_equal((picture(ax) != 1).any(axis=-1), labels.segmentation[0] == 1)
    for name in ("offset", "flow"):
        mine = picture(draw_motion_map(output, name, 0, ax=new_axes()))
        assert_allclose(mine, picture(draw_motion_map(labels, name, 0, ax=new_axes())), atol=1e-6)


def test_outputs_have_the_rows_that_they_have(labels: MotionLabels) -> None:
    output = MotionOutput(grid=labels.config.grid, heads=(MotionHeads.from_labels(labels),))
    figure = draw_motion_output(output, fig=detached_figure((10, 8)))
    assert len(figure.axes) == 4 * (5 + 1)
    alone = instances_of(labels.instance, labels.config.grid)
    assert len(draw_motion_output(alone, fig=detached_figure((10, 3))).axes) == 5 + 1
    assert len(draw_motion_output(alone, style="trail", fig=detached_figure((6, 5))).axes) == 2
    assert_refused(
        (
            lambda: draw_motion_map(alone, "flow", 0, ax=new_axes()),
            ChoiceError,
            "map: this prediction has only instance, not flow; give heads for it",
        ),
        (
            lambda: draw_motion_output(alone, number=1),
            ChoiceError,
            "prediction: expected a number from 0 to 0, or from the end, found 1",
        ),
        (
            lambda: draw_motion_output(alone, style="film"),
            ChoiceError,
            "style: expected one of maps, trail, found 'film'",
        ),
    )


def test_labels_as_a_trail(da_motion: DeepAccident, sample: str) -> None:
    figure = da_motion.render_motion_labels(sample, style="trail", fig=detached_figure((6, 6)))
    assert len(figure.axes) == 2
    assert tokens_of(figure) == [sample]
