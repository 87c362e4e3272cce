"""Visibility between actors: dots, lines and words agree with the released rule and the labels."""

from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgba
from support.rendered_pixels import ground_colors, read_texts
from support.replay_page import normal_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.styles import AGENT_COLORS, BEV_COLORS
from deepaccident_devkit.render.visibility import (
    render_visibility,
    render_visibility_matrix,
    visibility_of,
)
from deepaccident_devkit.taxonomy import AGENTS


@pytest.fixture(scope="module")
def hidden_da(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """An accident in which a house hides the ego and the other vehicle from each other."""
    root = tmp_path_factory.mktemp("synthetic") / "hidden"
    config = SynthConfig(scenarios=1, frames=15, view="hidden", seed=2, sensors=False)
    make_release(root, config, workers=1)
    return DeepAccident("v1", root, verbose=False)


def draw_panel(
    da: DeepAccident, moment: Any, size: tuple[float, float] = (5, 5.6), **options: Any
) -> Any:
    ax = detached_figure(size).add_subplot()
    assert render_visibility(da, moment, ax=ax, **options) is ax
    return ax


def find_dots(ax: Any) -> dict[str, Any]:
    """Return the dots drawn for each agent."""
    return {shape.get_label(): shape for shape in ax.collections if shape.get_label() in AGENTS}


def test_dots_mark_the_actors_that_are_visible_by_the_rule(hidden_da: DeepAccident) -> None:
    scenario = hidden_da.scenario[0]["token"]
    sample = hidden_da.get_sample(scenario, "other_vehicle", 10)
    dots = find_dots(draw_panel(hidden_da, sample))

    boxes = hidden_da.cooperative_boxes(sample, frame="ego")
    for agent in AGENTS:
        instances = hidden_da.visible_instances(f"{scenario}/{agent}/010", agents=[agent])
        actor_ids = [int(token.rsplit("/", 1)[1]) for token in instances]
        visible = boxes.select(np.isin(boxes.actor_id, actor_ids))
        tops = visible.bottom_corners()[..., 1].max(axis=1)
        expected = np.column_stack([visible.center[:, 0], tops])
        np.testing.assert_allclose(dots[agent].get_offsets(), expected)
    assert to_hex(dots[AGENTS[2]].get_facecolor()[0]) == AGENT_COLORS[AGENTS[2]]


def test_the_hidden_collider_stands_out(hidden_da: DeepAccident) -> None:
    scenario = hidden_da.scenario[0]
    early_sample, late_sample = (
        hidden_da.get_sample(scenario, "ego_vehicle", index) for index in (2, 15)
    )
    visibility = visibility_of(hidden_da, early_sample)
    other_id = hidden_da.get("agent", f"{scenario['token']}/other_vehicle")["actor_id"]
    is_other = visibility.boxes.actor_id == other_id
    assert visibility.hidden_from("ego_vehicle")[is_other].all()

    ax = draw_panel(hidden_da, early_sample)
    assert read_texts(ax) == ["ego cannot see"]
    assert read_texts(draw_panel(hidden_da, late_sample)) == []

    dashed = next(
        shape
        for shape in ax.collections
        if shape.get_linestyle()[0][1] is not None and len(shape.get_paths())
    )
    drawn_corners = np.concatenate([path.vertices[:4] for path in dashed.get_paths()])
    corners = visibility.boxes.select(is_other).bottom_corners()[0, :, None, :2]
    distances = np.linalg.norm(corners - drawn_corners, axis=-1)
    assert distances.min(axis=1).max() < 1e-9


def test_the_caller_chooses_frame_agents_and_layers(hidden_da: DeepAccident) -> None:
    token = f"{hidden_da.scenario[0]['token']}/010"
    frame = hidden_da.get("frame", token)
    ax = draw_panel(hidden_da, frame, agents=["infrastructure", "ego_vehicle"], frame="world")
    assert [*find_dots(ax)] == ["ego_vehicle", "infrastructure"]

    visibility = visibility_of(hidden_da, token)
    assert visibility.sample.endswith("ego_vehicle/010")  # of the first agent in the frame
    ids_only = draw_panel(hidden_da, token, layers=["ids"])
    assert (find_dots(ids_only), len(ids_only.texts)) == ({}, len(visibility.boxes))

    ax = draw_panel(hidden_da, token, view_range=12.0)
    np.testing.assert_allclose(np.diff([ax.get_xlim(), ax.get_ylim()]), 24.0)


def test_the_matrix_has_a_cell_for_each_actor_and_agent(hidden_da: DeepAccident) -> None:
    sample = hidden_da.get_sample(hidden_da.scenario[0], "ego_vehicle", 10)
    ax = detached_figure((5, 7)).add_subplot()
    assert render_visibility_matrix(hidden_da, sample, ax=ax) is ax

    visibility = visibility_of(hidden_da, sample)
    actor_ids = [int(label.get_text().split()[1]) for label in ax.get_yticklabels()]
    assert [actor_id in visibility.pair for actor_id in actor_ids[:3]] == [True, True, False]

    is_filled = np.zeros((len(actor_ids), 5), dtype=bool)
    for cell in ax.patches:
        column, row = np.rint(np.add(cell.get_xy(), (0.3, 0.4))).astype(int).tolist()
        opacity = to_rgba(cell.get_facecolor())[3]
        is_filled[row, column] = opacity > 0
    rows = [visibility.boxes.actor_id.tolist().index(actor_id) for actor_id in actor_ids]
    columns = [visibility.agents.index(agent) for agent in AGENTS]
    np.testing.assert_array_equal(is_filled, visibility.seen[np.ix_(rows, columns)])


def test_two_vehicles_that_see_each_other_have_two_lines(hidden_da: DeepAccident) -> None:
    ax = draw_panel(hidden_da, hidden_da.get_sample(hidden_da.scenario[0], "ego_vehicle", 15))
    lines = next(shape for shape in ax.collections if shape.get_alpha() == 0.8)
    colors = map(to_hex, lines.get_colors())
    lines_by_color = dict(zip(colors, lines.get_segments(), strict=True))

    ego_start, ego_end = lines_by_color[AGENT_COLORS["ego_vehicle"]]
    other_start, other_end = lines_by_color[AGENT_COLORS["other_vehicle"]]
    # a car's box is about its agent, not at it
    np.testing.assert_allclose(ego_end - ego_start, other_start - other_end, atol=0.5)
    assert 0.3 < np.linalg.norm(ego_start - other_end) < 2  # side by side


@pytest.mark.parametrize("index", [5, 15])
def test_no_actor_of_the_view_is_cut(hidden_da: DeepAccident, index: int) -> None:
    sample = hidden_da.get_sample(hidden_da.scenario[0], "ego_vehicle", index)
    ax = draw_panel(hidden_da, sample)
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T

    visibility = visibility_of(hidden_da, sample)
    is_important = visibility.collides | visibility.records
    corners = visibility.boxes.bottom_corners()[is_important, :, :2].reshape(-1, 2)
    assert ((corners > low) & (corners < high)).all()


def test_a_normal_scenario_hides_nothing(da_motion: DeepAccident) -> None:
    scenario = normal_scenario(da_motion)
    sample = da_motion.get_sample(scenario, "ego_vehicle", 5)
    assert read_texts(draw_panel(da_motion, sample)) == []
    assert not visibility_of(da_motion, f"{scenario}/005").hidden_from("ego_vehicle").any()


def test_the_road_is_from_the_bev_camera_nearest_to_the_middle(
    da: DeepAccident, da_motion: DeepAccident
) -> None:
    sample = da.get_sample(da.scenario[0], "ego_vehicle", 3)
    ax = draw_panel(da, sample)
    (road,) = ax.images
    assert BEV_COLORS["road"] in ground_colors(road)
    middle = np.mean(ax.viewLim.get_points(), axis=0)
    ego_from_world = da.world_from(sample, "ego").inverse()
    positions = []
    for agent in AGENTS:
        agent_sample = da.get_sample(da.scenario[0], agent, 3)
        pose = ego_from_world @ da.world_from(agent_sample, "ego")
        positions.append(pose.translation[:2])
    distances = np.abs(np.array(positions) - middle).max(axis=1)
    origin = road.get_transform().transform((0, 0))
    expected = ax.transData.transform(positions[distances.argmin()])
    np.testing.assert_allclose(origin, expected)

    assert len(draw_panel(da, sample, layers=["boxes"]).images) == 0
    without_sensors = da_motion.get_sample(da_motion.scenario[0], "ego_vehicle", 10)
    assert len(draw_panel(da_motion, without_sensors).images) == 0
