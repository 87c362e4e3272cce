"""Who sees whom: dots, lines and words are where the released rule and the labels put them."""

from typing import Any

import numpy as np
import pytest
from drawing import texts
from matplotlib.colors import to_hex, to_rgba

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.styles import AGENT_COLORS
from deepaccident_devkit.render.visibility import (
    render_visibility,
    render_visibility_matrix,
    visibility_of,
)
from deepaccident_devkit.taxonomy import AGENTS


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """An accident whose ego and other are hidden from each other behind a house until late."""
    root = tmp_path_factory.mktemp("synthetic") / "hidden"
    make_release(
        root, SynthConfig(scenarios=1, frames=15, view="hidden", seed=2, sensors=False), workers=1
    )
    return DeepAccident("v1", root, verbose=False)


def panel(da: DeepAccident, moment: Any, size: tuple[float, float] = (5, 5.6), **how: Any) -> Any:
    ax = detached_figure(size).add_subplot()
    assert render_visibility(da, moment, ax=ax, **how) is ax
    return ax


def dots(ax: Any) -> dict[str, Any]:
    """Agent → (n, 2) the places that have its dot."""
    return {
        each.get_label(): each.get_offsets()
        for each in ax.collections
        if each.get_label() in AGENTS
    }


def lines_of(ax: Any) -> Any:
    """The lines between who sees and who is seen."""
    return next(each for each in ax.collections if each.get_alpha() == 0.8)


def test_dots_are_at_who_is_visible_by_the_rule(hidden: DeepAccident) -> None:
    scenario = hidden.scenario[0]["token"]
    sample = hidden.get_sample(scenario, "other_vehicle", 10)
    ax, boxes = panel(hidden, sample), hidden.cooperative_boxes(sample, frame="ego")
    for agent in AGENTS:
        seen = hidden.visible_instances(f"{scenario}/{agent}/010", agents=[agent])
        known = boxes.select(
            np.isin(boxes.actor_id, [int(token.rsplit("/", 1)[1]) for token in seen])
        )
        tops = known.bottom_corners()[..., 1].max(axis=1)
        np.testing.assert_allclose(dots(ax)[agent], np.column_stack([known.center[:, 0], tops]))
    (other,) = (each for each in ax.collections if each.get_label() == AGENTS[2])
    assert to_hex(other.get_facecolor()[0]) == AGENT_COLORS[AGENTS[2]]


def test_the_hidden_collider_stands_out(hidden: DeepAccident) -> None:
    scenario = hidden.scenario[0]
    known = visibility_of(hidden, hidden.get_sample(scenario, "ego_vehicle", 2))
    other = (
        known.boxes.actor_id
        == hidden.get("agent", f"{scenario['token']}/other_vehicle")["actor_id"]
    )
    assert known.hidden_from("ego_vehicle")[other].all()
    ax, later = (
        panel(hidden, known.sample),
        panel(hidden, hidden.get_sample(scenario, "ego_vehicle", 15)),
    )
    assert (texts(ax), texts(later)) == (["ego cannot see"], [])
    dashed = next(
        each
        for each in ax.collections
        if each.get_linestyle()[0][1] is not None and len(each.get_paths())
    )
    corners = np.concatenate([path.vertices[:4] for path in dashed.get_paths()])
    apart = known.boxes.select(other).bottom_corners()[0, :, None, :2] - corners
    assert np.linalg.norm(apart, axis=-1).min(axis=1).max() < 1e-9


def test_frames_agents_and_layers_are_the_callers(hidden: DeepAccident) -> None:
    token = f"{hidden.scenario[0]['token']}/010"
    ax = panel(
        hidden, hidden.get("frame", token), agents=["infrastructure", "ego_vehicle"], frame="world"
    )
    assert [*dots(ax)] == ["ego_vehicle", "infrastructure"]
    assert visibility_of(hidden, token).sample.endswith("ego_vehicle/010")  # the first agent there
    bare, wide = panel(hidden, token, layers=["ids"]), panel(hidden, token, view_range=12.0)
    assert (dots(bare), len(bare.texts)) == ({}, len(visibility_of(hidden, token).boxes))
    np.testing.assert_allclose(np.diff([wide.get_xlim(), wide.get_ylim()]), 24.0)


def test_the_matrix_has_a_cell_for_each_actor_and_agent(hidden: DeepAccident) -> None:
    sample = hidden.get_sample(hidden.scenario[0], "ego_vehicle", 10)
    known, ax = visibility_of(hidden, sample), detached_figure((5, 7)).add_subplot()
    assert render_visibility_matrix(hidden, sample, ax=ax) is ax
    actors = [int(label.get_text().split()[1]) for label in ax.get_yticklabels()]
    assert [actor in known.pair for actor in actors[:3]] == [True, True, False]
    full = np.zeros((len(actors), 5), dtype=bool)
    for each in ax.patches:
        column, row = np.rint(np.add(each.get_xy(), (0.3, 0.4))).astype(int).tolist()
        full[row, column] = to_rgba(each.get_facecolor())[3] > 0
    rows = [known.boxes.actor_id.tolist().index(actor) for actor in actors]
    order = [known.agents.index(agent) for agent in AGENTS]
    np.testing.assert_array_equal(full, known.seen[np.ix_(rows, order)])


def test_two_that_see_each_other_have_two_lines(hidden: DeepAccident) -> None:
    ax = panel(hidden, hidden.get_sample(hidden.scenario[0], "ego_vehicle", 15))
    lines = lines_of(ax)
    ways = {
        to_hex(color): line
        for color, line in zip(lines.get_colors(), lines.get_segments(), strict=True)
    }
    out, back = ways[AGENT_COLORS["ego_vehicle"]], ways[AGENT_COLORS["other_vehicle"]]
    np.testing.assert_allclose(
        out[1] - out[0], back[0] - back[1], atol=0.5
    )  # a car's box is about its agent, not at it
    assert 0.3 < np.linalg.norm(out[0] - back[1]) < 2  # side by side


@pytest.mark.parametrize("index", [5, 15])
def test_no_actor_of_the_view_is_cut(hidden: DeepAccident, index: int) -> None:
    sample = hidden.get_sample(hidden.scenario[0], "ego_vehicle", index)
    ax, known = panel(hidden, sample), visibility_of(hidden, sample)
    low, high = np.array([ax.get_xlim(), ax.get_ylim()]).T
    corners = known.boxes.bottom_corners()[known.collides | known.records, :, :2].reshape(-1, 2)
    assert ((corners > low) & (corners < high)).all()


def test_a_normal_scenario_hides_nothing(da_motion: DeepAccident) -> None:
    normal = next(scenario for scenario in da_motion.scenario if not scenario["collision"])
    assert texts(panel(da_motion, da_motion.get_sample(normal, "ego_vehicle", 5))) == []
    assert not visibility_of(da_motion, f"{normal['token']}/005").hidden_from("ego_vehicle").any()
