import itertools
from collections.abc import Sequence
from pathlib import Path

import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support import tiny_release
from support.expected_errors import assert_raises
from support.tiny_release import SCENARIO_TOKEN

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import cooperative_view

SAMPLE_TOKEN = f"{SCENARIO_TOKEN}/ego_vehicle/001"


def tracked_actor_ids(da: DeepAccident, sample: str) -> set[int]:
    """Return the ids of a sample's labelled actors, without -1."""
    return set(da.actor_ids(sample).tolist()) - {-1}


def test_the_union_has_each_labelled_actor_once_and_no_other(da: DeepAccident) -> None:
    agent_sets = (AGENTS, AGENTS[1:3], AGENTS[4:])
    for frame, agents in itertools.product((da.frame[2], da.frame[-1]), agent_sets):
        tokens = [sample["token"] for sample in da.samples_of(frame)]
        samples = {token.split("/")[-2]: token for token in tokens}
        ids_by_agent = {agent: tracked_actor_ids(da, samples[agent]) for agent in agents}
        view = cooperative_view(da, samples[agents[0]], agents=agents)
        ids = view.boxes.actor_id
        assert ids[ids >= 0].tolist() == sorted(set.union(*ids_by_agent.values()))
        assert -100 not in ids
        for agent in AGENTS:
            is_seen = (view.seen_by >> AGENTS.index(agent) & 1).astype(bool)
            assert set(ids[is_seen & (ids >= 0)].tolist()) == ids_by_agent.get(agent, set())


def test_each_box_is_its_sources_own_in_the_frame_asked_for(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0], "other_vehicle", 3)
    for frame in ("world", "ego", "lidar", "Camera_Back"):
        view = cooperative_view(da, sample, frame=frame)
        assert view.boxes.frame == frame
        for agent in AGENTS:
            token = f"{da.scenario[0]['token']}/{agent}/003"
            from_agent = view.source == AGENTS.index(agent)
            labels = da.boxes(token, "world").select(view.boxes.row[from_agent])
            expected = labels.transform(da.world_from(sample, frame).inverse(), frame)
            assert_allclose(view.boxes.center[from_agent], expected.center, atol=1e-6)
            assert_allclose(view.boxes.velocity[from_agent], expected.velocity, atol=1e-6)
            assert_array_equal(view.boxes.size[from_agent], expected.size)

    assert (view.source == AGENTS.index("other_vehicle")).sum() > len(view.source) / 2


def test_actor_ids_are_those_of_the_instances(da: DeepAccident) -> None:
    for sample in (da.sample[7], da.sample[-1]):
        instances = [box.instance_token for box in da.get_boxes(sample)]
        expected = [-1 if token is None else int(token.rsplit("/", 1)[1]) for token in instances]
        assert_array_equal(da.actor_ids(sample), expected)


def place_agents_together(rows: dict[str, Sequence[str]]):
    """Return a function that writes given label rows of agents at one place (a row's x is the same
    for all).
    """
    return lambda agent, _frame: ["0.0 0.0", *rows.get(agent, ())]


