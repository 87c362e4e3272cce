"""Pictures of motion labels and predictions: what is drawn where, in which colour, and what is
not.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawing import legend_words, new_axes, of_kind, picture, texts, tokens_of
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.quiver import Quiver
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
from deepaccident_devkit.render.motion_maps import MIN_TRAIL_OPACITY
from deepaccident_devkit.render.styles import (
    AGENT_COLORS,
    COLLIDER_COLOR,
    INSTANCE_COLORS,
    OWN_COLOR,
)


def figure_of(labels: MotionLabels, **how: Any) -> Any:
    return draw_motion_labels(labels, fig=detached_figure((8, 8)), **how)


CONFIG = MotionLabelConfig(
    grid=BevGrid(x=(-20, 30, 0.5), y=(-15, 15, 0.5)),
    receptive_field=1,
    future_frames=2,
    protocol="clean",
)
RECTANGLE = np.array([[-2.2, -1.2], [-2.2, 1.2], [2.2, 1.2], [2.2, -1.2]])
STEP = (3.0, 1.5)
"""Metres from frame to frame."""


def two_cars(config: MotionLabelConfig = CONFIG, *, frames: int = 3) -> MotionLabels:
    """The ego, which stands, and car 7, which starts at (10.25, 5.25) and drives on; some frames
    are recorded.
    """
    moments = [
        FramePolygons(
            corners=np.array(
                [RECTANGLE + 0.25, RECTANGLE + (10.25, 5.25) + frame * np.array(STEP)]
            ),
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
    row, column = (
        (y - low) / (high - low) * colors.shape[0],
        (x - left) / (right - left) * colors.shape[1],
    )
    return colors[int(row), int(column)]


def test_instances_are_where_they_are_and_have_their_colours() -> None:
    labels = two_cars()
    ax, later = panel(labels, "instance"), panel(labels, "instance", 2)
    car = color_at(ax, 10.2, 5.2)
    np.testing.assert_allclose(
        [color_at(ax, 0.2, 0.2), color_at(ax, 5, -10)], [to_rgb(OWN_COLOR), (1, 1, 1)]
    )
    assert not np.allclose(car, 1)
    np.testing.assert_allclose(color_at(later, 16.2, 8.2), car)  # the same in all frames
    one, both = (panel(labels, "instance", marked=marked) for marked in ({7}, {7, -100}))
    np.testing.assert_allclose(
        [color_at(one, 10.2, 5.2), color_at(both, 0.2, 0.2)], [to_rgb(COLLIDER_COLOR)] * 2
    )
    assert len(both.collections) == 1  # the own box's edge


def test_recording_vehicles_have_their_hues_and_others_shades_in_the_picture_and_its_key() -> None:
    figure = figure_of(two_cars().to_present(), agents={-100: "ego_vehicle"}, style="trail")
    (ax,) = figure.axes
    np.testing.assert_allclose(color_at(ax, 0.2, 0.2), to_rgb(AGENT_COLORS["ego_vehicle"]))
    assert to_hex(color_at(ax, 10.2, 5.2)) in INSTANCE_COLORS
    assert legend_words(figure) == ["ego", "own box"]


def test_arrows_lead_from_instances_to_where_they_are_next() -> None:
    flow, last, offset = (
        panel(two_cars(), "flow"),
        panel(two_cars(), "flow", 2),
        panel(two_cars(), "offset"),
    )
    (found,) = of_kind(flow, Quiver)
    np.testing.assert_allclose(
        np.column_stack([found.XY, found.U, found.V]), [(0.25, 0.25, 0, 0), (10.25, 5.25, *STEP)]
    )
    assert (
        of_kind(last, Quiver) + of_kind(offset, Quiver) == []
    )  # nothing is known of what comes after the last
    assert len(np.unique(picture(flow).reshape(-1, 3), axis=0)) == 3  # nothing, no way, a way


@pytest.mark.parametrize("name", ["instance", "centerness", "offset", "flow"])
def test_forward_is_to_the_right_in_every_orientation(name: str) -> None:
    def arrows(ax: Any) -> list[list[float]]:
        found = [np.column_stack([each.XY, each.U, each.V]) for each in of_kind(ax, Quiver)]
        return sorted(np.round(np.concatenate(found), 6).tolist()) if found else []

    first, *others = (
        panel(two_cars(replace(CONFIG, orientation=each)), name) for each in ORIENTATIONS
    )
    for other in others:
        np.testing.assert_allclose(picture(other), picture(first))
        assert other.images[0].get_extent() == first.images[0].get_extent() == [-20, 30, -15, 15]
        assert arrows(other) == arrows(first)


@pytest.mark.parametrize("protocol", ["released", "clean"])
def test_frames_beyond_the_recording_are_grey(protocol: str) -> None:
    labels = two_cars(replace(CONFIG, protocol=protocol), frames=2)
    for figure in map(figure_of, (labels, labels.to_present())):
        rows = [figure.axes[row : row + 3] for row in range(0, 16, 4)]
        assert [[len(ax.images) for ax in row] for row in rows] == [[1, 1, 0]] * 4
        assert [texts(beyond) for *_, beyond in rows] == [["not recorded"]] * 4
        figure.canvas.draw()


def test_an_empty_road_is_drawn() -> None:
    nobody = FramePolygons(corners=np.zeros((0, 4, 2)), key=np.zeros(0))
    figure = figure_of(labels_from_polygons([nobody] * 3, np.zeros((3, 6)), CONFIG), marked={7})
    figure.canvas.draw()
    np.testing.assert_array_equal(picture(figure.axes[0]), 1)


def test_a_sample_of_an_accident(da_motion: DeepAccident) -> None:
    accident = next(scenario for scenario in da_motion.scenario if scenario["collision"])
    sample, figure = (
        da_motion.get_sample(accident, "ego_vehicle", frame=15),
        detached_figure((12, 9)),
    )
    assert da_motion.render_motion_labels(sample, fig=figure) is figure
    assert (len(figure.axes), tokens_of(figure)) == (
        4 * (5 + 1),
        [sample["token"]],
    )  # five frames and a key
    labels = da_motion.motion_labels(sample).to_present()
    pair = [
        labels.id_map[OWN_BOX_ID if actor == -100 else actor]
        for actor in collider_ids(da_motion, sample)
    ]
    red = [np.isclose(picture(ax), to_rgb(COLLIDER_COLOR)).all(axis=-1) for ax in figure.axes[:5]]
    np.testing.assert_array_equal(red, np.isin(labels.instance, pair))


def test_what_is_not_there_is_named(labels: MotionLabels) -> None:
    alone = instances_of(labels.instance, labels.config.grid)
    assert_refused(
        (
            lambda: panel(two_cars(), "centre"),
            ChoiceError,
            ("map", "instance, centerness, offset, flow", "'centre'"),
        ),
        (lambda: panel(two_cars(), "flow", -1), ChoiceError, ("frame", "0 to 2", "found -1")),
        (lambda: panel(two_cars(), "flow", 3), ChoiceError, ("frame", "0 to 2", "found 3")),
        (lambda: draw_motion_map(alone, "flow", 0), ChoiceError, ("map", "only instance", "heads")),
        (
            lambda: draw_motion_output(alone, number=1),
            ChoiceError,
            ("prediction", "0 to 0", "found 1"),
        ),
        (
            lambda: draw_motion_output(alone, style="film"),
            ChoiceError,
            ("style", "maps, trail", "'film'"),
        ),
    )


def test_a_trail_is_opaque_at_the_present_and_paler_after(labels: MotionLabels) -> None:
    grid, columns = labels.config.grid, (50, 56, 62)
    instance = np.zeros((3, *grid.shape), dtype=np.int32)
    for frame, column in zip(instance, columns, strict=True):
        frame[100:104, column : column + 8] = 1
    ax = draw_motion_trail(instances_of(instance, grid), marked={1}, ax=new_axes())
    opacity = [1, 1, (1 + MIN_TRAIL_OPACITY) / 2, MIN_TRAIL_OPACITY]  # the present is on top
    expected = 1 - np.outer(opacity, 1 - np.array(to_rgb(COLLIDER_COLOR)))
    np.testing.assert_allclose(picture(ax)[101, [51, 57, 60, 69]], expected)
    np.testing.assert_allclose(picture(ax)[90, 51], 1)
    (path,) = next(
        each for each in ax.collections if isinstance(each, LineCollection)
    ).get_segments()
    np.testing.assert_allclose(path, [(-50 + 0.5 * (column + 4), 1.0) for column in columns])
    none = draw_motion_trail(instances_of(instance, grid), layers=["ids"], ax=new_axes())
    assert (len(none.images), texts(none)) == (0, ["1"])


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_outputs_are_drawn_as_they_lie(labels: MotionLabels, orientation: Any) -> None:
    heads = MotionHeads.from_labels(labels).in_orientation(orientation)
    output = MotionOutput(grid=labels.config.grid.with_orientation(orientation), heads=(heads,))
    shown = picture(draw_motion_map(output, "instance", 0, ax=new_axes()))
    np.testing.assert_array_equal((shown != 1).any(axis=-1), labels.segmentation[0] == 1)
    for name in ("offset", "flow"):
        mine, true = (
            picture(draw_motion_map(each, name, 0, ax=new_axes())) for each in (output, labels)
        )
        np.testing.assert_allclose(mine, true, atol=1e-6)
