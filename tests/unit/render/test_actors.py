"""One box: large from above, in a camera and in words."""

from typing import Any

import numpy as np
import pytest
from drawing import of_kind, texts, tokens_of
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, render_annotation, render_instance
from deepaccident_devkit.render.actors import sightings
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, short_name
from deepaccident_devkit.v2x import visible_instances


def test_an_annotation_is_shown_large_from_above_and_in_words(da: DeepAccident, frame: str) -> None:
    scenario = frame.rsplit("/", 1)[0]
    sample, ego = (
        f"{scenario}/ego_vehicle_behind/004",
        da.get("agent", f"{scenario}/ego_vehicle")["actor_id"],
    )
    boxes = da.boxes(sample, "ego")
    row = boxes.actor_id.tolist().index(ego)
    camera, above, words = render_annotation(
        da, f"{sample}/{row}", margin=8, fig=detached_figure((10, 5))
    ).axes
    assert camera.get_title() == "front"
    np.testing.assert_allclose(
        np.mean([above.get_xlim(), above.get_ylim()], axis=1), boxes.center[row, :2], atol=1e-9
    )
    assert np.ptp(above.get_xlim()) == pytest.approx(16)
    length, width, height = boxes.size[row]
    assert not lacking(
        "\n".join(texts(words)),
        f"category: {boxes.category_names[row]}",
        f"label id: {ego}",
        f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        f"speed: {np.linalg.norm(boxes.velocity[row]):.1f} m/s",
        f"distance: {np.linalg.norm(boxes.center[row, :2]):.1f} m from the agent",
        f"LiDAR points: {boxes.num_lidar_pts[row]}",
        "impact: in 0.2 s, with this actor",
        "annotated by: ego, ego behind",
    )


def test_an_agent_s_own_box_is_in_none_of_its_cameras(da: DeepAccident, frame: str) -> None:
    sample = f"{frame.rsplit('/', 1)[0]}/ego_vehicle/004"
    own = da.boxes(sample, "lidar").actor_id.tolist().index(OWN_ACTOR_ID)
    fig = render_annotation(da, f"{sample}/{own}", fig=detached_figure((10, 5)))
    assert texts(fig.axes[0]) == ["in no image of its agent's cameras"]


VIEWS = ("first", "second", "third", "fourth")


def drawn(da: DeepAccident, instance: str, **how: Any) -> dict[str, Any]:
    """The panels by name."""
    fig = render_instance(da, instance, fig=detached_figure((14, 8.5)), **how)
    assert tokens_of(fig) == [instance]
    return dict(zip(("path", *VIEWS, "speed", "points", "seen"), fig.axes, strict=True))


def test_the_path_is_where_all_agents_labels_have_the_actor(da: DeepAccident, other: str) -> None:
    path, centers = drawn(da, other)["path"], da.trajectory(other).center[:, :2]
    line, star = of_kind(path, LineCollection)[0], of_kind(path, PathCollection)[0]
    np.testing.assert_allclose(
        line.get_segments(), np.stack([centers[:-1], centers[1:]], axis=1)[::-1, ::-1]
    )
    assert to_hex(line.get_color()[0]) == COLLIDER_COLOR
    np.testing.assert_allclose(star.get_offsets(), centers[-1:])
    low, high = np.array([path.get_xlim(), path.get_ylim()]).T
    assert ((low < centers) & (centers < high)).all()


def test_speed_and_points_are_drawn_over_time(da: DeepAccident, other: str) -> None:
    panels, track = drawn(da, other), da.trajectory(other)
    speeds = np.linalg.norm(track.velocity, axis=1)
    np.testing.assert_allclose(
        panels["speed"].lines[0].get_xydata(), np.column_stack([track.timestamp, speeds])
    )
    scenario, actor = other.split("/actor/")
    ego = next(line for line in panels["points"].lines if line.get_label() == "ego")
    np.testing.assert_array_equal(
        ego.get_ydata(), sightings(da, scenario, "ego_vehicle", int(actor)).points
    )
    assert to_hex(ego.get_color()) == AGENT_COLORS["ego_vehicle"]


def test_a_bar_an_agent_says_when_it_sees_the_actor(da: DeepAccident, other: str) -> None:
    ax, (scenario, actor) = drawn(da, other)["seen"], other.split("/actor/")
    assert [one.get_text() for one in ax.get_yticklabels()] == [
        short_name(agent) for agent in AGENTS
    ]
    bars = [one for one in ax.collections if type(one) is not LineCollection]
    for full, pale, agent in zip(bars[::2], bars[1::2], AGENTS, strict=False):
        known = sightings(da, scenario, agent, int(actor))
        assert (len(full.get_paths()), len(pale.get_paths())) == (
            known.seen.sum(),
            (~known.seen).sum(),
        )
        starts = [path.vertices[:, 0].min() for path in full.get_paths()]
        np.testing.assert_allclose(starts, known.timestamp[known.seen] - 0.05, atol=1e-9)


def test_views_are_of_cameras_that_see_it_at_moments_in_order(da: DeepAccident, other: str) -> None:
    panels = drawn(da, other)
    titles = [panels[name].get_title().split(", ") for name in VIEWS]
    times = [float(moment.removesuffix(" s")) for moment, *_ in titles]
    assert (times, len(set(times))) == (sorted(times), 4)
    for ax in (panels[name] for name in VIEWS):
        edges = np.concatenate(of_kind(ax, LineCollection)[0].get_segments())
        low, high = np.sort([ax.get_xlim(), ax.get_ylim()]).T
        assert ((edges > low) & (edges < high)).all(axis=1).any()


def test_agents_and_layers_can_be_chosen(da: DeepAccident, other: str) -> None:
    panels = drawn(da, other, agents=["other_vehicle_behind"], layers=["trajectories"])
    assert [one.get_text() for one in panels["seen"].get_yticklabels()] == ["other behind"]
    assert (len(panels["path"].images), of_kind(panels["path"], PolyCollection)) == (0, [])
    assert all("other behind" in panels[name].get_title() for name in ("first", "fourth"))


@pytest.mark.parametrize("agent", AGENTS)
def test_sightings_are_the_agent_s_annotations_and_the_released_rule(
    da: DeepAccident, other: str, agent: str
) -> None:
    scenario, actor = other.split("/actor/")
    found, known = [], sightings(da, scenario, agent, int(actor))
    for each in da.annotation:
        sample = each["sample_token"]
        if sample.startswith(f"{scenario}/{agent}/") and each["actor_id"] == int(actor):
            seen = other in visible_instances(da, sample, agents=[agent])
            found.append((int(sample[-3:]), each["num_lidar_pts"], each["camera_visible"], seen))
    told = (known.index, known.points, known.camera, known.seen)
    assert [*zip(*(each.tolist() for each in told), strict=True)] == sorted(found)
    assert (agent == "other_vehicle") == (len(found) == 0)
