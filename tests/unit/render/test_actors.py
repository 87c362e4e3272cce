"""One box: large from above, in a camera and in words."""

from typing import Any

import numpy as np
import pytest
from drawing import tokens_of
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, render_annotation, render_instance
from deepaccident_devkit.render.actors import sightings
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID
from deepaccident_devkit.v2x import visible_instances


def test_an_annotation_is_shown_large_from_above_and_in_words(da: DeepAccident, frame: str) -> None:
    sample = f"{frame.rsplit('/', 1)[0]}/ego_vehicle_behind/004"
    ego = da.get("agent", f"{frame.rsplit('/', 1)[0]}/ego_vehicle")["actor_id"]
    boxes = da.boxes(sample, "ego")
    row = int(np.flatnonzero(boxes.actor_id == ego)[0])
    fig = render_annotation(da, f"{sample}/{row}", margin=8, fig=detached_figure((10, 5)))
    camera, above, words = fig.axes
    assert camera.get_title() == "Camera_Front"
    assert np.ptp(camera.get_xlim()) <= 64
    center = np.mean([above.get_xlim(), above.get_ylim()], axis=1)
    np.testing.assert_allclose(center, boxes.center[row, :2], atol=1e-9)
    assert np.ptp(above.get_xlim()) == pytest.approx(16)
    text = "\n".join(one.get_text() for one in words.texts)
    length, width, height = boxes.size[row]
    for fact in (
        f"category: {boxes.category_names[row]}",
        f"label id: {ego}",
        f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        f"speed: {np.linalg.norm(boxes.velocity[row]):.1f} m/s",
        f"distance: {np.linalg.norm(boxes.center[row, :2]):.1f} m from the agent",
        f"LiDAR points: {boxes.num_lidar_pts[row]}",
        "impact: in 0.2 s, with this actor",
        "annotated by: ego, ego behind",
    ):
        assert fact in text


def test_an_agent_s_own_box_is_in_none_of_its_cameras(da: DeepAccident, frame: str) -> None:
    sample = f"{frame.rsplit('/', 1)[0]}/ego_vehicle/004"
    own = da.boxes(sample, "lidar").actor_id.tolist().index(OWN_ACTOR_ID)
    fig = render_annotation(da, f"{sample}/{own}", fig=detached_figure((10, 5)))
    assert [one.get_text() for one in fig.axes[0].texts] == ["in no image of its agent's cameras"]


def drawn(da: DeepAccident, instance: str, **how: Any) -> tuple[Any, dict[str, Any]]:
    """The figure, and its panels by name."""
    fig = render_instance(da, instance, fig=detached_figure((14, 8.5)), **how)
    names = ("path", "first", "second", "third", "fourth", "speed", "points", "seen")
    return fig, dict(zip(names, fig.axes, strict=True))


def test_the_path_is_where_all_agents_labels_have_the_actor(da: DeepAccident, other: str) -> None:
    fig, panels = drawn(da, other)
    track = da.trajectory(other)
    path = panels["path"]
    line = next(one for one in path.collections if type(one) is LineCollection)
    expected = np.stack([track.center[:-1, :2], track.center[1:, :2]], axis=1)[::-1, ::-1]
    assert_allclose(line.get_segments(), expected)
    assert to_hex(line.get_color()[0]) == COLLIDER_COLOR
    star = next(one for one in path.collections if type(one) is PathCollection)
    assert_allclose(star.get_offsets(), track.center[-1:, :2])
    assert [one.get_text() for one in path.texts] == ["0 s", "impact"]
    (x0, x1), (y0, y1) = path.get_xlim(), path.get_ylim()
    assert x0 < track.center[:, 0].min() <= track.center[:, 0].max() < x1
    assert y0 < track.center[:, 1].min() <= track.center[:, 1].max() < y1
    assert tokens_of(fig) == [other]
    assert plt.get_fignums() == []


