"""The columns of clips equal what single calls of the devkit and plain positions yield."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, TokenError
from deepaccident_devkit.export.clip_rows import CLIP_COLUMNS, ClipRows, clip_cameras, clip_rows
from deepaccident_devkit.geometry import time_to_collision
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.testing import SmallRelease, write_small_release

NO_LABEL_COLUMNS = ("time_to_impact", "ttc", "ttc_ahead", "partners_seen")


@pytest.fixture(scope="module")
def recordings(da_motion: DeepAccident) -> dict[str, ClipRows]:
    """The columns of all agents of an accident and its normal twin."""
    return {record["token"]: clip_rows(da_motion, record) for record in da_motion.agent}


@pytest.fixture(scope="module")
def unlabelled(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """A release without labels and meta."""
    root = tmp_path_factory.mktemp("unlabelled") / "release"
    write_small_release(root, SmallRelease(splits=("test",), channels=()))
    return DeepAccident(dataroot=root, verbose=False)


def samples_of(da: DeepAccident, rows: ClipRows) -> list[str]:
    scenario, agent = rows.episode["scenario"], rows.episode["agent"]
    count = da.scenario.get(scenario)["num_frames"]
    return [da.get_sample(scenario, agent, frame)["token"] for frame in range(1, count + 1)]


def vehicles_of(
    da: DeepAccident, recordings: dict[str, ClipRows]
) -> Iterator[tuple[int, ClipRows]]:
    """Return the actor id and the columns of each agent that is a vehicle."""
    for token, rows in recordings.items():
        actor_id = da.agent.get(token)["actor_id"]
        if actor_id is not None:
            yield actor_id, rows


def test_the_table_describes_the_columns(recordings: dict[str, ClipRows]) -> None:
    for rows in recordings.values():
        assert list(rows.columns) == list(CLIP_COLUMNS)
        for name, column in CLIP_COLUMNS.items():
            values = rows.columns[name]
            assert not values.flags.writeable
            assert values.shape == (35, *column.shape) if column.names else (35,)
            assert values.dtype.kind == "U" if column.dtype == "string" else column.dtype


def test_tokens_and_episodes(da_motion: DeepAccident, recordings: dict[str, ClipRows]) -> None:
    groups = set()
    for token, rows in recordings.items():
        scenario = da_motion.scenario.get(rows.episode["scenario"])
        assert rows.columns["token"].tolist() == samples_of(da_motion, rows)
        assert f"{scenario['token']}/{rows.episode['agent']}" == token
        assert rows.episode["split"] == scenario["split"]
        assert set(rows.columns["weather"]) == {rows.episode["weather"]} == {scenario["weather"]}
        groups.add(rows.episode["group"])
    # Twins are in one group.
    assert len(da_motion.scenario) == 2
    assert len(groups) == 1


def test_state_and_action_follow_the_poses(
    da_motion: DeepAccident, recordings: dict[str, ClipRows]
) -> None:
    for rows in recordings.values():
        poses = [da_motion.world_from(token, "ego") for token in samples_of(da_motion, rows)]
        centers = np.array([pose.matrix[:2, 3] for pose in poses])
        state = rows.columns["observation.state"]
        speed = np.hypot(*(centers[2:] - centers[:-2]).T) / 0.2
        assert_allclose(state[1:-1, 0], speed, atol=1e-4)
        headings = np.array([pose.apply([[1.0, 0, 0]])[0, :2] for pose in poses]) - centers
        yaw = np.unwrap(np.arctan2(headings[:, 1], headings[:, 0]))
        assert_allclose(state[1:-1, 3], (yaw[2:] - yaw[:-2]) / 0.2, atol=1e-4)

        action = rows.columns["action"]
        assert_array_equal(action[-1], 0)
        for step, pose, following in zip(action, poses, poses[1:], strict=False):
            reached = pose.inverse().apply(following.apply([[0.0, 0, 0]]))[0]
            assert_allclose(step[:2], reached[:2], atol=1e-5)
        assert_allclose(action[:-1, 2], np.diff(yaw), atol=1e-5)


def test_time_to_impact_and_pair(da_motion: DeepAccident, recordings: dict[str, ClipRows]) -> None:
    for token, rows in recordings.items():
        scenario = da_motion.scenario.get(rows.episode["scenario"])
        agent = da_motion.agent.get(token)
        if scenario["collision"] is None:
            assert np.isnan(rows.columns["time_to_impact"]).all()
            assert not rows.columns["collides"].any()
            continue
        assert_allclose(rows.columns["time_to_impact"], np.arange(34, -1, -1) / 10, atol=1e-6)
        collides = agent["actor_id"] in scenario["collision"]["ids"]
        assert_array_equal(rows.columns["collides"], collides)
    colliding = [
        rows.episode["agent"] for rows in recordings.values() if rows.columns["collides"][0]
    ]
    assert colliding == ["ego_vehicle", "other_vehicle"]


def test_ttc_of_each_pair(da_motion: DeepAccident, recordings: dict[str, ClipRows]) -> None:
    num_known = 0
    for actor_id, rows in vehicles_of(da_motion, recordings):
        for sample, ttc in zip(samples_of(da_motion, rows), rows.columns["ttc"], strict=True):
            boxes = da_motion.cooperative_boxes(sample, frame="world")
            is_own = boxes.actor_id == actor_id
            is_other = (boxes.actor_id >= 0) & ~is_own
            outlines = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
            velocity = boxes.velocity[:, :2]
            own_outlines = np.broadcast_to(outlines[is_own], outlines[is_other].shape)
            times = time_to_collision(
                own_outlines, outlines[is_other], velocity[is_own], velocity[is_other]
            )
            shortest = times.min(initial=np.inf)
            # Pairs with later contacts count only where they are near each other.
            if shortest <= 10:
                assert ttc == pytest.approx(shortest, abs=1e-3)
                num_known += 1
            else:
                assert np.isnan(ttc) or ttc > 10
    assert num_known > 30


def test_ttc_ahead_from_positions(da_motion: DeepAccident, recordings: dict[str, ClipRows]) -> None:
    """Compare with the speed at which the distance ahead shrinks over 0.2 s."""
    num_known = 0
    for actor_id, rows in vehicles_of(da_motion, recordings):
        samples = samples_of(da_motion, rows)
        boxes = [da_motion.cooperative_boxes(sample, frame="world") for sample in samples]
        for index in range(1, len(samples) - 1):
            ego_from_world = da_motion.world_from(samples[index], "ego").inverse()
            before, now, after = (
                dict(
                    zip(
                        boxes[moment].actor_id.tolist(),
                        ego_from_world.apply(boxes[moment].center),
                        strict=True,
                    )
                )
                for moment in (index - 1, index, index + 1)
            )
            lengths = dict(
                zip(boxes[index].actor_id.tolist(), boxes[index].size[:, 0], strict=True)
            )
            times = []
            for actor in now.keys() & before.keys() & after.keys() - {actor_id, -1}:
                offsets = [moment[actor] - moment[actor_id] for moment in (before, now, after)]
                ahead, beside = offsets[1][:2]
                closing = (offsets[0][0] - offsets[2][0]) / 0.2
                if ahead > 0 and abs(beside) <= 2.5 and closing > 0.5:
                    gap = ahead - (lengths[actor] + lengths[actor_id]) / 2
                    times.append(max(gap, 0) / closing)
            if times and min(times) < 10:
                assert rows.columns["ttc_ahead"][index] == pytest.approx(
                    min(times), abs=0.15, rel=0.1
                )
                num_known += 1
    assert num_known > 20


def test_who_sees_the_collider(da_motion: DeepAccident, recordings: dict[str, ClipRows]) -> None:
    for token, rows in recordings.items():
        scenario = da_motion.scenario.get(rows.episode["scenario"])
        if scenario["collision"] is None:
            assert_array_equal(rows.columns["collider_seen_by"], 0)
            assert np.isnan(rows.columns["partners_seen"]).all()
            continue
        colliders = {*scenario["collision"]["ids"]} - {da_motion.agent.get(token)["actor_id"]}
        instances = {f"{scenario['token']}/actor/{actor}" for actor in colliders}
        for frame in range(1, 36, 4):
            seeing = [
                agent
                for agent in AGENTS
                if instances.intersection(
                    da_motion.visible_instances(
                        f"{scenario['token']}/{agent}/{frame:03d}", agents=[agent]
                    )
                )
            ]
            mask = sum(1 << AGENTS.index(agent) for agent in seeing)
            partners = [agent for agent in seeing if agent != rows.episode["agent"]]
            assert rows.columns["collider_seen_by"][frame - 1] == mask
            assert rows.columns["partners_seen"][frame - 1] == len(partners)


def test_a_pole_threatens_nobody(recordings: dict[str, ClipRows]) -> None:
    poles = [rows for token, rows in recordings.items() if token.endswith("infrastructure")]
    assert len(poles) == 2
    for rows in poles:
        assert_allclose(rows.columns["observation.state"], 0, atol=1e-6)
        assert np.isnan(rows.columns["ttc"]).all()
        assert np.isnan(rows.columns["ttc_ahead"]).all()
        assert not rows.columns["collides"].any()


def test_unlabelled_recordings(unlabelled: DeepAccident) -> None:
    for record in unlabelled.agent:
        rows = clip_rows(unlabelled, record["token"])
        assert len(rows) == 3
        for name in NO_LABEL_COLUMNS:
            assert np.isnan(rows.columns[name]).all()
        assert np.isfinite(rows.columns["observation.state"]).all()
        assert not rows.columns["collides"].any()
        assert rows.episode["weather"] == rows.columns["weather"][0] == "unknown"
        assert rows.episode["split"] == "test"


def test_partners_that_are_not_downloaded_see_nothing(tmp_path: Path) -> None:
    agents = ("ego_vehicle", "infrastructure")
    config = SmallRelease(splits=("val",), agents=agents, channels=())
    da = DeepAccident(dataroot=write_small_release(tmp_path / "release", config), verbose=False)
    available = sum(1 << AGENTS.index(agent) for agent in agents)
    for record in da.agent:
        rows = clip_rows(da, record)
        assert not (rows.columns["collider_seen_by"] & ~np.uint8(available)).any()
        assert rows.columns["partners_seen"].max() <= 1


def test_a_single_frame(tmp_path: Path) -> None:
    write_small_release(tmp_path / "release", SmallRelease(frames=1, splits=("val",), channels=()))
    da = DeepAccident(dataroot=tmp_path / "release", verbose=False)
    rows = clip_rows(da, da.agent[0])
    assert rows.columns["action"].tolist() == [[0, 0, 0]]
    assert rows.columns["time_to_impact"].tolist() == [0]


def test_cameras_of_resized_pictures(da_motion: DeepAccident) -> None:
    agent = da_motion.agent[0]
    sample = agent["first_sample_token"]
    channels = ("Camera_Front", "Camera_BackLeft")
    matrices = clip_cameras(da_motion, agent, channels, (64, 36))
    assert len(matrices) == 4
    point = [[0.3, 0.2, 7.0]]
    for channel in channels:
        camera = da_motion.camera(sample, channel)
        pixels, _ = camera.project(point)
        projected = matrices[f"intrinsic.{channel}"] @ point[0]
        scale = [64 / camera.width, 36 / camera.height]
        assert_allclose(projected[:2] / projected[2], pixels[0] * scale)
        ego_from_camera = da_motion.ego_from(sample, channel).matrix
        assert_array_equal(matrices[f"ego_from_camera.{channel}"], ego_from_camera)


def test_unknown_agents_and_channels(da_motion: DeepAccident) -> None:
    with pytest.raises(TokenError, match="nowhere"):
        clip_rows(da_motion, "type1_subtype1_accident/nowhere/ego_vehicle")
    with pytest.raises(ChoiceError, match="expected one of Camera_Front"):
        clip_cameras(da_motion, da_motion.agent[0], ["lidar01"], (64, 36))
