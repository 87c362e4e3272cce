from collections.abc import Sequence
from pathlib import Path

import pytest
import tiny
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import cooperative_view


def label_ids(da: DeepAccident, sample: str) -> set[int]:
    return set(da.actor_ids(sample).tolist()) - {-1}


def test_the_union_has_each_actor_once_and_nobody_else(da: DeepAccident) -> None:
    for frame in (da.frame[2], da.frame[-1]):
        samples = [sample["token"] for sample in da.samples_of(frame)]
        for agents in (AGENTS, AGENTS[1:3], AGENTS[4:]):
            tokens = [token for token in samples if token.split("/")[-2] in agents]
            view = cooperative_view(da, tokens[0], agents=agents)
            ids = view.boxes.actor_id
            assert ids[ids >= 0].tolist() == sorted(
                set.union(*(label_ids(da, token) for token in tokens))
            )
            assert -100 not in ids
            for agent in AGENTS:
                seen = (view.seen_by >> AGENTS.index(agent) & 1).astype(bool)
                token = next((token for token in tokens if f"/{agent}/" in token), None)
                assert set(ids[seen & (ids >= 0)].tolist()) == (
                    label_ids(da, token) if token else set()
                )


def test_each_box_is_its_sources_own_in_the_frame_asked_for(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0], "other_vehicle", 3)
    for frame in ("world", "ego", "lidar", "Camera_Back"):
        view = cooperative_view(da, sample, frame=frame)
        assert view.boxes.frame == frame
        for agent in AGENTS:
            token = f"{da.scenario[0]['token']}/{agent}/003"
            mine = view.source == AGENTS.index(agent)
            theirs = da.boxes(token, "world").select(view.boxes.row[mine])
            expected = theirs.transform(da.world_from(sample, frame).inverse(), frame)
            assert_allclose(view.boxes.center[mine], expected.center, atol=1e-6)
            assert_allclose(view.boxes.velocity[mine], expected.velocity, atol=1e-6)
            assert_array_equal(view.boxes.size[mine], expected.size)
    assert (view.source == AGENTS.index("other_vehicle")).sum() > len(view.source) / 2


def test_actor_ids_are_those_of_the_instances(da: DeepAccident) -> None:
    for sample in (da.sample[7], da.sample[-1]):
        instances = [box.instance_token for box in da.get_boxes(sample)]
        assert_array_equal(
            da.actor_ids(sample),
            [-1 if token is None else int(token.rsplit("/", 1)[1]) for token in instances],
        )


def scene(rows: dict[str, Sequence[str]]):
    """Lines of agents who all stand at the same place: what one has at x the others have there
    too.
    """
    return lambda agent, _frame: ["0.0 0.0", *rows.get(agent, ())]


