"""A single actor: large from above, in a camera and in words."""

from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_hex
from support.rendered_pixels import collections_of_kind, read_texts, read_tokens
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure, render_annotation, render_instance
from deepaccident_devkit.render.actors import sightings
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, short_name
from deepaccident_devkit.v2x import visible_instances


def test_an_annotation_is_shown_large_from_above_and_in_words(da: DeepAccident, frame: str) -> None:
    scenario = frame.rsplit("/", 1)[0]
    sample = f"{scenario}/ego_vehicle_behind/004"
    ego_id = da.get("agent", f"{scenario}/ego_vehicle")["actor_id"]
    boxes = da.boxes(sample, "ego")
    row = boxes.actor_id.tolist().index(ego_id)

    camera, above, words = render_annotation(
        da, f"{sample}/{row}", margin=8, fig=detached_figure((10, 5))
    ).axes

    assert camera.get_title() == "front"
    np.testing.assert_allclose(
        np.mean([above.get_xlim(), above.get_ylim()], axis=1),
        boxes.center[row, :2],
        atol=1e-9,
    )
    assert np.ptp(above.get_xlim()) == pytest.approx(16)
    length, width, height = boxes.size[row]
    assert not missing_parts(
        "\n".join(read_texts(words)),
        f"category: {boxes.category_names[row]}",
        f"label id: {ego_id}",
        f"size: {length:.2f} × {width:.2f} × {height:.2f} m",
        f"speed: {np.linalg.norm(boxes.velocity[row]):.1f} m/s",
        f"distance from the agent: {np.linalg.norm(boxes.center[row, :2]):.1f} m",
        f"LiDAR points: {boxes.num_lidar_pts[row]}",
        "this actor collides in 0.2 s",
        "annotated by: ego, ego behind",
    )


def test_an_agent_s_own_box_is_in_none_of_its_cameras(da: DeepAccident, frame: str) -> None:
    sample = f"{frame.rsplit('/', 1)[0]}/ego_vehicle/004"
    own_row = da.boxes(sample, "lidar").actor_id.tolist().index(OWN_ACTOR_ID)
    fig = render_annotation(da, f"{sample}/{own_row}", fig=detached_figure((10, 5)))
    assert read_texts(fig.axes[0]) == ["outside of all images\nof the agent"]


VIEWS = ("first", "second", "third", "fourth")


def draw_panels(da: DeepAccident, instance: str, **options: Any) -> dict[str, Any]:
    """Draw an instance and return the panels by name."""
    fig = render_instance(da, instance, fig=detached_figure((14, 8.5)), **options)
    assert read_tokens(fig) == [instance]
    names = ("path", *VIEWS, "speed", "points", "seen")
    return dict(zip(names, fig.axes, strict=True))


def seconds_to_impact(da: DeepAccident, instance: str) -> float:
    """Return the time of the impact, in seconds from the first frame."""
    first_sample = f"{instance.split('/actor/', maxsplit=1)[0]}/ego_vehicle/001"
    return float(da.get("sample", first_sample)["time_to_impact"])


def read_row_names(ax: Any) -> list[str]:
    return [label.get_text() for label in ax.get_yticklabels()]


def test_the_path_is_where_all_agents_labels_have_the_actor(
    da: DeepAccident, other_vehicle: str
) -> None:
    path = draw_panels(da, other_vehicle)["path"]
    centers = da.trajectory(other_vehicle).center[:, :2]
    line = collections_of_kind(path, LineCollection)[0]
    star = collections_of_kind(path, PathCollection)[0]

    segments = np.stack([centers[:-1], centers[1:]], axis=1)
    np.testing.assert_allclose(line.get_segments(), segments[::-1, ::-1])
    assert to_hex(line.get_color()[0]) == COLLIDER_COLOR
    np.testing.assert_allclose(star.get_offsets(), centers[-1:])

    low, high = np.array([path.get_xlim(), path.get_ylim()]).T
    assert ((low < centers) & (centers < high)).all()