def test_speed_and_points_are_drawn_over_time(da: DeepAccident, other: str) -> None:
    _, panels = drawn(da, other)
    track = da.trajectory(other)
    speed = panels["speed"].lines[0]
    assert_allclose(speed.get_xdata(), track.timestamp)
    assert_allclose(speed.get_ydata(), np.linalg.norm(track.velocity, axis=1))
    scenario, actor = other.split("/actor/")
    lines = {one.get_label(): one for one in panels["points"].lines[:5]}
    known = sightings(da, scenario, "ego_vehicle", int(actor))
    assert_array_equal(lines["ego"].get_ydata(), known.points)
    assert to_hex(lines["ego"].get_color()) == AGENT_COLORS["ego_vehicle"]
    assert panels["speed"].lines[-1].get_xdata() == [0.5, 0.5]


def test_a_bar_an_agent_says_when_it_sees_the_actor(da: DeepAccident, other: str) -> None:
    _, panels = drawn(da, other)
    ax = panels["seen"]
    assert [one.get_text() for one in ax.get_yticklabels()] == [
        "ego",
        "ego behind",
        "other",
        "other behind",
        "infrastructure",
    ]
    scenario, actor = other.split("/actor/")
    bars = [one for one in ax.collections if type(one) is not LineCollection]
    for row, agent in enumerate(AGENTS):
        known = sightings(da, scenario, agent, int(actor))
        full, pale = bars[2 * row], bars[2 * row + 1]
        assert (len(full.get_paths()), len(pale.get_paths())) == (known.seen.sum(), (~known.seen).sum())
        starts = [path.vertices[:, 0].min() for path in full.get_paths()]
        assert_allclose(starts, known.timestamp[known.seen] - 0.05, atol=1e-9)
        assert full.get_alpha() == 1
        assert pale.get_alpha() < 0.5
    assert [(one.get_text(), one.get_position()[1]) for one in ax.texts] == [("is the actor itself", 2)]


def test_views_are_of_cameras_that_see_it_at_moments_in_order(da: DeepAccident, other: str) -> None:
    _, panels = drawn(da, other)
    views = [panels[name] for name in ("first", "second", "third", "fourth")]
    titles = [ax.get_title() for ax in views]
    times = [float(title.split(" s, ")[0]) for title in titles]
    assert times == sorted(times)
    assert len(set(times)) == 4
    assert not any(title.split(", ")[1] == "other" for title in titles)
    for ax in views:
        edges = np.concatenate(next(one for one in ax.collections if type(one) is LineCollection).get_segments())
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        inside = (edges[:, 0] > left) & (edges[:, 0] < right) & (edges[:, 1] > top) & (edges[:, 1] < bottom)
        assert inside.any()


def test_agents_and_layers_can_be_chosen(da: DeepAccident, other: str) -> None:
    _, panels = drawn(da, other, agents=["other_vehicle_behind"], layers=["trajectories"])
    assert [one.get_text() for one in panels["seen"].get_yticklabels()] == ["other behind"]
    assert not panels["path"].images
    assert not any(type(one) is PolyCollection for one in panels["path"].collections)
    assert all("other behind" in panels[name].get_title() for name in ("first", "fourth"))


def test_a_release_without_images_shows_what_the_labels_tell(da_b: DeepAccident) -> None:
    instance = da_b.instance[0]
    _, panels = drawn(da_b, instance["token"])
    assert not any(panels[name].images for name in panels)
    assert len(panels["speed"].lines[0].get_xdata()) == len(da_b.trajectory(instance))


@pytest.mark.parametrize("agent", AGENTS)
def test_sightings_are_the_agent_s_annotations_and_the_released_rule(da: DeepAccident, other: str, agent: str) -> None:
    scenario, actor = other.split("/actor/")
    known = sightings(da, scenario, agent, int(actor))
    points, camera, seen = {}, {}, []
    for index in range(1, 7):
        sample = f"{scenario}/{agent}/{index:03d}"
        for annotation in da.annotation:
            if annotation["sample_token"] == sample and annotation["actor_id"] == int(actor):
                points[index], camera[index] = annotation["num_lidar_pts"], annotation["camera_visible"]
                seen.append(other in visible_instances(da, sample, agents=[agent]))
    assert known.index.tolist() == list(points)
    assert known.points.tolist() == list(points.values())
    assert known.camera.tolist() == list(camera.values())
    assert known.seen.tolist() == seen
    assert (agent == "other_vehicle") == (len(points) == 0)