@pytest.fixture
def stacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Open a release of two frames whose agents all stand in the origin, with given rows."""

    def opened(rows: dict[str, Sequence[str]]) -> DeepAccident:
        monkeypatch.setattr(tiny, "ego_to_world", lambda *_: tiny.pose())
        monkeypatch.setattr(tiny, "lidar_height", lambda _: 0.0)
        return DeepAccident(
            dataroot=tiny.write_tiny_release(tmp_path, frames=2, lines_of=scene(rows)),
            verbose=False,
        )

    return opened


def row(x: float, actor: int, points: int = 9, category: str = "car", camera: bool = True) -> str:
    return f"{category} {x} 0.0 0.0 4.0 2.0 1.5 0.0 0.0 0.0 {actor} {points} {camera}"


def test_own_rows_become_actors_and_give_way_to_what_others_see(stacked) -> None:
    da = stacked(
        {
            "ego_vehicle": [row(0.1, -100, 900, camera=False)],
            "other_vehicle": [row(30.0, -100), row(0.0, 1223, 7)],
        }
    )
    view = cooperative_view(da, f"{tiny.TOKEN}/ego_vehicle/001")
    assert_array_equal(view.boxes.actor_id, [1212, 1223])
    assert_allclose(view.boxes.center[:, 0], [30.0, 0.0])
    assert_array_equal(view.boxes.num_lidar_pts, [0, 7])
    assert_array_equal(view.boxes.camera_visible, [False, True])
    assert_array_equal(view.seen_by, [0b00100, 0b00101])
    alone = da.cooperative_boxes(f"{tiny.TOKEN}/ego_vehicle/001", agents="single")
    assert_array_equal(alone.actor_id, [1223])
    assert_allclose(alone.center[0, 0], 0.1)


def test_the_egos_box_counts_before_the_others_and_points_add_up(stacked) -> None:
    da = stacked({"ego_vehicle": [row(20.0, 5, 3)], "infrastructure": [row(20.2, 5, 4)]})
    for ego, x in (("ego_vehicle", 20.0), ("infrastructure", 20.2), ("other_vehicle", 20.0)):
        boxes = da.cooperative_boxes(f"{tiny.TOKEN}/{ego}/001", agents=None)
        assert_allclose(boxes.center[:, 0], [x])
        assert_array_equal(boxes.num_lidar_pts, [7])


def test_untracked_rows_stay_but_once_a_place(stacked) -> None:
    rows = {
        "ego_vehicle": [row(50.0, -1), row(50.3, -1), row(70.0, 8)],
        "other_vehicle": [
            row(50.2, -1),
            row(50.2, -1, category="truck"),
            row(70.1, -1),
            row(90.0, -1),
        ],
        "infrastructure": [row(90.4, -1), row(91.0, -1)],
    }
    boxes = stacked(rows).cooperative_boxes(f"{tiny.TOKEN}/ego_vehicle/001")
    assert_array_equal(boxes.actor_id, [8, -1, -1, -1, -1, -1])
    assert_allclose(boxes.center[:, 0], [70.0, 50.0, 50.3, 50.2, 90.0, 91.0])
    assert boxes.category_names == ["car", "car", "car", "truck", "car", "car"]


@pytest.mark.parametrize(("apart", "kept"), [(0.25, 2), (0.5, 4)])
def test_half_a_metre_apart_are_two_actors(stacked, apart: float, kept: int) -> None:
    rows = {
        "ego_vehicle": [row(50.0, -1), row(70.0, 8)],
        "infrastructure": [row(50.0 + apart, -1), row(70 + apart, -1)],
    }
    view = cooperative_view(stacked(rows), f"{tiny.TOKEN}/ego_vehicle/001")
    assert_array_equal(view.boxes.actor_id, [8, -1, -1, -1][:kept])
    assert_array_equal(view.seen_by, [1, 1, 16, 16][:kept])
    assert_array_equal(view.boxes.num_lidar_pts, [9] * kept)


def test_visible_only(stacked) -> None:
    rows = {
        "ego_vehicle": [
            row(0.0, -100),
            row(20.0, 5, 1),
            row(40.0, 6, 9, camera=False),
            row(12.0, -1),
        ],
        "infrastructure": [row(40.0, 6, 2), row(14.0, 7, 1, camera=False)],
    }
    da, sample = stacked(rows), f"{tiny.TOKEN}/ego_vehicle/001"
    seen = {
        visible: da.cooperative_boxes(sample, visible=visible)
        for visible in (None, "camera", "released")
    }
    assert_array_equal(seen[None].actor_id, [5, 6, 7, 1223, -1])
    assert_array_equal(seen["camera"].actor_id, [5, 6, 1223, -1])
    assert_array_equal(seen["released"].actor_id, [6, 7])
    assert da.visible_instances(sample) == [f"{tiny.TOKEN}/actor/6", f"{tiny.TOKEN}/actor/7"]
    assert da.visible_instances(sample, agents="single") == []
    assert_refused(
        (
            lambda: da.cooperative_boxes(sample, visible="all"),
            ChoiceError,
            "visible: expected one of camera, released, or None, found 'all'",
        ),
    )


def test_visible_instances_of_all_agents_are_those_of_the_released_labels(da: DeepAccident) -> None:
    for sample in (da.sample[0], da.sample[33]):
        instances = {int(token.rsplit("/", 1)[1]) for token in da.visible_instances(sample)}
        assert set(da.boxes(sample, visible="released").actor_id.tolist()) == instances & set(
            da.boxes(sample).actor_id.tolist()
        )
        assert len(instances) >= len(da.visible_instances(sample, agents="single")) > 0


def test_agents_without_labels_see_nothing(tmp_path: Path) -> None:
    da = DeepAccident(dataroot=tiny.write_tiny_release(tmp_path, labelled=False), verbose=False)
    sample = f"{tiny.TOKEN}/ego_vehicle/001"
    assert (len(da.cooperative_boxes(sample, frame="ego")), da.visible_instances(sample)) == (0, [])


def test_a_row_that_a_label_repeats_counts_once(stacked) -> None:
    rows = {
        "ego_vehicle": [row(20.0, 5, 3), row(20.4, 5, 8), row(0.0, -100), row(0.1, -100, 70)],
        "infrastructure": [row(20.2, 5, 4), row(20.2, 5, 4), row(0.0, 1223, 6), row(0.0, 1223, 6)],
    }
    view = cooperative_view(stacked(rows), f"{tiny.TOKEN}/ego_vehicle/001")
    assert_array_equal(view.boxes.actor_id, [5, 1223])
    assert_array_equal(view.boxes.num_lidar_pts, [7, 6])
    assert_allclose(view.boxes.center[:, 0], [20.0, 0.0])
    assert_array_equal(view.seen_by, [0b10001, 0b10001])
    assert_array_equal(view.source, [0, 4])
