"""Pictures of motion labels and predictions: what is drawn where and in which colour."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.quiver import Quiver
from support.expected_errors import assert_raises
from support.rendered_pixels import (
    collections_of_kind,
    first_image,
    ground_colors,
    new_axes,
    read_legend,
    read_texts,
    read_tokens,
)
from support.replay_page import accident_scenario

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
    BEV_COLORS,
    COLLIDER_COLOR,
    INSTANCE_COLORS,
    OWN_COLOR,
)


def draw_labels(labels: MotionLabels, **options: Any) -> Any:
    return draw_motion_labels(labels, fig=detached_figure((8, 8)), **options)


CONFIG = MotionLabelConfig(
    grid=BevGrid(x=(-20, 30, 0.5), y=(-15, 15, 0.5)),
    receptive_field=1,
    future_frames=2,
    protocol="clean",
)
RECTANGLE = np.array([[-2.2, -1.2], [-2.2, 1.2], [2.2, 1.2], [2.2, -1.2]])
STEP_M = (3.0, 1.5)  # from frame to frame


def make_labels(config: MotionLabelConfig = CONFIG, *, num_recorded: int = 3) -> MotionLabels:
    """Make labels of three frames, with the ego, which stands still, and car 7, which starts at
    (10.25, 5.25) m and moves by `STEP_M`; only the first frames are recorded.
    """
    ego_corners = RECTANGLE + 0.25
    frames: list[FramePolygons | None] = [None] * 3
    for frame in range(num_recorded):
        car_corners = RECTANGLE + (10.25, 5.25) + frame * np.array(STEP_M)
        frames[frame] = FramePolygons(
            corners=np.array([ego_corners, car_corners]),
            key=np.array([OWN_BOX_ID, 7]),
        )
    return labels_from_polygons(frames, np.zeros((3, 6)), config)


def draw_map(labels: MotionLabels, name: Any, frame: int = 0, **options: Any) -> Any:
    ax = detached_figure((4, 4)).add_subplot()
    assert draw_motion_map(labels, name, frame, ax=ax, **options) is ax
    return ax


def color_at(ax: Any, x: float, y: float) -> Any:
    """Return the colour of the cell that a point, in metres, lies in."""
    left, right, low, high = ax.images[0].get_extent()
    assert ax.images[0].origin == "lower"
    colors = first_image(ax)
    num_rows, num_columns = colors.shape[:2]
    row = (y - low) / (high - low) * num_rows
    column = (x - left) / (right - left) * num_columns
    return colors[int(row), int(column)]


def read_arrows(ax: Any) -> list[list[float]]:
    """Return start and extent (x, y, dx, dy) of the arrows, to a micrometre, in order."""
    rows: list[list[float]] = []
    for arrows in collections_of_kind(ax, Quiver):
        rows += np.column_stack([arrows.XY, arrows.U, arrows.V]).round(6).tolist()
    return sorted(rows)


def test_instances_are_where_they_are_and_have_their_colours() -> None:
    labels = make_labels()
    ax = draw_map(labels, "instance")
    car_color = color_at(ax, 10.2, 5.2)
    np.testing.assert_allclose(color_at(ax, 0.2, 0.2), to_rgb(OWN_COLOR))
    np.testing.assert_allclose(color_at(ax, 5, -10), (1, 1, 1))
    assert not np.allclose(car_color, 1)

    later_ax = draw_map(labels, "instance", 2)
    np.testing.assert_allclose(color_at(later_ax, 16.2, 8.2), car_color)  # the same in all frames

    car_marked, both_marked = (
        draw_map(labels, "instance", marked=marked) for marked in ({7}, {7, -100})
    )
    np.testing.assert_allclose(color_at(car_marked, 10.2, 5.2), to_rgb(COLLIDER_COLOR))
    np.testing.assert_allclose(color_at(both_marked, 0.2, 0.2), to_rgb(COLLIDER_COLOR))
    assert len(both_marked.collections) == 1  # the own box's edge


def test_recording_vehicles_have_their_hues_and_others_shades_in_the_picture_and_its_key() -> None:
    figure = draw_labels(make_labels().to_present(), agents={-100: "ego_vehicle"}, style="trail")
    (ax,) = figure.axes
    np.testing.assert_allclose(color_at(ax, 0.2, 0.2), to_rgb(AGENT_COLORS["ego_vehicle"]))
    assert to_hex(color_at(ax, 10.2, 5.2)) in INSTANCE_COLORS
    assert read_legend(figure) == [
        "ego",
        "own vehicle",
        "others now",
        "in 1 s",
        "every 0.5 s",
    ]


def test_arrows_lead_from_instances_to_where_they_are_next() -> None:
    labels = make_labels()
    flow = draw_map(labels, "flow")
    (arrows,) = collections_of_kind(flow, Quiver)
    np.testing.assert_allclose(
        np.column_stack([arrows.XY, arrows.U, arrows.V]),
        [(0.25, 0.25, 0, 0), (10.25, 5.25, *STEP_M)],
    )
    num_colors = len(np.unique(first_image(flow).reshape(-1, 3), axis=0))
    assert num_colors == 3  # empty cells, an instance that stands still, one that moves

    last_flow = draw_map(labels, "flow", 2)  # nothing is known about the time after it
    assert collections_of_kind(last_flow, Quiver) == []
    assert collections_of_kind(draw_map(labels, "offset"), Quiver) == []


@pytest.mark.parametrize("name", ["instance", "centerness", "offset", "flow"])
def test_forward_is_to_the_right_in_every_orientation(name: str) -> None:
    first, *other_axes = (
        draw_map(make_labels(replace(CONFIG, orientation=orientation)), name)
        for orientation in ORIENTATIONS
    )
    for ax in other_axes:
        np.testing.assert_allclose(first_image(ax), first_image(first))
        assert ax.images[0].get_extent() == first.images[0].get_extent() == [-20, 30, -15, 15]
        assert read_arrows(ax) == read_arrows(first)


@pytest.mark.parametrize("protocol", ["released", "clean"])
def test_frames_beyond_the_recording_are_grey(protocol: str) -> None:
    labels = make_labels(replace(CONFIG, protocol=protocol), num_recorded=2)
    for figure in (draw_labels(labels), draw_labels(labels.to_present())):
        for row in range(0, 16, 4):
            first, second, unrecorded = figure.axes[row : row + 3]
            assert [len(ax.images) for ax in (first, second, unrecorded)] == [1, 1, 0]
            assert read_texts(unrecorded) == ["not recorded"]
        figure.canvas.draw()


def test_an_empty_road_is_drawn() -> None:
    empty = FramePolygons(corners=np.zeros((0, 4, 2)), key=np.zeros(0))
    labels = labels_from_polygons([empty] * 3, np.zeros((3, 6)), CONFIG)
    figure = draw_labels(labels, marked={7})
    figure.canvas.draw()
    np.testing.assert_array_equal(first_image(figure.axes[0]), 1)


def test_a_sample_of_an_accident(da_motion: DeepAccident) -> None:
    sample = da_motion.get_sample(accident_scenario(da_motion), "ego_vehicle", frame=15)
    figure = detached_figure((12, 9))
    assert da_motion.render_motion_labels(sample, fig=figure) is figure
    assert len(figure.axes) == 4 * (5 + 1)  # five frames and a key
    assert read_tokens(figure) == [sample["token"]]

    labels = da_motion.motion_labels(sample).to_present()
    pair = [
        labels.id_map[OWN_BOX_ID if actor_id == -100 else actor_id]
        for actor_id in collider_ids(da_motion, sample)
    ]
    pictures = np.stack([first_image(ax) for ax in figure.axes[:5]])
    are_red = np.isclose(pictures[..., :3], to_rgb(COLLIDER_COLOR)).all(axis=-1)
    np.testing.assert_array_equal(are_red, np.isin(labels.instance, pair))
    np.testing.assert_array_equal(pictures[..., 3], labels.instance > 0)


@pytest.mark.parametrize("style", ["maps", "trail"])
def test_the_road_is_beneath_instances(da: DeepAccident, style: Any) -> None:
    sample = da.get_sample(da.scenario[0], "ego_vehicle", frame=3)
    figure = detached_figure((12, 9))
    da.render_motion_labels(sample, style=style, fig=figure)
    cells, road = figure.axes[0].images
    assert road.get_zorder() < cells.get_zorder()
    assert BEV_COLORS["road"] in ground_colors(road)
    assert {len(ax.images) for ax in figure.axes[6:]} <= {0, 1}  # the other maps have none

    figure = detached_figure((12, 9))
    da.render_motion_labels(sample, style=style, layers=["labels"], fig=figure)
    assert len(figure.axes[0].images) == 1


def test_unknown_maps_frames_and_predictions_are_refused(labels: MotionLabels) -> None:
    instances = instances_of(labels.instance, labels.config.grid)
    assert_raises(
        (
            lambda: draw_map(make_labels(), "centre"),
            ChoiceError,
            ("map", "instance, centerness, offset, flow", "'centre'"),
        ),
        (
            lambda: draw_map(make_labels(), "flow", -1),
            ChoiceError,
            ("frame", "0 to 2", "found -1"),
        ),
        (
            lambda: draw_map(make_labels(), "flow", 3),
            ChoiceError,
            ("frame", "0 to 2", "found 3"),
        ),
        (
            lambda: draw_motion_map(instances, "flow", 0),
            ChoiceError,
            ("map", "only instance", "heads"),
        ),
        (
            lambda: draw_motion_output(instances, number=1),
            ChoiceError,
            ("prediction", "0 to 0", "found 1"),
        ),
        (
            lambda: draw_motion_output(instances, style="film"),
            ChoiceError,
            ("style", "maps, trail", "'film'"),
        ),
    )


def test_a_trail_is_opaque_at_the_present_and_paler_after(labels: MotionLabels) -> None:
    grid = labels.config.grid
    columns = (50, 56, 62)
    instance = np.zeros((3, *grid.shape), dtype=np.int32)
    for frame, column in zip(instance, columns, strict=True):
        frame[100:104, column : column + 8] = 1
    instances = instances_of(instance, grid)

    ax = draw_motion_trail(instances, marked={1}, ax=new_axes())

    opacity = [1, 1, (1 + MIN_TRAIL_OPACITY) / 2, MIN_TRAIL_OPACITY]  # the present is on top
    expected_colors = 1 - np.outer(opacity, 1 - np.array(to_rgb(COLLIDER_COLOR)))
    image = first_image(ax)
    np.testing.assert_allclose(image[101, [51, 57, 60, 69]], expected_colors)
    np.testing.assert_allclose(image[90, 51], 1)
    lines = next(shape for shape in ax.collections if isinstance(shape, LineCollection))
    (path,) = lines.get_segments()
    np.testing.assert_allclose(path, [(-50 + 0.5 * (column + 4), 1.0) for column in columns])

    ids_only = draw_motion_trail(instances, layers=["ids"], ax=new_axes())
    assert (len(ids_only.images), read_texts(ids_only)) == (0, ["1"])


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_outputs_are_drawn_like_labels_in_every_orientation(
    labels: MotionLabels, orientation: Any
) -> None:
    heads = MotionHeads.from_labels(labels).in_orientation(orientation)
    output = MotionOutput(grid=labels.config.grid.with_orientation(orientation), heads=(heads,))
    instance_image = first_image(draw_motion_map(output, "instance", 0, ax=new_axes()))

    np.testing.assert_array_equal((instance_image != 1).any(axis=-1), labels.segmentation[0] == 1)
    for name in ("offset", "flow"):
        output_image, label_image = (
            first_image(draw_motion_map(motion, name, 0, ax=new_axes()))
            for motion in (output, labels)
        )
        np.testing.assert_allclose(output_image, label_image, atol=1e-6)