@pytest.fixture
def open_release_at_origin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Open a release of two frames with given label rows; all its agents stand at the origin."""

    def open_release(rows: dict[str, Sequence[str]]) -> DeepAccident:
        monkeypatch.setattr(tiny_release, "ego_to_world", lambda *_: tiny_release.pose())
        monkeypatch.setattr(tiny_release, "lidar_height", lambda _: 0.0)
        tiny_release.write_tiny_release(tmp_path, frames=2, lines_of=place_agents_together(rows))
        return DeepAccident(dataroot=tmp_path, verbose=False)

    return open_release


def label_row(
    x_m: float, actor: int, num_points: int = 9, category: str = "car", camera_visible: bool = True
) -> str:
    return f"{category} {x_m} 0.0 0.0 4.0 2.0 1.5 0.0 0.0 0.0 {actor} {num_points} {camera_visible}"


def test_own_rows_become_actors_and_give_way_to_labels_of_others(open_release_at_origin) -> None:
    da = open_release_at_origin(
        {
            "ego_vehicle": [label_row(0.1, -100, 900, camera_visible=False)],
            "other_vehicle": [label_row(30.0, -100), label_row(0.0, 1223, 7)],
        }
    )
    view = cooperative_view(da, SAMPLE_TOKEN)

    assert_array_equal(view.boxes.actor_id, [1212, 1223])
    assert_allclose(view.boxes.center[:, 0], [30.0, 0.0])
    assert_array_equal(view.boxes.num_lidar_pts, [0, 7])
    assert_array_equal(view.boxes.camera_visible, [False, True])
    assert_array_equal(view.seen_by, [0b00100, 0b00101])
    own_boxes = da.cooperative_boxes(SAMPLE_TOKEN, agents="single")
    assert_array_equal(own_boxes.actor_id, [1223])
    assert_allclose(own_boxes.center[0, 0], 0.1)


def test_the_egos_box_counts_before_the_others_and_points_add_up(open_release_at_origin) -> None:
    rows = {
        "ego_vehicle": [label_row(20.0, 5, 3)],
        "infrastructure": [label_row(20.2, 5, 4)],
    }
    da = open_release_at_origin(rows)
    for ego, x_m in (("ego_vehicle", 20.0), ("infrastructure", 20.2), ("other_vehicle", 20.0)):
        boxes = da.cooperative_boxes(f"{SCENARIO_TOKEN}/{ego}/001", agents=None)
        assert_allclose(boxes.center[:, 0], [x_m])
        assert_array_equal(boxes.num_lidar_pts, [7])


def test_untracked_rows_stay_but_only_once_at_a_place(open_release_at_origin) -> None:
    rows = {
        "ego_vehicle": [label_row(50.0, -1), label_row(50.3, -1), label_row(70.0, 8)],
        "other_vehicle": [
            label_row(50.2, -1),
            label_row(50.2, -1, category="truck"),
            label_row(70.1, -1),
            label_row(90.0, -1),
        ],
        "infrastructure": [label_row(90.4, -1), label_row(91.0, -1)],
    }
    boxes = open_release_at_origin(rows).cooperative_boxes(SAMPLE_TOKEN)

    assert_array_equal(boxes.actor_id, [8, -1, -1, -1, -1, -1])
    assert_allclose(boxes.center[:, 0], [70.0, 50.0, 50.3, 50.2, 90.0, 91.0])
    assert boxes.category_names == ["car", "car", "car", "truck", "car", "car"]


@pytest.mark.parametrize(("distance_m", "num_boxes"), [(0.25, 2), (0.5, 4)])
def test_half_a_metre_apart_are_two_actors(
    open_release_at_origin, distance_m: float, num_boxes: int
) -> None:
    rows = {
        "ego_vehicle": [label_row(50.0, -1), label_row(70.0, 8)],
        "infrastructure": [label_row(50.0 + distance_m, -1), label_row(70 + distance_m, -1)],
    }
    view = cooperative_view(open_release_at_origin(rows), SAMPLE_TOKEN)

    assert_array_equal(view.boxes.actor_id, [8, -1, -1, -1][:num_boxes])
    assert_array_equal(view.seen_by, [1, 1, 16, 16][:num_boxes])
    assert_array_equal(view.boxes.num_lidar_pts, [9] * num_boxes)


def test_visible_only(open_release_at_origin) -> None:
    rows = {
        "ego_vehicle": [
            label_row(0.0, -100),
            label_row(20.0, 5, 1),
            label_row(40.0, 6, 9, camera_visible=False),
            label_row(12.0, -1),
        ],
        "infrastructure": [label_row(40.0, 6, 2), label_row(14.0, 7, 1, camera_visible=False)],
    }
    da = open_release_at_origin(rows)
    boxes = da.cooperative_boxes(SAMPLE_TOKEN, visible=None)
    camera_boxes = da.cooperative_boxes(SAMPLE_TOKEN, visible="camera")
    released_boxes = da.cooperative_boxes(SAMPLE_TOKEN, visible="released")

    assert_array_equal(boxes.actor_id, [5, 6, 7, 1223, -1])
    assert_array_equal(camera_boxes.actor_id, [5, 6, 1223, -1])
    assert_array_equal(released_boxes.actor_id, [6, 7])
    assert da.visible_instances(SAMPLE_TOKEN) == [
        f"{SCENARIO_TOKEN}/actor/6",
        f"{SCENARIO_TOKEN}/actor/7",
    ]
    assert da.visible_instances(SAMPLE_TOKEN, agents="single") == []
    assert_raises(
        (
            lambda: da.cooperative_boxes(SAMPLE_TOKEN, visible="all"),
            ChoiceError,
            "visible: expected one of camera, released, or None, found 'all'",
        ),
    )


def test_visible_instances_of_all_agents_are_those_of_the_released_labels(da: DeepAccident) -> None:
    for sample in (da.sample[0], da.sample[33]):
        instances = da.visible_instances(sample)
        visible_ids = {int(token.rsplit("/", 1)[1]) for token in instances}
        labelled_ids = set(da.boxes(sample).actor_id.tolist())
        released_ids = set(da.boxes(sample, visible="released").actor_id.tolist())
        assert released_ids == visible_ids & labelled_ids
        assert len(visible_ids) >= len(da.visible_instances(sample, agents="single")) > 0


def test_agents_without_labels_see_nothing(tmp_path: Path) -> None:
    tiny_release.write_tiny_release(tmp_path, labelled=False)
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    assert len(da.cooperative_boxes(SAMPLE_TOKEN, frame="ego")) == 0
    assert da.visible_instances(SAMPLE_TOKEN) == []


def test_a_row_that_a_label_repeats_counts_once(open_release_at_origin) -> None:
    rows = {
        "ego_vehicle": [
            label_row(20.0, 5, 3),
            label_row(20.4, 5, 8),
            label_row(0.0, -100),
            label_row(0.1, -100, 70),
        ],
        "infrastructure": [
            label_row(20.2, 5, 4),
            label_row(20.2, 5, 4),
            label_row(0.0, 1223, 6),
            label_row(0.0, 1223, 6),
        ],
    }
    view = cooperative_view(open_release_at_origin(rows), SAMPLE_TOKEN)

    assert_array_equal(view.boxes.actor_id, [5, 1223])
    assert_array_equal(view.boxes.num_lidar_pts, [7, 6])
    assert_allclose(view.boxes.center[:, 0], [20.0, 0.0])
    assert_array_equal(view.seen_by, [0b10001, 0b10001])
    assert_array_equal(view.source, [0, 4])