def test_speed_and_points_are_drawn_over_time(da: DeepAccident, other_vehicle: str) -> None:
    panels = draw_panels(da, other_vehicle)
    track = da.trajectory(other_vehicle)
    speeds = np.linalg.norm(track.velocity, axis=1)
    np.testing.assert_allclose(
        panels["speed"].lines[0].get_xydata(),
        np.column_stack([track.timestamp - seconds_to_impact(da, other_vehicle), speeds]),
        atol=1e-9,
    )

    scenario, actor_id = other_vehicle.split("/actor/")
    ego_line = next(line for line in panels["points"].lines if line.get_label() == "ego")
    ego_sightings = sightings(da, scenario, "ego_vehicle", int(actor_id))
    np.testing.assert_array_equal(ego_line.get_ydata(), ego_sightings.points)
    assert to_hex(ego_line.get_color()) == AGENT_COLORS["ego_vehicle"]


def test_each_agent_has_a_bar_of_when_it_sees_the_actor(
    da: DeepAccident, other_vehicle: str
) -> None:
    ax = draw_panels(da, other_vehicle)["seen"]
    assert read_row_names(ax) == [short_name(agent) for agent in AGENTS]

    scenario, actor_id = other_vehicle.split("/actor/")
    bars = [shape for shape in ax.collections if type(shape) is not LineCollection]
    for full, pale, agent in zip(bars[::2], bars[1::2], AGENTS, strict=False):
        expected = sightings(da, scenario, agent, int(actor_id))
        assert (len(full.get_paths()), len(pale.get_paths())) == (
            expected.seen.sum(),
            (~expected.seen).sum(),
        )
        starts = [path.vertices[:, 0].min() for path in full.get_paths()]
        timestamps = (expected.index[expected.seen] - 1) / 10
        expected_starts = timestamps - seconds_to_impact(da, other_vehicle) - 0.05
        np.testing.assert_allclose(starts, expected_starts, atol=1e-9)


def test_views_are_in_order_of_time_and_from_cameras_that_see_the_actor(
    da: DeepAccident, other_vehicle: str
) -> None:
    panels = draw_panels(da, other_vehicle)
    times = []
    for name in VIEWS:
        seconds = panels[name].get_title().split(", ")[0]
        times.append(float(seconds.removesuffix(" s").replace("−", "-")))
    assert (times, len(set(times))) == (sorted(times), 4)
    assert times[-1] <= 0

    for name in VIEWS:
        ax = panels[name]
        edges = collections_of_kind(ax, LineCollection)[0].get_segments()
        points = np.concatenate(edges)
        low, high = np.sort([ax.get_xlim(), ax.get_ylim()]).T
        assert ((points > low) & (points < high)).all(axis=1).any()


def test_agents_and_layers_can_be_chosen(da: DeepAccident, other_vehicle: str) -> None:
    panels = draw_panels(
        da, other_vehicle, agents=["other_vehicle_behind"], layers=["trajectories"]
    )

    assert read_row_names(panels["seen"]) == ["other behind"]
    assert len(panels["path"].images) == 0
    assert collections_of_kind(panels["path"], PolyCollection) == []
    assert all("other behind" in panels[name].get_title() for name in ("first", "fourth"))


@pytest.mark.parametrize("agent", AGENTS)
def test_sightings_are_the_agent_s_annotations_and_the_released_rule(
    da: DeepAccident, other_vehicle: str, agent: str
) -> None:
    scenario, actor_id = other_vehicle.split("/actor/")
    expected_rows = []
    for annotation in da.annotation:
        sample = annotation["sample_token"]
        is_of_agent = sample.startswith(f"{scenario}/{agent}/")
        if is_of_agent and annotation["actor_id"] == int(actor_id):
            expected_rows.append(
                (
                    int(sample[-3:]),
                    annotation["num_lidar_pts"],
                    annotation["camera_visible"],
                    other_vehicle in visible_instances(da, sample, agents=[agent]),
                )
            )

    result = sightings(da, scenario, agent, int(actor_id))

    columns = (result.index, result.points, result.camera, result.seen)
    rows = [*zip(*(column.tolist() for column in columns), strict=True)]
    assert rows == sorted(expected_rows)
    assert (agent == "other_vehicle") == (len(expected_rows) == 0)
